# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""env.sh in the shells people use: right, quiet, twice harmless, and clear when it cannot."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
SHELLS = ('bash', 'zsh', 'dash')
PATHS = ('PATH', 'PYTHONPATH', 'LD_LIBRARY_PATH', 'AMENT_PREFIX_PATH')

each_shell = pytest.mark.parametrize('shell', SHELLS)


@pytest.fixture
def house(tmp_path):
    """A folder that looks like a tree after the set-up."""
    house = tmp_path / 'house'
    site = house / '.venv' / 'lib' / 'python3.11' / 'site-packages'
    for folder in (
        house / 'tools',
        house / '.venv' / 'bin',
        site / 'ros_a.libs',
        house / 'install',
    ):
        folder.mkdir(parents=True)
    shutil.copy(ROOT / 'env.sh', house)
    (house / 'package.xml').touch()
    (house / 'tools' / 'setup_tree.py').touch()
    (house / '.venv' / 'bin' / 'python').touch(mode=0o755)
    (house / 'install' / '.valveflow-setup').touch()
    return house


def run(shell, house, script, **env):
    """Run a script in a shell that stops at the first error and unset name."""
    program = shutil.which(shell)
    if program is None:
        pytest.skip(f'{shell} is not installed here')
    bare = {'PATH': '/usr/bin:/bin', 'HOME': '/nowhere'}
    return subprocess.run(
        [program, '-c', f'set -eu\n{script}'],
        cwd=house,  # a plain sh finds env.sh nowhere else
        env=bare | env,
        capture_output=True,
        text=True,
        check=False,
    )


def variables(text):
    """Read the lines of env."""
    return dict(line.split('=', 1) for line in text.splitlines() if '=' in line)


@each_shell
def test_what_it_sets(house, shell):
    done = run(shell, house, f'. {house}/env.sh; env')
    assert (done.returncode, done.stderr) == (0, '')
    env = variables(done.stdout)
    install, venv = f'{house}/install', f'{house}/.venv'
    site = 'lib/python3.11/site-packages'
    assert env['PATH'] == f'{install}/valveflow_ros/bin:{venv}/bin:/usr/bin:/bin'
    assert env['AMENT_PREFIX_PATH'].split(':') == [
        f'{install}/valveflow_ros', f'{install}/valveflow_msgs', venv,
    ]  # fmt: skip
    assert env['PYTHONPATH'].split(':') == [
        f'{house}/build/valveflow_ros',
        f'{install}/valveflow_ros/{site}',
        f'{install}/valveflow_msgs/{site}',
    ]
    assert env['LD_LIBRARY_PATH'].split(':') == [
        f'{install}/valveflow_msgs/lib', f'{venv}/lib', f'{venv}/{site}/ros_a.libs',
    ]  # fmt: skip
    assert env['RMW_IMPLEMENTATION'] == 'rmw_fastrtps_cpp'
    assert env['ROS_AUTOMATIC_DISCOVERY_RANGE'] == 'LOCALHOST'
    assert env['ROS_DISTRO'] == 'jazzy'
    assert env['VIRTUAL_ENV'] == venv


@each_shell
def test_twice_is_once(house, shell):
    once = run(shell, house, f'. {house}/env.sh; env')
    twice = run(shell, house, f'. {house}/env.sh; . {house}/env.sh; env')
    assert twice.returncode == 0
    for name in PATHS:
        assert variables(twice.stdout)[name] == variables(once.stdout)[name]


@each_shell
def test_it_leaves_no_names_behind(house, shell):
    done = run(shell, house, f'. {house}/env.sh; set; command -v _vf_put || echo none')
    assert done.returncode == 0
    assert [line for line in done.stdout.splitlines() if line.startswith('_vf_')] == []
    assert done.stdout.endswith('none\n')


@each_shell
def test_what_was_there_stays(house, shell):
    there = dict.fromkeys(PATHS[1:], '/a:/b c:/a')
    done = run(
        shell, house, f'. {house}/env.sh; env', **there, ROS_AUTOMATIC_DISCOVERY_RANGE='OFF'
    )
    env = variables(done.stdout)
    for name in PATHS[1:]:
        assert env[name].endswith(':/a:/b c:/a')
    assert env['ROS_AUTOMATIC_DISCOVERY_RANGE'] == 'OFF'


@each_shell
def test_before_the_set_up_it_says_so_and_changes_nothing(house, shell):
    (house / 'install' / '.valveflow-setup').unlink()
    before = run(shell, house, 'env')
    # dash ends at once under set -e, whatever stands behind the dot command.
    done = run(shell, house, f'set +e; . {house}/env.sh; echo status $?; env')
    assert 'status 1\n' in done.stdout
    assert done.stderr == f'env.sh: not set up yet; run: make -C {house} setup\n'
    after = variables(done.stdout.replace('status 1\n', ''))
    # Shells count themselves and remember their last word; the rest is as it was.
    assert {k: v for k, v in after.items() if k not in ('_', 'SHLVL', 'OLDPWD')} == {
        k: v for k, v in variables(before.stdout).items() if k not in ('_', 'SHLVL', 'OLDPWD')
    }


@each_shell
def test_another_ros_is_set_aside_in_this_shell_only(house, shell, tmp_path):
    ros = tmp_path / 'opt' / 'ros'
    (ros / 'share' / 'ament_index' / 'resource_index' / 'packages').mkdir(parents=True)
    (ros / 'share' / 'ament_index' / 'resource_index' / 'packages' / 'rclpy').touch()
    overlay = tmp_path / 'overlay'
    mine = f'{overlay}:{ros}'
    done = run(
        shell, house, f'. {house}/env.sh; env',
        AMENT_PREFIX_PATH=mine, PYTHONPATH=f'{overlay}/py:{ros}/py', LD_LIBRARY_PATH=f'{ros}/lib',
        PATH=f'{ros}/bin:/usr/bin:/bin',
    )  # fmt: skip
    assert done.returncode == 0
    assert done.stderr == f'env.sh: the ROS installation in {ros} is set aside in this shell\n'
    env = variables(done.stdout)
    assert env['AMENT_PREFIX_PATH'].endswith(f':{overlay}')
    assert env['PYTHONPATH'].endswith(f':{overlay}/py')
    for name in PATHS:
        assert f'{ros}/' not in env[name] + '/'
    assert sorted(p.name for p in ros.iterdir()) == ['share']


def test_a_plain_sh_in_another_folder_says_what_to_do(house, tmp_path):
    done = run('dash', tmp_path, f'. {house}/env.sh')
    assert done.returncode == 1
    assert done.stderr == (
        'env.sh: this shell cannot tell where env.sh lies; source it from its own folder\n'
    )


@pytest.mark.parametrize('shell', ['bash', 'zsh'])
def test_it_is_found_from_any_folder(house, shell, tmp_path):
    done = run(shell, tmp_path, '. house/env.sh; cd /; env')
    assert done.returncode == 0, done.stderr
    assert variables(done.stdout)['VIRTUAL_ENV'] == f'{house}/.venv'
