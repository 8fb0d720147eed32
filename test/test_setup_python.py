# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Which Python the set-up takes, and what it says when none will do."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture
def bare(tmp_path):
    """A folder with a set-up that only reports who runs it, and an empty PATH to fill."""
    (tmp_path / 'tools').mkdir()
    (tmp_path / 'bin').mkdir()
    shutil.copy(ROOT / 'tools' / 'setup.sh', tmp_path / 'tools')
    script = 'import sys; print("handed over to %d.%d" % sys.version_info[:2])\n'
    (tmp_path / 'tools' / 'setup_tree.py').write_text(script)
    for tool in ('dirname', 'sed', 'sh'):
        (tmp_path / 'bin' / tool).symlink_to(shutil.which(tool))
    return tmp_path


def add(bare, name, text):
    """Put a program on the PATH of the bare machine."""
    program = bare / 'bin' / name
    program.write_text(f'#!/bin/sh\n{text}\n')
    program.chmod(0o755)
    return program


def real(bare, *blocked):
    """A line that runs this Python as if it lacked some modules."""
    missing = bare / 'missing'
    missing.mkdir(exist_ok=True)
    for module in blocked:
        (missing / f'{module}.py').write_text('raise ImportError')
    # The wheels of ROS start Python twice, and would do so without the path given here.
    start = f'PYTHONPATH={missing} _ROS_WHEELS_BOOTSTRAP_COMPLETE=1'
    return f'{start} exec {sys.executable} "$@"'


def set_up(bare, **env):
    """Run the set-up on the bare machine."""
    return subprocess.run(
        [shutil.which('sh'), bare / 'tools' / 'setup.sh'],
        env={'PATH': str(bare / 'bin')} | env,
        capture_output=True,
        text=True,
        check=False,
    )


def assert_one_sentence(done, *words):
    """It failed, and said why in one line that holds the words."""
    assert done.returncode == 1
    assert done.stdout == ''
    assert done.stderr.startswith('setup: ')
    assert done.stderr.count('\n') == 1
    for word in words:
        assert word in done.stderr


def test_no_python_at_all(bare):
    assert_one_sentence(set_up(bare), 'no CPython 3.10, 3.11 or 3.12', 'sudo apt install python3')


def test_a_shim_that_does_not_run_is_passed_over(bare):
    add(bare, 'python3.12', 'echo "shim: python3.12: command not found" >&2; exit 127')
    add(bare, 'python3', real(bare))
    done = set_up(bare)
    assert done.returncode == 0
    assert done.stdout == 'handed over to {}.{}\n'.format(*sys.version_info[:2])


def test_a_wrong_python_is_named(bare):
    add(bare, 'python3', 'echo "wrong cpython 3.9"')
    assert_one_sentence(set_up(bare), '(python3 is cpython 3.9)', 'sudo apt install')


@pytest.mark.parametrize('module', ['venv', 'ensurepip'])
def test_a_python_without_venv(bare, module):
    add(bare, 'python3', real(bare, module))
    version = '{}.{}'.format(*sys.version_info[:2])
    assert_one_sentence(set_up(bare), 'venv', f'sudo apt install python{version}-venv')


def test_a_python_without_venv_does_not_hide_a_whole_one(bare):
    add(bare, 'python3.11', real(bare, 'ensurepip'))
    (bare / 'whole').mkdir()
    add(bare, 'python3', f'exec {sys.executable} "$@"')
    assert set_up(bare).returncode == 0


def test_the_python_asked_for_is_the_only_one_tried(bare):
    add(bare, 'python3', real(bare))
    asked = bare / 'bin' / 'python2'
    assert_one_sentence(set_up(bare, PYTHON=str(asked)), f'PYTHON={asked}')
    assert set_up(bare, PYTHON='python3').returncode == 0


def test_what_was_exported_for_another_python_does_no_harm(bare):
    add(bare, 'python3', f'exec {sys.executable} "$@"')
    assert set_up(bare, PYTHONHOME='/nowhere', PYTHONPATH='/nowhere').returncode == 0


def test_the_python_of_the_environment_is_kept(bare):
    version = 'python{}.{}'.format(*sys.version_info[:2])
    (bare / '.venv' / 'lib' / version).mkdir(parents=True)
    (bare / '.venv' / 'pyvenv.cfg').write_text(f'home = {bare / "home"}\n')
    (bare / 'home').mkdir()
    add(bare, '../home/' + version, f'echo kept >&2; exec {sys.executable} "$@"')
    add(bare, 'python3.12', 'echo "good 3.12"')
    done = set_up(bare)
    assert done.returncode == 0
    assert 'kept' in done.stderr
