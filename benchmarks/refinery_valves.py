# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Valves of single control loops, judged by `vf.judge_loop`: simulated loops, 31 measured windows.

    python -m benchmarks.refinery_valves --data DIR

DIR holds ``refinery_valves/index.csv`` and the windows it names: valve command (MV, %) and
process variable (PV) of refinery control loops, with a label for each valve. Without ``--data``
the folder in VALVEFLOW_SHARED_DATA is read, or ``shared/data`` beside this checkout; where there
is none, only simulated loops are scored. Beside the verdict stand the single tests it is made of,
each applied to every window: a window counts as named, sound, or left open, and a valve as the
majority of its windows that were decided.

What was fixed on what: the limits of `valveflow_ros.diagnosis.loop` on simulated loops with seeds
below 300; the result is of seeds from 5000. The measured windows were known while the method was
made: that a valve named on moderate evidence must not be contradicted by Horch's test, and that a
record with few swings is not judged, are rules which simulated loops do not ask for. The two that
the labels call sticking are unlike: the flow valve sticks for all to see, the level valve's
windows are answers to steps of the set point, in which Horch's test is right for no reason that a
simulated loop would confirm.
"""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import valveflow_ros as vf
from benchmarks import study
from benchmarks.refinery_loops import HE, KANO, KINDS, NULLS, STEP_S, simulate_loop
from valveflow_ros.diagnosis.loop import detectors
from valveflow_ros.diagnosis.loop.judge import (
    FAULTS,
    LEAST_GAIN,
    LEAST_TRAVEL,
    NOT_JUDGED,
    LoopJudgement,
    judge_response,
)
from valveflow_ros.records import FloatArray

ROOT = Path(__file__).resolve().parents[1]
FIXED_BELOW = 300
TESTS = ('verdict', 'gain alone', 'travel alone', 'horch', 'yamashita', 'he', 'two of three')


@dataclass(frozen=True)
class Call:
    """What each test says of a record: True for a fault, False for none, None for open."""

    about: str
    kind: str
    sticky: bool
    found: LoopJudgement
    said: dict[str, bool | None]


def data_folder(named: str | None) -> Path:
    """Return the folder with measured data, which may not exist."""
    place = named or os.environ.get('VALVEFLOW_SHARED_DATA')
    return Path(place) if place else ROOT.parent / 'shared' / 'data'


def kind_of(tag: str) -> str:
    """Return what a loop controls from the letters of its tag (FIC, LIC, PIC, PDIC)."""
    letters = tag.split('.')[-1].split('_')[-1].lstrip('0123456789')
    return {'F': 'flow', 'L': 'level', 'P': 'pressure'}.get(letters[:1], 'other')


def called(about: str, kind: str, sticky: bool, u: FloatArray, y: FloatArray,
           found: LoopJudgement) -> Call:  # fmt: skip
    """Apply every test to a record; its rows without a value are left out for the single ones."""
    good = np.isfinite(u) & np.isfinite(y)
    u, y = u[good], y[good]
    period = detectors.oscillation(u).period
    period = period if np.isfinite(period) else len(u) / 4.0
    level = kind == 'level'
    answers = {
        'horch': detectors.horch(u, y).answer,
        'yamashita': detectors.yamashita(
            u[1:] if level else u, np.diff(y) if level else y, period
        ).answer,
        'he': detectors.he(y if level else u).answer,
    }
    open_, named = detectors.UNDECIDED, detectors.STICTION
    said = {k: None if a == open_ else a == named for k, a in answers.items()}
    tried = bool(np.isfinite(found.gain))
    said |= {
        'verdict': None if found.verdict == NOT_JUDGED else found.verdict in FAULTS,
        'gain alone': found.gain >= LEAST_GAIN if tried else None,
        'travel alone': found.travel >= LEAST_TRAVEL if tried else None,
        'two of three': sum(a == named for a in answers.values()) >= 2,
    }
    return Call(about, kind, sticky, found, said)


def simulated(first: int, seeds: int, model: str) -> list[Call]:
    """Judge a sound and a sticking loop of each seed."""
    loops = [simulate_loop(s, stuck, model) for s in range(first, first + seeds)
             for stuck in (False, True)]  # fmt: skip
    return [
        called(x.case, x.kind, bool(x.truth), x.command, x.response,
               judge_response(x.command, x.response, STEP_S))
        for x in loops
    ]  # fmt: skip


def measured(folder: Path) -> list[tuple[str, Call]]:
    """Judge every window that ``refinery_valves/index.csv`` names; return files and calls."""
    place = folder / 'refinery_valves'
    out = []
    with (place / 'index.csv').open(encoding='utf-8-sig', newline='') as file:
        for row in csv.DictReader(file):
            found = vf.judge_loop(place / row['file'])
            u, y = found.columns['command'], found.columns['process']
            stuck = row['label'] == 'stiction'
            call = called(row['tag'], kind_of(row['tag']), stuck, u, y, found.judgement)
            out.append((row['file'], call))
    return out


def score(pairs: Iterable[tuple[bool, bool | None]]) -> dict[str, Any]:
    """Return shares found and falsely named; what is left open counts as not named."""
    pairs = list(pairs)
    right, wrong = ([s for t, s in pairs if t == stuck] for stuck in (True, False))
    return {
        'sticky': len(right), 'sound': len(wrong),
        'found': round(float(np.mean([s is True for s in right])), 3) if right else None,
        'falsely_named': round(float(np.mean([s is True for s in wrong])), 3) if wrong else None,
        'open': sum(s is None for _, s in pairs),
    }  # fmt: skip


def scores(calls: Iterable[Call]) -> dict[str, Any]:
    """Score every test."""
    calls = list(calls)
    return {name: score((c.sticky, c.said[name]) for c in calls) for name in TESTS}


def by_valve(calls: Iterable[Call]) -> dict[str, dict[str, Any]]:
    """Return of each valve what the majority of its decided windows says; a tie is not named."""
    groups: dict[str, list[Call]] = {}
    for call in calls:
        groups.setdefault(call.about, []).append(call)

    def majority(own: list[Call], name: str) -> bool | None:
        said = [c.said[name] for c in own if c.said[name] is not None]
        return 2 * sum(bool(s) for s in said) > len(said) if said else None

    return {
        tag: {
            'kind': own[0].kind, 'sticky': own[0].sticky, 'windows': len(own),
            'verdicts': [c.found.verdict for c in own],
            **{name: majority(own, name) for name in TESTS},
        }
        for tag, own in sorted(groups.items())
    }  # fmt: skip


def on_simulated(first: int, seeds: int) -> dict[str, Any]:
    """Score loops with valves of both models."""
    calls = simulated(first, seeds, HE)
    return {
        'first': first, 'seeds': seeds, 'all': scores(calls),
        'by_kind': {k: scores(c for c in calls if c.kind == k) for k in KINDS},
        'by_case': {k: scores(c for c in calls if c.about == k) for k in NULLS},
        'kano': scores(simulated(first, seeds, KANO)),
    }  # fmt: skip


def on_measured(folder: Path) -> dict[str, Any]:
    """Score the measured windows per valve, and list windows."""
    read = measured(folder)
    valves = by_valve(call for _, call in read)
    rows = valves.values()
    return {
        'valves': valves,
        'per_valve': {n: score((v['sticky'], v[n]) for v in rows) for n in TESTS},
        'per_window': scores(call for _, call in read),
        'windows': [
            {'file': file, 'tag': c.about, 'verdict': c.found.verdict,
             'gain': round(c.found.gain, 2), 'travel': round(c.found.travel, 2), 'said': c.said}
            for file, c in read
        ],
    }  # fmt: skip


def main() -> None:
    """Judge simulated and, where they are, measured loops; print, and write beside the others."""
    parser = study.options(__doc__, seeds=200, first=5000)
    parser.add_argument('--data', help='folder that holds refinery_valves/')
    args = parser.parse_args()
    folder = data_folder(args.data)
    result: dict[str, Any] = {
        'fixed_on': f'simulated loops with seeds below {FIXED_BELOW}',
        'tried_on': f'simulated loops with seeds from {args.first}; the measured windows were '
        'known when the rules were chosen',
        'least_gain': LEAST_GAIN,
        'least_travel': LEAST_TRAVEL,
        'simulated': on_simulated(args.first, args.seeds),
        'measured': 'skipped: the folder refinery_valves was not there',
    }
    if (folder / 'refinery_valves' / 'index.csv').is_file():
        result['measured'] = on_measured(folder)
    given = f'--seeds {args.seeds} --first {args.first} --data DIR'
    study.keep('refinery_valves', **{'command': study.command(given), **result})
    shown = {k: result['simulated'][k] for k in ('all', 'kano')}
    if isinstance(result['measured'], dict):
        shown['per_valve'] = result['measured']['per_valve']
    print(json.dumps(study.finite(shown), indent=1))


if __name__ == '__main__':
    main()
