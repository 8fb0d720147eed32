# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""How surely a shift of the curve is seen, and how rarely one is seen that is not there.

Run: ``python -m benchmarks.shift_study --seeds 12 --first 101``. Each seed is twenty days of
the paper's plant: the first ten give the reference, the second ten the current curve. Effects
begin after day 16, so that the current window holds both the old plant and the new one. The
factor in ``curve/shift.py`` was fixed on seeds 1 to 12; the figures kept beside this file are of
other seeds. ``--wander 1`` adds a slow disturbance of so many MW (time constant two hours).
"""

from __future__ import annotations

import json
from dataclasses import asdict, replace

import numpy as np

from benchmarks import study
from valveflow_ros.curve.shift import Shift, judge_shift
from valveflow_ros.fit.fit import fit
from valveflow_ros.parameters import Settings
from valveflow_ros.plant.simulator import DEFAULT_START_NS, simulate
from valveflow_ros.plant.spec import EffectSpec
from valveflow_ros.plant.unit import UnitDescription
from valveflow_ros.records import NS_PER_S

SETTINGS = Settings({'refit_period': 0.0})
ONSET_DAYS = 16.0
EFFECTS = {
    'clean': '',
    'gain_step 0.002': f'gain_step:g=0.002,t0_days={ONSET_DAYS}',
    'gain_step 0.004': f'gain_step:g=0.004,t0_days={ONSET_DAYS}',
    'gain_step 0.006': f'gain_step:g=0.006,t0_days={ONSET_DAYS}',
    'input_step 0.006': f'input_step:g=0.006,t0_days={ONSET_DAYS}',
    'curve_step -1 MW': f'curve_step:s_mw=-1,t0_days={ONSET_DAYS}',
    'curve_step -2.5 MW': f'curve_step:s_mw=-2.5,t0_days={ONSET_DAYS}',
}


def truth_mw(name: str, shift: Shift) -> list[float]:
    """Return by how much the plant has really moved in the middle of each piece."""
    middle = np.array([0.5 * (p.u_from + p.u_to) for p in shift.pieces])
    curve = UnitDescription().curve
    flow = curve(middle)
    kind, _, size = name.partition(' ')
    if kind == 'gain_step':
        return list(float(size) * flow)
    if kind == 'input_step':
        return list(curve(middle * (1.0 + float(size))) - flow)
    if kind == 'curve_step':
        share = np.clip((middle - 1450.0) / 300.0, 0.0, 1.0)
        return list(float(size.split()[0]) * share)
    return [0.0] * len(middle)


def row_of(seed: int, name: str, shift: Shift) -> dict[str, object]:
    """Return what is kept of one judgement."""

    def days(time_ns: int) -> float | None:
        return round((time_ns - DEFAULT_START_NS) / NS_PER_S / 86400.0, 3) if time_ns else None

    pieces = [
        {**{k: round(v, 4) for k, v in asdict(p).items()}, 'truth_mw': round(t, 3)}
        for p, t in zip(shift.pieces, truth_mw(name, shift), strict=True)
    ]
    return {
        'seed': seed, 'effect': name, 'moved': shift.moved, 'since_days': days(shift.since_ns),
        'since_low_days': days(shift.since_low_ns), 'since_high_days': days(shift.since_high_ns),
        'pieces': pieces, 'p_values': [p.p_value for p in shift.pieces],
    }  # fmt: skip


def judged(seed: int, wander_mw: float) -> list[dict[str, object]]:
    """Return the judgements of one plant with each effect."""
    unit = UnitDescription()
    unit = replace(unit, noise=replace(unit.noise, wander_mw=wander_mw))
    rows, reference = [], None
    for name, text in EFFECTS.items():
        specs = [EffectSpec.parse(text)] if text else []
        table = simulate(20.0, seed, unit, effects=specs).table
        half = len(table) // 2
        if reference is None:
            reference = fit(study.task_of(table.part(0, half), SETTINGS)[0])
        task, segments = study.task_of(table.part(half, len(table)), SETTINGS)
        rows.append(row_of(seed, name, judge_shift(reference, fit(task), segments)))
    return rows


def line(name: str, rows: list[dict[str, object]]) -> dict[str, object]:
    """Return the summary of one effect."""
    seen = [r for r in rows if r['moved']]
    dated = [r for r in seen if r['since_days'] is not None]
    inside = [r for r in dated if r['since_low_days'] <= ONSET_DAYS <= r['since_high_days']]  # type: ignore[operator]
    late = [abs(r['since_days'] - ONSET_DAYS) for r in dated]  # type: ignore[operator]
    moved = [p for r in seen for p in r['pieces'] if p['moved']]  # type: ignore[attr-defined]
    off = [abs(p['now_mw'] - p['truth_mw']) for p in moved if p['now_mw'] == p['now_mw']]
    still = [p for r in rows for p in r['pieces'] if abs(p['truth_mw']) < 0.02]  # type: ignore[attr-defined]
    return {
        'effect': name, 'plants': len(rows), 'seen': len(seen), 'dated': len(dated),
        'interval_holds_the_truth': len(inside),
        'days_off_median': round(float(np.median(late)), 3) if late else None,
        'mw_off_median': round(float(np.median(off)), 3) if off else None,
        'unmoved_pieces': len(still), 'unmoved_pieces_blamed': sum(p['moved'] for p in still),
    }  # fmt: skip


def main() -> None:
    """Run the study, print it, and write it beside the other results."""
    args = study.options(__doc__, seeds=12, first=101, wander=0.0).parse_args()
    rows: list[dict[str, object]] = []
    for seed in study.seeds(args.first, args.seeds):
        rows += judged(seed, args.wander)
        print(seed, [r['moved'] for r in rows[-len(EFFECTS) :]], flush=True)
        # Whatever comes, what is done is kept.
        lines = [line(name, [r for r in rows if r['effect'] == name]) for name in EFFECTS]
        tail = f'_wander_{args.wander:g}' if args.wander else ''
        study.keep(f'shift_study_{args.first}{tail}', summary=lines, rows=rows)
    print('\n'.join(map(json.dumps, lines)))


if __name__ == '__main__':
    main()
