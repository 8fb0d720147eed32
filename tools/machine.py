# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Check that this machine is suitable for the set-up; report the first missing item."""

from __future__ import annotations

import os
import platform
import re
import shutil
import sys
import sysconfig
from pathlib import Path

from tree import ROOT, SetupError

OLDEST_GLIBC = (2, 28)
COMPILERS = (
    ('C', 'CC', ('cc', 'gcc', 'clang')),
    ('C++', 'CXX', ('c++', 'g++', 'clang++')),
)


def check_machine() -> None:
    """Raise `SetupError` for the first missing requirement of this machine."""
    check_platform()
    check_path()
    for language, variable, names in COMPILERS:
        check_compiler(language, variable, names)
    if not (shutil.which('make') or shutil.which('gmake')):
        raise SetupError('make not found; on Debian or Ubuntu: sudo apt install make')
    check_headers()


def check_platform() -> None:
    """Raise `SetupError` if there are no wheels of ROS 2 for this machine."""
    libc, version = platform.libc_ver()
    numbers = tuple(int(x) for x in re.findall(r'\d+', version)[:2])
    right = sys.platform == 'linux' and platform.machine() == 'x86_64' and sys.maxsize > 2**32
    if right and libc == 'glibc' and numbers >= OLDEST_GLIBC:
        return
    here = ' '.join(x for x in (sys.platform, platform.machine(), libc, version) if x)
    raise SetupError(
        'ROS 2 Jazzy comes as wheels for Linux on x86_64 with glibc 2.28 or later, and this is '
        f'{here}; install ROS 2 Jazzy itself and build with: colcon build --base-paths . msg'
    )


def check_path() -> None:
    """Raise `SetupError` for a path that shebang lines or the ROS build cannot handle."""
    if re.search(r'[\s:;]', str(ROOT)):
        raise SetupError(
            'the path of this folder holds a blank, a colon or a semicolon, which the ROS build '
            f"cannot take: '{ROOT}'; move the folder to a path without one"
        )


def check_compiler(language: str, variable: str, names: tuple[str, ...]) -> None:
    """Search the compiler like CMake: the environment variable, else the usual names."""
    chosen = os.environ.get(variable, '').split()[:1]
    if any(shutil.which(name) for name in chosen or names):
        return
    looked = f'{variable}={chosen[0]}' if chosen else ', '.join(names)
    raise SetupError(
        f'no {language} compiler found (looked for {looked}); '
        'on Debian or Ubuntu: sudo apt install build-essential'
    )


def check_headers() -> None:
    """Search Python.h, because message packages are C extensions of this Python."""
    if Path(str(sysconfig.get_config_var('INCLUDEPY')), 'Python.h').is_file():
        return
    name = f'python{sys.version_info.major}.{sys.version_info.minor}'
    raise SetupError(
        f'the C headers of {sys.executable} are missing (Python.h); '
        f'on Debian or Ubuntu: sudo apt install {name}-dev'
    )
