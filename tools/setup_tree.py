# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Set up the tree: wheels into .venv, the two packages into install/.

Each step writes a stamp, a hash of all its inputs, and is skipped if the stamp
is up to date. A missing requirement is reported in one sentence.
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
    """Compile modules to bytecode, because the installers used here do not.

    Otherwise the first start takes three times as long, and every start if Python may not write
    beside its modules. Files that cannot be compiled are ignored: they are never imported.
    """
    run([PYTHON, '-m', 'compileall', '-q', '-j', '0', folder], log)


def steps() -> None:
    """Run the steps that are not up to date."""
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
    """Set up with a lock on the folder, and report every failure in one sentence."""
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
