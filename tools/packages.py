# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Second step of the set-up: build valveflow_msgs and valveflow_ros by colcon into install/."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from tree import (
    BUILD,
    INSTALL,
    LOG,
    PYTHON,
    ROOT,
    STAMP,
    VENV,
    SetupError,
    contents,
    digest,
    run,
    say,
    stamp,
    stamped,
)

MESSAGES = 'valveflow_msgs'
NODE = 'valveflow_ros'
# Halves the time of the longest step of the set-up; see the file.
QUICK = ROOT / 'tools' / 'quick_build.cmake'
LOADS = f'import rclpy, {NODE}; from {MESSAGES}.msg import PlantSample; PlantSample()'


def messages_key(wheels: str) -> str:
    """Return the hash of the inputs of the interface package."""
    compiler = [os.environ.get(name, '') for name in ('CC', 'CXX', 'CFLAGS', 'CXXFLAGS')]
    words = [x.encode() for x in (wheels, *compiler)]
    files = [*sorted(p for p in (ROOT / 'msg').rglob('*') if p.is_file()), QUICK, Path(__file__)]
    return digest(words + list(contents(files)))


def node_key(messages: str) -> str:
    """Return the hash of the inputs of the node package.

    Its Python files are linked, not copied, so an edit takes effect without a
    build. For the same reason only the file names of launch/ and config/ are used.
    """
    files = [ROOT / name for name in ('package.xml', 'setup.py', 'setup.cfg')]
    names = sorted(str(p) for d in ('config', 'launch') for p in (ROOT / d).glob('*'))
    words = [x.encode() for x in (messages, *names)]
    return digest(words + list(contents([*sorted((ROOT / 'resource').iterdir()), *files])))


def packages_done(wheels: str) -> bool:
    """Return True if both packages in install/ are up to date."""
    messages = messages_key(wheels)
    node = node_key(messages)
    return stamped(INSTALL / MESSAGES, messages) and stamped(INSTALL / NODE, node)


def build_packages(wheels: str, log: Path) -> None:
    """Build packages that are not up to date, and test that they can be imported."""
    INSTALL.mkdir(exist_ok=True)
    stamp(INSTALL, 'unfinished')
    messages = messages_key(wheels)
    for package, key in ((MESSAGES, messages), (NODE, node_key(messages))):
        if stamped(INSTALL / package, key):
            continue
        say(f'{package} into install/ ...')
        # colcon only adds files: those of an older message or entry point would remain.
        for folder in (BUILD / package, INSTALL / package):
            shutil.rmtree(folder, ignore_errors=True)
        problem = colcon_build(package, log)
        if problem is not None:
            raise SetupError(f'{package} could not be built ({problem}); details in {log}')
        if package == NODE:
            link_command()
        stamp(INSTALL / package, key)
    stamp(INSTALL, 'made by make setup')
    problem = run(['bash', '-c', f'. {ROOT}/env.sh && python -c "{LOADS}"'], log)
    if problem is not None:
        raise SetupError(f'what was built does not load ({problem}); details in {log}')


def check_install() -> None:
    """Raise `SetupError` if install/ was created by the user's own colcon and ROS."""
    if INSTALL.exists() and any(INSTALL.iterdir()) and not (INSTALL / STAMP).exists():
        raise SetupError(
            'install/ holds a build that make setup did not make; move it away or run make clean'
        )


def link_command() -> None:
    """Link only `valveflow` into the folder in PATH; the nodes are for ros2 and launch files."""
    command = INSTALL / NODE / 'bin' / 'valveflow'
    command.parent.mkdir(exist_ok=True)
    command.symlink_to(f'../lib/{NODE}/valveflow')


def colcon_build(package: str, log: Path) -> str | None:
    """Run colcon; return None, or why it failed."""
    command: list[str | Path] = [VENV / 'bin' / 'colcon', '--log-base', LOG, 'build']
    # colcon does not search inside a package, so the interface package is named.
    command += ['--base-paths', ROOT, ROOT / 'msg', '--packages-select', package]
    command += ['--build-base', BUILD, '--install-base', INSTALL, '--symlink-install']
    command += ['--event-handlers', 'console_direct+', '--cmake-args', '-DBUILD_TESTING=OFF']
    command += [f'-DPython3_EXECUTABLE={PYTHON}', f'-DCMAKE_PROJECT_INCLUDE={QUICK}']
    return run(
        command,
        log,
        AMENT_PREFIX_PATH=str(VENV),
        CMAKE_PREFIX_PATH=str(VENV),
        VIRTUAL_ENV=str(VENV),
        # By default colcon also limits the load, and on a busy machine builds one file at a time.
        MAKEFLAGS=f'-j{os.cpu_count() or 1}',
        # The user's own colcon defaults are for other workspaces.
        COLCON_HOME=str(BUILD / 'colcon_home'),
        COLCON_DEFAULTS_FILE=os.devnull,
    )
