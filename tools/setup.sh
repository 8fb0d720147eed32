#!/bin/sh
# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0

# Finds a Python that can carry the set-up and hands over to setup_tree.py.
# A name on the PATH proves nothing (version managers leave shims that do not run),
# so every candidate is run before it is believed.

here=$(CDPATH='' cd -- "$(dirname -- "$0")" && pwd) || exit 1
# What a person exported for another Python must not reach this one.
unset PYTHONPATH PYTHONHOME

probe='
import sys
version = "%d.%d" % sys.version_info[:2]
if sys.implementation.name != "cpython" or version not in ("3.10", "3.11", "3.12"):
    print("wrong " + sys.implementation.name + " " + version)
else:
    try:
        import ensurepip, venv
        print("good " + version)
    except ImportError:
        print("venv " + version)
'

candidates='python3.12 python3.11 python3.10 python3 python'
if [ -n "${PYTHON:-}" ]; then
    candidates=$PYTHON
elif [ -f "$here/../.venv/pyvenv.cfg" ]; then
    # The one that made .venv, so that a PYTHON= given once holds until another is given.
    home=$(sed -n 's/^home *= *//p' "$here/../.venv/pyvenv.cfg")
    made=$(cd "$here/../.venv/lib" 2>/dev/null && echo python3.*)
    candidates="$home/$made $candidates"
fi

without_venv=
seen=
for candidate in $candidates; do
    answer=$("$candidate" -c "$probe" 2>/dev/null) || continue
    case $answer in
        good*) exec "$candidate" "$here/setup_tree.py" "$@" ;;
        venv*) [ -n "$without_venv" ] || without_venv=${answer#venv } ;;
        wrong*) seen="$seen${seen:+, }$candidate is ${answer#wrong }" ;;
    esac
done

if [ -n "$without_venv" ]; then
    echo "setup: Python $without_venv is here but lacks its venv and ensurepip modules; on Debian or Ubuntu: sudo apt install python$without_venv-venv python$without_venv-dev" >&2
elif [ -n "${PYTHON:-}" ]; then
    echo "setup: PYTHON=$PYTHON is no CPython 3.10, 3.11 or 3.12 that runs${seen:+ ($seen)}; name one, or leave PYTHON out to have one searched for." >&2
else
    echo "setup: no CPython 3.10, 3.11 or 3.12 found${seen:+ ($seen)}; on Debian or Ubuntu: sudo apt install python3 python3-venv python3-dev, or name one: make setup PYTHON=/path/to/python3.12" >&2
fi
exit 1
