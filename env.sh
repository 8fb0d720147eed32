# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0

# Source this file: `source env.sh` in bash or zsh, `. ./env.sh` in sh (from this folder).
#
# It puts the command `valveflow`, the environment in .venv and the ROS packages in
# install/ in reach of this shell. Sourcing it again changes nothing more.

# Where this file lies. A plain sh cannot tell; there it must be sourced from its folder.
if [ -n "${BASH_VERSION:-}" ]; then
    _vf_root=$(CDPATH='' cd -- "$(dirname -- "${BASH_SOURCE[0]}")" && pwd)
elif [ -n "${ZSH_VERSION:-}" ]; then
    eval '_vf_root=${${(%):-%x}:A:h}'
else
    _vf_root=$(pwd)
fi

# _vf_put VARIABLE ENTRY: put ENTRY first, and nowhere else.
_vf_put() {
    eval "_vf_old=\${$1:-}"
    _vf_new=$2
    _vf_rest=$_vf_old:
    while [ -n "$_vf_rest" ]; do
        _vf_entry=${_vf_rest%%:*}
        _vf_rest=${_vf_rest#*:}
        if [ -n "$_vf_entry" ] && [ "$_vf_entry" != "$2" ]; then
            _vf_new=$_vf_new:$_vf_entry
        fi
    done
    export "$1=$_vf_new"
}

# _vf_drop VARIABLE FOLDER: drop the entries that lie in FOLDER.
_vf_drop() {
    eval "_vf_rest=\${$1:-}"
    [ -n "$_vf_rest" ] || return 0
    _vf_rest=$_vf_rest:
    _vf_new=
    while [ -n "$_vf_rest" ]; do
        _vf_entry=${_vf_rest%%:*}
        _vf_rest=${_vf_rest#*:}
        case $_vf_entry in
            '' | "$2" | "$2"/*) ;;
            *) _vf_new=$_vf_new${_vf_new:+:}$_vf_entry ;;
        esac
    done
    export "$1=$_vf_new"
}

# Two ROS installations in one shell would mix their libraries: another one that
# brings its own rclpy is set aside here. What was built on top of ours stays.
_vf_set_aside() {
    _vf_prefixes=${AMENT_PREFIX_PATH:-}:
    while [ -n "$_vf_prefixes" ]; do
        _vf_prefix=${_vf_prefixes%%:*}
        _vf_prefixes=${_vf_prefixes#*:}
        [ -n "$_vf_prefix" ] && [ "$_vf_prefix" != "$_vf_root/.venv" ] || continue
        [ -e "$_vf_prefix/share/ament_index/resource_index/packages/rclpy" ] || continue
        echo "env.sh: the ROS installation in $_vf_prefix is set aside in this shell" >&2
        for _vf_name in AMENT_PREFIX_PATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH \
            LD_LIBRARY_PATH PATH PYTHONPATH; do
            _vf_drop "$_vf_name" "$_vf_prefix"
        done
    done
}

_vf_setup() {
    if [ ! -f "$_vf_root/package.xml" ] || [ ! -f "$_vf_root/tools/setup_tree.py" ]; then
        echo 'env.sh: this shell cannot tell where env.sh lies; source it from its own folder' >&2
        return 1
    fi
    # The stamp of the set-up; while it is not finished there is nothing to offer.
    if [ ! -x "$_vf_root/.venv/bin/python" ] || [ ! -f "$_vf_root/install/.valveflow-setup" ]; then
        echo "env.sh: not set up yet; run: make -C $_vf_root setup" >&2
        return 1
    fi
    _vf_set_aside
    for _vf_site in "$_vf_root"/.venv/lib/python3.*/site-packages; do
        _vf_version=${_vf_site%/site-packages}
        _vf_version=${_vf_version##*/}
        for _vf_libs in "$_vf_site"/ros_*.libs "$_vf_root/.venv/lib"; do
            _vf_put LD_LIBRARY_PATH "$_vf_libs"
        done
    done
    # The wheels start Python a second time to set the path above; that is done now.
    export _ROS_WHEELS_BOOTSTRAP_COMPLETE=1

    _vf_put AMENT_PREFIX_PATH "$_vf_root/.venv"
    for _vf_package in valveflow_msgs valveflow_ros; do
        _vf_put AMENT_PREFIX_PATH "$_vf_root/install/$_vf_package"
        _vf_put PYTHONPATH "$_vf_root/install/$_vf_package/lib/$_vf_version/site-packages"
    done
    # The node package is linked from here, so that an edited file takes effect at once.
    _vf_put PYTHONPATH "$_vf_root/build/valveflow_ros"
    _vf_put LD_LIBRARY_PATH "$_vf_root/install/valveflow_msgs/lib"
    _vf_put PATH "$_vf_root/.venv/bin"
    _vf_put PATH "$_vf_root/install/valveflow_ros/bin"

    export VIRTUAL_ENV="$_vf_root/.venv"
    export ROS_DISTRO=jazzy ROS_VERSION=2 ROS_PYTHON_VERSION=3
    export RMW_IMPLEMENTATION=rmw_fastrtps_cpp
    # Plant data stay on this machine unless somebody decides otherwise.
    export ROS_AUTOMATIC_DISCOVERY_RANGE="${ROS_AUTOMATIC_DISCOVERY_RANGE:-LOCALHOST}"
}

_vf_status=0
_vf_setup || _vf_status=$?
unset -f _vf_put _vf_drop _vf_set_aside _vf_setup
unset _vf_root _vf_old _vf_new _vf_rest _vf_entry _vf_prefix _vf_prefixes _vf_name \
    _vf_site _vf_version _vf_libs _vf_package
# The status goes to the caller and no name stays behind.
eval "unset _vf_status; return $_vf_status"
