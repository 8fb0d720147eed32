# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Set up the tree: wheels into .venv, the two packages into install/.

Each step leaves a stamp, a hash of everything it depends on, and is skipped
while the stamp fits. What is missing is said in one sentence.
"""

from __future__ import annotations

import fcntl
import os
import platform
import sys
import time
from pathlib import Path

from machine import check_machine
from packages import build_packages, check_install, packages_done
from tree import INSTALL, LOG, PYTHON, ROOT, VENV, SetupError, run, say, stamp, stamped
from wheels import install_wheels, make_venv, repair_cmake, wheels_key


def compile_ahead(folder: Path, log: Path) -> None:
    """Compile modules to bytecode, which no installer here does.

    Without it the first start takes three times as long, and every start does where Python may not
    write beside its modules. A file that cannot be compiled is one that nobody imports.
    """
    run([PYTHON, '-m', 'compileall', '-q', '-j', '0', folder], log)


def steps() -> None:
    """Do what has not been done yet."""
    wheels = wheels_key()
    if stamped(VENV, wheels) and packages_done(wheels):
        return
    check_machine()
    check_install()
    LOG.mkdir(exist_ok=True)
    log = LOG / 'setup.log'
    log.write_text('', encoding='utf-8')
    if not stamped(VENV, wheels):
        say(f'Python {platform.python_version()} ({sys.executable}), packages into .venv ...')
        begun = time.monotonic()
        make_venv(log)
        install_wheels(log)
        repaired = repair_cmake()
        compile_ahead(VENV / 'lib', log)
        stamp(VENV, wheels)
        say(f'installed in {time.monotonic() - begun:.0f} s, {repaired} CMake files repaired')
    begun = time.monotonic()
    build_packages(wheels, log)
    for folder in (INSTALL, ROOT / 'valveflow_ros'):
        compile_ahead(folder, log)
    say(f'built in {time.monotonic() - begun:.0f} s; next: source env.sh')


def main() -> int:
    """Set up, one at a time in a folder, and turn every failure into a sentence."""
    folder = os.open(ROOT, os.O_RDONLY)
    try:
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            say('another set-up works in this folder; waiting for it')
            fcntl.flock(folder, fcntl.LOCK_EX)
        steps()
    except SetupError as error:
        say(str(error))
        return 1
    except OSError as error:
        say(f'{error.filename or ROOT}: {error.strerror}')
        return 1
    except KeyboardInterrupt:
        say('interrupted; run make setup again to go on')
        return 130
    finally:
        os.close(folder)
    return 0


if __name__ == '__main__':
    sys.exit(main())
