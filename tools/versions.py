# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Copy the tree with its own lock file, for tests with other Pythons and libraries.

    python tools/versions.py PYTHON

The copy is in build/versions/ and is set up and tested like any other tree, so this tree is not
changed. The folder of the copy is printed.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

from tree import BUILD, ROOT, VENV, SetupError, clean_environment, reason, say

# Versions in Ubuntu 24.04, the platform of Jazzy, with its Python 3.12. Other Pythons get the
# newest versions. pyarrow 26 refuses NumPy 1.
UBUNTU = {
    '3.12': ('numpy==1.26.4', 'scipy==1.11.4', 'pandas==2.1.4', 'numba==0.59.1', 'pyarrow<26'),
}
# Created by the set-up of the copy; they are kept so that a second run needs no set-up.
KEPT = ('.venv', 'build', 'install', 'log')


def output(command: list[str | Path], text: str = '') -> str:
    """Return the output of a command; raise `SetupError` if it fails."""
    try:
        done = subprocess.run(
            command, cwd=ROOT, env=clean_environment(), input=text, capture_output=True,
            text=True, check=False,
        )  # fmt: skip
    except OSError as error:
        raise SetupError(f'{command[0]}: {error.strerror}') from None
    if done.returncode:
        raise SetupError(f'{Path(command[0]).name} failed: {reason(done.stderr)}')
    return done.stdout


def version_of(python: str) -> str:
    """Return the version of a Python, such as '3.12'."""
    return output([python, '-c', 'import sys; print("%d.%d" % sys.version_info[:2])']).strip()


def copy_tree(tree: Path) -> None:
    """Copy the files of the checkout into ``tree``, including uncommitted ones."""
    tree.mkdir(parents=True, exist_ok=True)
    for path in tree.iterdir():
        if path.name not in KEPT:
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    listed = output(['git', 'ls-files', '-z', '--cached', '--others', '--exclude-standard'])
    for name in filter(None, listed.split('\0')):
        if (ROOT / name).is_file():
            (tree / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, tree / name)


def lock_for(version: str) -> str:
    """Return a lock file for one version of Python."""
    command: list[str | Path] = [VENV / 'bin' / 'uv', 'pip', 'compile', '--quiet']
    command += ['--python-version', version, '--generate-hashes', '--no-emit-index-url']
    return output(
        [*command, '--no-header', '--constraint', '-', 'requirements.in'],
        '\n'.join(UBUNTU.get(version, ())),
    )


def main(python: str) -> int:
    """Make the copy and print its folder; return the exit status."""
    try:
        version = version_of(python)
        lock = lock_for(version)
        tree = BUILD / 'versions' / version
        copy_tree(tree)
        (tree / 'requirements.lock').write_text(lock, encoding='utf-8')
    except SetupError as error:
        say(str(error))
        return 1
    print(tree)
    return 0


if __name__ == '__main__':
    sys.exit(main(*sys.argv[1:]))
