# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""First step of the set-up: create .venv with the packages of requirements.lock only."""

from __future__ import annotations

import os
import re
import shutil
import sys
import sysconfig
from pathlib import Path

from tree import LOG, PYTHON, ROOT, VENV, SetupError, contents, digest, run, say

LOCK = ROOT / 'requirements.lock'
# Published as source only. Both are pure Python and are built with the pinned
# setuptools, so that only the version in the lock file is downloaded.
SOURCE_ONLY = ('empy', 'notify2')


def wheels_key() -> str:
    """Return the hash of all inputs of .venv, including paths, because it cannot be moved."""
    who = [sys.version, sys.base_prefix, str(ROOT)]
    return digest([x.encode() for x in who] + list(contents([LOCK, Path(__file__)])))


def make_venv(log: Path) -> None:
    """Create a new .venv.

    It is never updated in place: the ROS wheels contain a second set of metadata,
    so an installer does not recognise half of their files as installed by them.
    """
    shutil.rmtree(VENV, ignore_errors=True)
    problem = run([sys.executable, '-m', 'venv', VENV], log)
    if problem is not None:
        raise SetupError(f'{sys.executable} could not make a virtual environment: {problem}')


def locked(names: tuple[str, ...]) -> str:
    """Return the entries of some packages, with their hashes, from the lock file."""
    entries = re.split(r'\n(?=\S)', LOCK.read_text(encoding='utf-8'))
    return '\n'.join(e for e in entries if re.match(rf'({"|".join(names)})==', e)) + '\n'


def install_wheels(log: Path) -> None:
    """Install the packages of the lock file into .venv, and nothing else.

    uv needs a tenth of pip's time but does not read pip's settings. So pip is tried if uv
    fails, for example because only pip has the settings of a plant's mirror or certificate.
    """
    pip: list[str | Path] = [PYTHON, '-m', 'pip', '--disable-pip-version-check', '--no-input']
    pip += ['install', '--no-deps', '--require-hashes', '--only-binary', ':all:']
    first = LOG / 'installer.txt'
    first.write_text(locked(('setuptools', 'uv')), encoding='utf-8')
    problem = run([*pip, '-r', first], log)
    if problem is None:
        build = [
            '--no-build-isolation',
            *(x for name in SOURCE_ONLY for x in ('--no-binary', name)),
        ]
        uv: list[str | Path] = [VENV / 'bin' / 'uv', 'pip', 'install', '--python', PYTHON]
        uv += ['--no-deps', '--require-hashes', '--only-binary', ':all:', *build, '-r', LOCK]
        if run(uv, log) is not None:
            say('uv did not get through to the registry; trying pip, which has its own settings')
            problem = run([*pip, *build, '-r', LOCK], log)
    if problem is not None:
        raise SetupError(
            f'the Python packages could not be installed: {problem}; check the network, or '
            f"pip's settings for your mirror, and run make setup again; details in {log}"
        )


def repair_cmake() -> int:
    """Point the wheels' exported CMake targets at this Python; return how many files.

    They contain the include paths of the machine that built the wheels with NumPy 2,
    and CMake refuses a path that does not exist. A file is replaced, never written in place:
    it may be a hard link into the installer's cache. A second run changes nothing,
    and only files in .venv are read.
    """
    builder = r'/opt/python/cp\d+-cp\d+'
    version = f'python{sys.version_info.major}.{sys.version_info.minor}'
    include = str(sysconfig.get_config_var('INCLUDEPY'))
    site = str(VENV / 'lib' / version / 'site-packages')
    # NumPy 2 has renamed it.
    headers = f'{site}/numpy/_core/include'
    there = headers if Path(headers).is_dir() else f'{site}/numpy/core/include'
    repaired = 0
    for path in sorted(VENV.glob('share/*/cmake/*.cmake')):
        text = path.read_text(encoding='utf-8')
        right = re.sub(builder + r'/include/python3\.\d+(?=[;"])', lambda _: include, text)
        right = re.sub(
            builder + r'/lib/python3\.\d+/site-packages(?=[;"/])', lambda _: site, right
        )
        right = right.replace(headers, there)
        if right != text:
            fresh = path.with_suffix('.new')
            fresh.write_text(right, encoding='utf-8')
            os.replace(fresh, path)
            repaired += 1
    return repaired
