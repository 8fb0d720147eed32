# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Common parts of the set-up: the tree's folders, stamps, running a command.

It uses the standard library only, because it runs before anything is installed.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
VENV = ROOT / '.venv'
PYTHON = VENV / 'bin' / 'python'
INSTALL = ROOT / 'install'
BUILD = ROOT / 'build'
LOG = ROOT / 'log'
STAMP = '.valveflow-setup'

# Variables of another ROS, another environment or an outer make, not for child processes.
FOREIGN = (
    'AMENT_PREFIX_PATH',
    'CMAKE_PREFIX_PATH',
    'COLCON_PREFIX_PATH',
    'LD_LIBRARY_PATH',
    'MAKEFLAGS',
    'MAKELEVEL',
    'MFLAGS',
    'PIP_PREFIX',
    'PIP_TARGET',
    'PIP_USER',
    'PYTHONHOME',
    'PYTHONPATH',
    'VIRTUAL_ENV',
    '_ROS_WHEELS_BOOTSTRAP_COMPLETE',
)
# Texts in the output of pip, uv and compilers, and their explanation for the user.
KNOWN = (
    (r'no space left', 'no space left on the disk'),
    (r'name resolution|name or service not known|dns error', 'the registry has no address here'),
    (r'certificate', 'the certificate of the registry was not accepted'),
    (r'timed out', 'the registry did not answer in time'),
    (r'connection (broken|refused|reset)|unreachable', 'no connection to the registry'),
    (
        r'do not match the hashes|hash mismatch',
        'a file has another hash than in requirements.lock',
    ),
)


class SetupError(Exception):
    """Something is missing; the message is one sentence with the solution."""


def say(text: str) -> None:
    """Print a progress message."""
    print(f'setup: {text}', file=sys.stderr, flush=True)


def digest(parts: Iterable[bytes]) -> str:
    """Return one hash of byte strings; their lengths are included to separate them."""
    total = hashlib.sha256()
    for part in parts:
        total.update(b'%d:' % len(part))
        total.update(part)
    return total.hexdigest()


def contents(paths: Iterable[Path]) -> Iterator[bytes]:
    """Yield the names and the bytes of files, in the given order."""
    for path in paths:
        yield str(path.relative_to(ROOT)).encode()
        yield path.read_bytes()


def stamped(folder: Path, key: str) -> bool:
    """Return True if the step that fills ``folder`` was done for ``key``."""
    with contextlib.suppress(OSError):
        return (folder / STAMP).read_text(encoding='ascii') == key
    return False


def stamp(folder: Path, key: str) -> None:
    """Mark the step as done; called last, so that an interrupted step is repeated."""
    (folder / STAMP).write_text(key, encoding='ascii')


def clean_environment(**more: str) -> dict[str, str]:
    """Return this process's environment without the variables of another ROS or Python."""
    env = {name: value for name, value in os.environ.items() if name not in FOREIGN}
    env['PATH'] = f'{VENV / "bin"}{os.pathsep}{env.get("PATH", os.defpath)}'
    return env | more


def run(command: Sequence[str | Path], log: Path, **env: str) -> str | None:
    """Run a command with its output in ``log``; return None, or why it failed."""
    with log.open('a', encoding='utf-8') as out:
        out.write(f'\n$ {" ".join(map(str, command))}\n')
        out.flush()
        begun = out.tell()
        done = subprocess.run(
            command, cwd=ROOT, env=clean_environment(**env), stdout=out, stderr=out, check=False
        )
    if done.returncode == 0:
        return None
    with log.open(encoding='utf-8', errors='replace') as said:
        said.seek(begun)
        return reason(said.read())


def reason(output: str) -> str:
    """Return why a command failed, from its output: a known cause, or the relevant line."""
    for pattern, meaning in KNOWN:
        if re.search(pattern, output, re.IGNORECASE):
            return meaning
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    for line in lines:
        if re.search(r'error\b|failed|not found', line, re.IGNORECASE):
            return line[:300]
    return lines[-1][:300] if lines else 'it printed nothing'
