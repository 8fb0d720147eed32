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
windows are answers to steps of the set point. Horch's test names it, but its author does not
apply the test to an integrating process; ``horch_on_levels`` says how often it names a simulated
sound level loop whose set point changes.
"""

from __future__ import annotations

import csv
import os
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

TESTS = ('verdict', 'gain alone', 'travel alone', 'horch', 'yamashita', 'he', 'two of three')
_LEVELS_FROM = 10  # seeds for one: few are level loops with a set point that changes
_LETTERS = {'F': 'flow', 'L': 'level', 'P': 'pressure'}  # of the tags FIC, LIC, PIC, PDIC


def said_of(kind: str, u: FloatArray, y: FloatArray, found: LoopJudgement) -> dict[str, Any]:
    """Return what each test says: True for a fault, False for none, None for open.

    Rows without a value are left out for the single tests.
    """
    good = np.isfinite(u) & np.isfinite(y)
    u, y = u[good], y[good]
    period = detectors.oscillation(u).period
    period = period if np.isfinite(period) else len(u) / 4.0
    level = kind == 'level'
    flow = (u[1:], np.diff(y)) if level else (u, y)
    answers = {
        'horch': detectors.horch(u, y).answer,
        'yamashita': detectors.yamashita(*flow, period).answer,
        'he': detectors.he(y if level else u).answer,
    }
    named = {
        k: None if a == detectors.UNDECIDED else a == detectors.STICTION
        for k, a in answers.items()
    }
    tried = bool(np.isfinite(found.gain))
    return {
        **named,
        'verdict': None if found.verdict == NOT_JUDGED else found.verdict in FAULTS,
        'gain alone': found.gain >= LEAST_GAIN if tried else None,
        'travel alone': found.travel >= LEAST_TRAVEL if tried else None,
        'two of three': sum(a is True for a in named.values()) >= 2,
    }


def simulated(first: int, seeds: int, model: str) -> list[dict[str, Any]]:
    """Judge a sound and a sticking loop of each seed."""
    rows = []
    for seed in range(first, first + seeds):
        for sticky in (False, True):
            x = simulate_loop(seed, sticky, model)
            found = judge_response(x.command, x.response, STEP_S)
            said = said_of(x.kind, x.command, x.response, found)
            rows.append({'case': x.case, 'kind': x.kind, 'sticky': bool(x.truth), **said})
    return rows


def horch_on_levels(first: int, seeds: int) -> dict[str, int]:
    """Count sound level loops whose set point changes, and those that Horch's test names."""
    loops = (simulate_loop(seed, sticky=False) for seed in range(first, first + seeds))
    said = [
        detectors.horch(x.command, x.response).answer for x in loops
        if (x.kind, x.case) == ('level', 'setpoint')
    ]  # fmt: skip
    return {'loops': len(said), 'named': said.count(detectors.STICTION)}


def measured(place: Path) -> dict[str, Any]:
    """Judge every window that ``index.csv`` names; score valves and windows."""
    rows = []
    with (place / 'index.csv').open(encoding='utf-8-sig', newline='') as file:
        for row in csv.DictReader(file):
            found = vf.judge_loop(place / row['file'])
            letters = row['tag'].split('.')[-1].split('_')[-1].lstrip('0123456789')
            kind = _LETTERS.get(letters[:1], 'other')
            u, y = found.columns['command'], found.columns['process']
            judged = found.judgement
            rows.append({
                'file': row['file'], 'tag': row['tag'], 'kind': kind,
                'sticky': row['label'] == 'stiction', 'found': judged.verdict,
                'gain': judged.gain, 'travel': judged.travel,
                **said_of(kind, u, y, judged),
            })  # fmt: skip
    valves = by_valve(rows)
    return {
        'valves': valves, 'per_valve': scores(list(valves.values())), 'per_window': scores(rows),
        'windows': [
            {'file': r['file'], 'tag': r['tag'], 'verdict': r['found'],
             'gain': round(r['gain'], 2), 'travel': round(r['travel'], 2),
             'said': {name: r[name] for name in TESTS}}
            for r in rows
        ],
    }  # fmt: skip


def by_valve(rows: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return of each valve what the majority of its decided windows says; a tie is not named."""

    def majority(said: list[bool]) -> bool | None:
        return 2 * sum(said) > len(said) if said else None

    return {
        tag: {
            'kind': own[0]['kind'], 'sticky': own[0]['sticky'], 'windows': len(own),
            'verdicts': [r['found'] for r in own],
            **{name: majority([r[name] for r in own if r[name] is not None]) for name in TESTS},
        }
        for tag, own in sorted(study.by('tag', rows).items())
    }  # fmt: skip


def scores(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return shares found and falsely named of every test; what is left open is not named."""

    def share(rows: list[dict[str, Any]], name: str) -> float | None:
        return round(float(np.mean([r[name] is True for r in rows])), 3) if rows else None

    sticky, sound = ([r for r in rows if r['sticky'] == stuck] for stuck in (True, False))
    return {
        name: {
            'sticky': len(sticky), 'sound': len(sound), 'found': share(sticky, name),
            'falsely_named': share(sound, name), 'open': sum(r[name] is None for r in rows),
        }
        for name in TESTS
    }  # fmt: skip


def main() -> None:
    parser = study.options(__doc__, seeds=200, first=5000)
    parser.add_argument('--data', help='folder that holds refinery_valves/')
    given = parser.parse_args()
    named = given.data or os.environ.get('VALVEFLOW_SHARED_DATA')
    folder = Path(named) if named else study.RESULTS.parents[2] / 'shared' / 'data'
    place = folder / 'refinery_valves'
    there = (place / 'index.csv').is_file()
    rows = simulated(given.first, given.seeds, HE)
    study.keep(
        'refinery_valves',
        command=study.command(f'--seeds {given.seeds} --first {given.first} --data DIR'),
        fixed_on='simulated loops with seeds below 300',
        tried_on=f'simulated loops with seeds from {given.first}; the measured windows were known '
        'when the rules were chosen',
        least_gain=LEAST_GAIN, least_travel=LEAST_TRAVEL,
        simulated={
            'first': given.first, 'seeds': given.seeds, 'all': scores(rows),
            'by_kind': {k: scores([r for r in rows if r['kind'] == k]) for k in KINDS},
            'by_case': {k: scores([r for r in rows if r['case'] == k]) for k in NULLS},
            'kano': scores(simulated(given.first, given.seeds, KANO)),
            'horch_on_levels': horch_on_levels(given.first, _LEVELS_FROM * given.seeds),
        },
        measured=measured(place) if there else 'skipped: the folder refinery_valves was not there',
    )  # fmt: skip


if __name__ == '__main__':
    main()
