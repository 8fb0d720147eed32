# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Freeze what the command writes and says, and compare it with what another tree gives.

    python -m benchmarks.goldens make DIR [--recordings FOLDER]
    python -m benchmarks.goldens compare A B

Only the outside is used: each case is a process of `valveflow_ros` from the tree that this file
lies in, run in a folder of its own with relative names. Frozen are its status, both outputs, and
every file that it made or changed: JSON and text as they are, of a report what is to be read and
the data of its figures, of anything else or longer the SHA-256. FOLDER holds recordings of a
monitor; each is verified, watched, looked into and identified. The exit status of `compare` is 1
if anything differs.
"""

from __future__ import annotations

import argparse
import hashlib
import html.parser
import itertools
import json
import math
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
TEXTS = ('.csv', '.json', '.txt', '.yaml')
LONGEST = 1_000_000
# These come when work takes long or is done for the first time.
_TIMED = re.compile(r'^( *\d+ % .*|The program is now compiled .*)\n', re.MULTILINE)
# Names of clipping paths in an SVG file hang on where things lay in memory.
_CLIP = re.compile(r'\bp[0-9a-f]{10}\b')
_SPOKEN = ('aria-label', 'data-label', 'title', 'content')

PLANTS = {
    'plain.mcap': ('2', '1', '--truth', 'truth.json'),
    'slack.mcap': ('2', '3', '--effect', 'backlash:w_percent=2'),
    'gain.mcap': ('2', '4', '--effect', 'gain_step:g=0.03,t0_days=1'),
    'step.mcap': ('3', '5', '--effect', 'curve_step:s_mw=-12,t0_days=1.5'),
    'choked.mcap': ('1', '6', '--effect', 'choked'),
    'spoilt.mcap': (
        '1', '7', '--effect', 'spikes:per_day=60', '--effect', 'stiction:s_percent=2',
        '--effect', 'flatline:minutes=90,t0_days=0.4', '--json',
    ),
    'bag': ('1', '2', '--effect', 'reheater', '--effect', 'exponent'),
    'day.csv': ('1', '8', '--effect', 'region_lag', '--effect', 'temperature'),
    'day.parquet': ('1', '9', '--effect', 'clock:d_s=20', '--quiet'),
    'short.csv': ('0.05', '1'),
}  # fmt: skip
# Cases in their order: the name is also that of the folder that takes the results.
CASES = """
identify plain.mcap --table
identify plain.mcap --json --reference identify-1/characteristic.json --figures
identify slack.mcap --set time_constant=120 --set hold_limit=40
identify gain.mcap --json --reference identify-1/characteristic.json
identify step.mcap
identify choked.mcap
identify spoilt.mcap
identify bag --quiet
identify day.csv
identify day.parquet --json
identify gaps.csv
identify hurt.mcap
identify german.csv --time-zone Europe/Berlin
identify test.csv
identify test.csv --step-test --table
diagnose plain.mcap --json
diagnose slack.mcap --table
diagnose gain.mcap --model identify-1/characteristic.json
diagnose step.mcap --figures
diagnose spoilt.mcap
diagnose gaps.csv --json
identify gain.mcap --model diagnose-3/extended_model.json
validate bag --model identify-1/characteristic.json
validate step.mcap --model identify-1/characteristic.json --against identify-5/characteristic.json
validate gain.mcap --model diagnose-3/extended_model.json --json --tolerance 0.5
compare plain.mcap --truth truth.json
compare day.csv --test choked.mcap --json
compensate --model identify-1/characteristic.json -o inverse.csv --pressure 16.7 --pressure 12
compensate --model identify-5/characteristic.json -o inverse.parquet --points 40 --json
info plain.mcap
info spoilt.mcap --json
info bag
info gaps.csv
info day.parquet --json
info broken.mcap
info german.csv --time-zone Europe/Berlin
export bag -o bag.csv
export spoilt.mcap -o spoilt.csv --set sample_period=10 --json
export gaps.csv -o gaps.parquet
import gaps.csv -o gaps.mcap
import german.csv -o german.mcap --time-zone Europe/Berlin --json
import german.csv --dry-run
import long.csv -o long
import plant_tags.csv -o tags.mcap --column time=STAMP --column valve_opening=POS:fraction \
 --column main_steam_pressure=P1:bar --column generated_power=MW \
 --constant main_steam_temperature=540
