# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Build the wheel and test it in empty environments: function, times and sizes.

    python -m tools.try_install [--keep] PYTHON...

For each Python given by path, with the oldest libraries that the metadata allow and with the
newest: install the wheel with pip, simulate half a day, identify it with nothing compiled, and
identify it again. Each step is told on stderr when it begins. With ``--keep`` the table is written
to benchmarks/results/install.json.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
# The libraries with a lower bound in setup.py, at that bound.
OLDEST = ('numpy==1.26.*', 'scipy==1.11.*', 'pandas==2.1.*', 'numba==0.59.*')
SETS: dict[str, tuple[str, ...]] = {'oldest': OLDEST, 'newest': ()}
# Numba 0.59 supports no later Python.
LAST_OF_OLDEST = (3, 12)
LIBRARIES = re.compile(r'(numpy|scipy|pandas|numba)==(\S+)')
IDENTIFY = ('identify', 'plant.mcap', '-o', 'result', '--quiet')


class FailedError(Exception):
    """A command failed; the message is its output."""


def say(step: str) -> None:
    """Print the step that begins now."""
    print(f'{time.strftime("%H:%M:%S")} {step}', file=sys.stderr, flush=True)


def run(command: list[str | Path], folder: Path, **environment: str) -> tuple[float, str]:
    """Run a command; return its duration in s and its output.

    Raises
    ------
    FailedError
    """
    begun_s = time.monotonic()
    kept = {k: v for k, v in os.environ.items() if k not in ('PYTHONPATH', 'PYTHONHOME')}
    done = subprocess.run(
        command, cwd=folder, env=kept | environment, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise FailedError(f'{" ".join(map(str, command))}: {(done.stdout + done.stderr)[-600:]}')
    return round(time.monotonic() - begun_s, 1), done.stdout


def version(python: str) -> tuple[int, int]:
    """Return the version of a Python."""
    said = run([python, '-c', 'import sys; print(*sys.version_info[:2])'], ROOT)[1]
    major, minor = map(int, said.split())
    return major, minor


def megabytes(folder: Path) -> int:
    """Return the size of the files below a folder in units of 1e6 bytes."""
    return round(sum(p.lstat().st_size for p in folder.rglob('*') if p.is_file()) / 1e6)


def build(folder: Path) -> Path:
    """Build the wheel from the tracked files, so that it contains nothing else."""
    tree = folder / 'tree'
    for name in run(['git', 'ls-files', '-z'], ROOT)[1].split('\0'):
        if name and (ROOT / name).is_file():
            (tree / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, tree / name)
    run([sys.executable, '-m', 'pip', 'wheel', '--no-deps', '-w', folder, tree], folder)
    return next(folder.glob('*.whl'))


def trial(python: str, wheel: Path, libraries: tuple[str, ...], folder: Path) -> dict[str, Any]:
    """Install the wheel and use it; return times in s, sizes in MB and versions."""
    say('an empty environment is made')
    run([python, '-m', 'venv', folder / 'venv'], folder)
    inside = folder / 'venv' / 'bin'
    empty = megabytes(folder / 'venv')
    say('wheel and libraries are downloaded and installed')
    install_s, _ = run([inside / 'python', '-m', 'pip', 'install', wheel, *libraries], folder)
    size = megabytes(folder / 'venv') - empty
    frozen = run([inside / 'python', '-m', 'pip', 'freeze'], folder)[1]
    cache = {'NUMBA_CACHE_DIR': str(folder / 'compiled')}
    say('half a day is simulated')
    help_s, _ = run([inside / 'valveflow', '--help'], folder)
    run([inside / 'valveflow', 'simulate', '-o', 'plant.mcap', '--days', '0.5'], folder, **cache)
    # Remove the simulation's compiled code, which would shorten the first identification.
    shutil.rmtree(folder / 'compiled')
    say('first identify; the program is compiled')
    first_s, _ = run([inside / 'valveflow', *IDENTIFY], folder, **cache)
    say('second identify')
    again_s, _ = run([inside / 'valveflow', *IDENTIFY], folder, **cache)
    return {
        'versions': dict(LIBRARIES.findall(frozen)), 'install_s': install_s, 'size_mb': size,
        'help_s': help_s, 'first_identify_s': first_s, 'second_identify_s': again_s,
    }  # fmt: skip


def main() -> int:
    """Test every Python with every set of libraries; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument('python', nargs='*', default=[sys.executable])
    parser.add_argument('--keep', action='store_true', help='write the result')
    options = parser.parse_args()
    rows, failed = [], 0
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        try:
            say('the wheel is built')
            wheel = build(folder)
            pythons = {path: version(path) for path in options.python}
        except (FailedError, OSError) as error:
            print(f'try_install: {error}', file=sys.stderr)
            return 1
        print('Python  libraries  install  size    --help  first identify  second', flush=True)
        for path, number in pythons.items():
            for which, libraries in SETS.items():
                if which == 'oldest' and number > LAST_OF_OLDEST:
                    continue
                place = folder / 'trial'
                place.mkdir()
                name = '{}.{}'.format(*number)
                say(f'Python {name} with the {which} libraries:')
                try:
                    row = trial(path, wheel, libraries, place)
                except FailedError as error:
                    failed += 1
                    print(f'{name:<7} {which:<10} failed: {error}', flush=True)
                else:
                    rows.append({'python': name, 'libraries': which, **row})
                    print(
                        f'{name:<7} {which:<10} {row["install_s"]:5.1f} s  {row["size_mb"]} MB  '
                        f'{row["help_s"]:4.1f} s  {row["first_identify_s"]:10.1f} s    '
                        f'{row["second_identify_s"]:6.1f} s', flush=True,
                    )  # fmt: skip
                shutil.rmtree(place)
        if options.keep and not failed:
            result = {
                'command': 'python -m tools.try_install --keep PYTHON...',
                'machine': platform.machine(), 'cpus': os.cpu_count(),
                'load_average': round(os.getloadavg()[0], 1),
                'wheel_mb': round(wheel.stat().st_size / 1e6, 1), 'results': rows,
            }  # fmt: skip
            kept = ROOT / 'benchmarks' / 'results' / 'install.json'
            kept.write_text(json.dumps(result, indent=2) + '\n', encoding='utf-8')
    return 1 if failed else 0


if __name__ == '__main__':
    sys.exit(main())