recover broken.mcap -o whole.mcap
recover hurt.mcap -o mended.mcap --json
info mended.mcap
watch plain.mcap
watch bag --once
watch broken.mcap --once --json
config init plain.mcap -o plain.yaml --unit-tag U3
config init gaps.csv --json
config check plain.yaml
config check bad.yaml
identify plain.mcap --params plain.yaml
completion bash
completion zsh
completion fish
simulate --effects
--version
--help
identfy plain.mcap
identify plain.mcap
identify gone.mcap
identify words.mcap
identify short.csv
identify plant_tags.csv
identify plain.mcap --set time_constnt=3
identify plain.mcap --set time_constant=1e9
identify plain.mcap --params bad.yaml
identify plain.mcap --step-test
identify plain.mcap --model identify-1/characteristic.json
diagnose short.csv
diagnose plain.mcap --model truth.json
validate plain.mcap --model words.mcap
validate short.csv --model identify-1/characteristic.json
compare short.csv
compare plain.mcap --test gone.mcap
compensate --model gone.json -o gone.csv
compensate --model identify-1/characteristic.json -o inverse.csv
simulate -o plain.mcap
simulate -o other.csv --days 0
simulate -o other.csv --days 1 --effect stictoin
simulate -o other.csv --days 1 --effect stiction:s=1
export plain.mcap -o plain.txt
export words.mcap -o words.csv
import plant_tags.csv -o other.mcap
import plain.mcap -o plain.mcap
recover words.mcap -o other.mcap
recover broken.mcap -o whole.mcap
watch day.csv
watch gone
watch plain.mcap --json
config check gone.yaml
config make plain.mcap
completion tcsh
info
"""
VERBS = 'simulate import info identify diagnose validate compare compensate export recover config'
INTO_FOLDER = ('identify', 'diagnose', 'validate', 'compare')
# What these verbs are given without a place for their results is a refusal of its own.
NO_PLACE = 'identify plain.mcap'


class _Reader(html.parser.HTMLParser):
    """Keeps what a page says, and apart from that the data of its figures."""

    def __init__(self) -> None:
        super().__init__()
        self.words: list[str] = []
        self.figures = '{}'
        self._skipped = ''

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag in ('script', 'style'):
            self._skipped = dict(attrs).get('id') or tag
        self.words += [f'[{k}] {v}' for k, v in attrs if k in _SPOKEN and v]

    def handle_endtag(self, tag: str) -> None:
        self._skipped = ''

    def handle_data(self, data: str) -> None:
        if self._skipped == 'figures':
            self.figures = data
        elif not self._skipped and data.strip():
            self.words.append(data.strip())


class Maker:
    """Runs cases in one scratch folder and keeps what comes of them.

    Parameters
    ----------
    work, kept : Path
        The scratch folder, and where the goldens go.
    """

    def __init__(self, work: Path, kept: Path) -> None:
        self.work, self._kept = work, kept
        self._environment = {
            **os.environ, 'LC_ALL': 'C.UTF-8', 'TZ': 'UTC', 'TERM': 'dumb', 'COLUMNS': '100',
            'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST', 'ROS_DOMAIN_ID': str(os.getpid() % 101),
            'PYTHONPATH': f'{ROOT}{os.pathsep}{os.environ.get("PYTHONPATH", "")}',
        }  # fmt: skip

    def run(self, name: str, module: str, *words: str) -> None:
        """Run a module of the package and keep what it said, made and changed."""
        before, begun_s = self._state(), time.monotonic()
        done = subprocess.run(
            [sys.executable, '-m', f'valveflow_ros.{module}', *words], cwd=self.work,
            env=self._environment, stdin=subprocess.DEVNULL, capture_output=True, check=False,
        )  # fmt: skip
        seconds = time.monotonic() - begun_s
        print(f'{seconds:6.1f} s  {done.returncode}  {name}: {" ".join(words)}', flush=True)
        place = self._kept / name
        place.mkdir(parents=True)
        out = 'stdout.json' if '--json' in words and done.stdout[:1] in b'{[' else 'stdout.txt'
        (place / out).write_bytes(done.stdout)
        said = _TIMED.sub('', done.stderr.decode())
        (place / 'stderr.txt').write_text(f'{words}\nstatus {done.returncode}\n{said}', 'utf-8')
        after = self._state()
        for path in sorted(after):
            if after[path] != before.get(path):
                self._keep(path, place)
        gone = ''.join(f'{p.relative_to(self.work)}\n' for p in sorted(set(before) - set(after)))
        if gone:
            (place / 'gone.txt').write_text(gone, 'utf-8')

    def _state(self) -> dict[Path, tuple[int, int, int]]:
        found = ((p, p.stat()) for p in self.work.rglob('*') if p.is_file())
        return {p: (s.st_size, s.st_mtime_ns, s.st_ino) for p, s in found}

    def _keep(self, path: Path, place: Path) -> None:
        whole = path.read_bytes()
        target = place / '+'.join(path.relative_to(self.work).parts)
        if path.suffix == '.html':
            reader = _Reader()
            reader.feed(whole.decode())
            target.with_suffix('.txt').write_text('\n'.join(reader.words) + '\n', 'utf-8')
            target.with_suffix('.figures.json').write_text(reader.figures, 'utf-8')
        elif path.suffix == '.svg':
            target.write_text(_with_plain_names(whole.decode()), 'utf-8')
        elif path.suffix in TEXTS and len(whole) <= LONGEST:
            target.write_bytes(whole)
        else:
            told = f'{hashlib.sha256(whole).hexdigest()}  {len(whole)} bytes\n'
            target.with_name(f'{target.name}.sha256').write_text(told, 'utf-8')


def _with_plain_names(svg: str) -> str:
    names: dict[str, str] = {}
    return _CLIP.sub(lambda m: names.setdefault(m[0], f'clip{len(names)}'), svg)


def tables(work: Path) -> None:
    """Write the tables that no verb makes: gaps, other dialects, a step test, damage."""
    rows = [line.split(',') for line in (work / 'day.csv').read_text().splitlines()]
    head, rows = rows[0], rows[1:]
    chance = random.Random(1)
    gaps = [r[:] for k, r in enumerate(rows) if not 20_000 <= k < 22_500 and k % 5000 != 17]
    for row in chance.sample(gaps, 900):
        row[chance.randrange(1, 5)] = chance.choice(('', 'Bad', 'NaN', '-9999'))
    _write(work / 'gaps.csv', [head, *gaps])
    names = ['Zeit', 'Ventilstellung [%]', 'Frischdampfdruck [bar]', 'Frischdampftemperatur [°C]',
             'Leistung [MW]']  # fmt: skip
    times = [datetime.fromisoformat(r[0].rstrip('Z')) for r in rows]
    german = [
        [f'{t:%d.%m.%Y %H:%M:%S}', r[1], f'{10 * float(r[2]):.2f}', r[3], r[4]]
        for t, r in zip(times[::5], rows[::5], strict=True)
    ]
    _write(
        work / 'german.csv',
        [names, *([r[0], *(c.replace('.', ',') for c in r[1:])] for r in german)],
        ';',
    )
    tags = ('HP.CV.POS', 'HP.MS.P', 'HP.MS.T', 'GEN.MW')
    units = ('%', 'MPa', 'degC', 'MW')
    _write(work / 'long.csv', [['time', 'tag', 'value', 'unit']] + [
        [r[0], tags[k], r[k + 1], units[k]] for r in rows[:20_000:2] for k in range(4)
    ])  # fmt: skip
    _write(work / 'plant_tags.csv', [['STAMP', 'POS', 'P1', 'MW']] + [
        [r[0], f'{float(r[1]) / 100:.5f}', f'{10 * float(r[2]):.2f}', r[4]] for r in rows[:9000]
    ])  # fmt: skip
    power, held = 100.0, []
    for k, time_s in enumerate(range(0, 14 * 900, 2)):
        opening = 45.0 + 4.0 * (time_s // 900)
        u = opening * 16.7**1.125
        rest = 110.0 + 0.24 * min(u - 1050, 250) + 0.12 * max(u - 1300, 0)
        power += (rest - power) * 0.08
        told = times[0] + timedelta(seconds=time_s)
        held.append([f'{told:%Y-%m-%dT%H:%M:%SZ}', f'{opening:.2f}', '16.700', '538.0',
                     f'{power + chance.gauss(0, 0.4) + 0.01 * (k % 3):.2f}'])  # fmt: skip
    _write(work / 'test.csv', [head[:5], *held])
    whole = (work / 'plain.mcap').read_bytes()
    (work / 'broken.mcap').write_bytes(whole[: len(whole) * 3 // 5])
    hurt = bytearray(whole)
    for at in range(1_000_000, len(hurt), 3_000_000):
        hurt[at : at + 64] = bytes(64)
    (work / 'hurt.mcap').write_bytes(hurt)
    (work / 'words.mcap').write_text('These are words and no recording.\n')
    (work / 'bad.yaml').write_text(
        '/**:\n  ros__parameters:\n    time_constant: -3.0\n    windw_days: 4.0\n'
    )


def _write(path: Path, rows: list[list[str]], mark: str = ',') -> None:
    path.write_text(''.join(mark.join(row) + '\n' for row in rows), 'utf-8')


def make(kept: Path, recordings: Path | None) -> None:
    """Make all goldens into a folder, which must not be there yet."""
    kept.mkdir(parents=True)
    os.umask(0o022)
    with tempfile.TemporaryDirectory(prefix='goldens_') as scratch:
        maker = Maker(Path(scratch), kept)
        for log, (days, seed, *more) in PLANTS.items():
            words = ('simulate', '-o', log, '--days', days, '--seed', seed, *more)
            maker.run(f'simulate-{log}', 'cli', *words)
        tables(maker.work)
        count: dict[str, int] = {}
        for line in CASES.strip().splitlines():
            words = tuple(line.split())
            verb = words[0].strip('-')
            count[verb] = count.get(verb, 0) + 1
            name = f'{verb}-{count[verb]}'
            if verb in INTO_FOLDER and line != NO_PLACE:
                words += ('-o', name)
            maker.run(name, 'cli', *words)
        for verb in (*VERBS.split(), 'watch', 'completion'):
            maker.run(f'help-{verb}', 'cli', verb, '--help')
        if recordings:
            live(maker, recordings)


def live(maker: Maker, recordings: Path) -> None:
    """Freeze what is made of recordings of a monitor, and the pages of the executables."""
    for main in ('monitor', 'simulator', 'replay', 'watch'):
        maker.run(f'help-ros-{main}', f'ros.{main}_main', '--help')
    for folder in sorted(p for p in recordings.iterdir() if p.is_dir()):
        log = folder.name
        shutil.copytree(folder, maker.work / log)
        maker.run(f'live-{log}-verify', 'ros.replay_main', log, '--verify')
        maker.run(f'live-{log}-watch', 'cli', 'watch', log)
        maker.run(f'live-{log}-once', 'cli', 'watch', log, '--once', '--json')
        maker.run(f'live-{log}-info', 'cli', 'info', log)
        maker.run(f'live-{log}-info-json', 'cli', 'info', log, '--json')
        maker.run(f'live-{log}-identify', 'cli', 'identify', log, '-o', f'{log}-identify')


def _leaves(value: Any, path: str = '') -> Iterator[tuple[str, Any]]:
    """Yield the path and the value of everything in a JSON text, containers by their size."""
    if isinstance(value, dict | list):
        yield path, f'{type(value).__name__} of {len(value)}'
        pairs = value.items() if isinstance(value, dict) else enumerate(value)
        for key, inner in pairs:
            yield from _leaves(inner, f'{path}.{key}' if path else str(key))
    else:
        yield path, value


def _json_difference(a: str, b: str) -> str:
    first, count, largest = '', 0, 0.0
    for (path, x), (other, y) in itertools.zip_longest(
        _leaves(json.loads(a)), _leaves(json.loads(b)), fillvalue=('nothing', None)
    ):
        if path != other:
            return first or f'{path!r} against {other!r}'
        if repr(x) == repr(y):
            continue
        first = first or f'{path}: {x!r} against {y!r}'
        count += 1
        if isinstance(x, int | float) and isinstance(y, int | float):
            scale = max(abs(x), abs(y))
            share = abs(x - y) / scale if scale and math.isfinite(scale) else math.inf
            largest = max(largest, share)
    if not first:
        return 'the same values, written otherwise'
    return f'{first}; {count} differ, numbers by {largest:.2g} at most'


def _text_difference(a: str, b: str) -> str:
    pairs = itertools.zip_longest(a.splitlines(), b.splitlines(), fillvalue='(no line)')
    for number, (x, y) in enumerate(pairs, 1):
        if x != y:
            return f'line {number}\n    {x[:300]}\n    {y[:300]}'
    return 'only ends of lines'


def difference(a: Path, b: Path) -> str:
    """Say in words how two files differ; nothing if they do not."""
    if not a.exists() or not b.exists():
        return f'only in {(a if a.exists() else b).parents[1]}'
    x, y = a.read_text('utf-8'), b.read_text('utf-8')
    # The order of the keys of a figure says nothing; that of a result's JSON is kept.
    if x == y or (a.name.endswith('.figures.json') and json.loads(x) == json.loads(y)):
        return ''
    return _json_difference(x, y) if a.suffix == '.json' else _text_difference(x, y)


def compare(a: Path, b: Path) -> int:
    """Print what differs between two folders; return how many files do."""
    names = sorted({p.relative_to(r) for r in (a, b) for p in r.rglob('*') if p.is_file()})
    told = {name: words for name in names if (words := difference(a / name, b / name))}
    for name, words in told.items():
        print(f'{name}: {words}')
    print(f'{len(told)} of {len(names)} files differ.')
    return len(told)


def main() -> int:
    """Run it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    verbs = parser.add_subparsers(dest='verb', required=True)
    made = verbs.add_parser('make')
    made.add_argument('folder', type=Path)
    made.add_argument('--recordings', type=Path)
    compared = verbs.add_parser('compare')
    compared.add_argument('a', type=Path)
    compared.add_argument('b', type=Path)
    given = parser.parse_args()
    if given.verb == 'compare':
        return 1 if compare(given.a, given.b) else 0
    make(given.folder, given.recordings)
    return 0


if __name__ == '__main__':
    sys.exit(main())
