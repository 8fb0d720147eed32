# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Hide effects in plants, diagnose them, and count.

    python -m benchmarks.diagnosis_study --kind hidden --seeds 3 --first 5000 --days 10
    python -m benchmarks.diagnosis_study --kind null --seeds 24 --first 5000 --days 10

Every plant is drawn: the unit (every third is the paper's), the size of what is hidden (2 to
4 times the smallest detectable one), sign, onset and phase. Thresholds were fixed on seeds
below 1000.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks import study
from benchmarks.diagnosis_cases import (
    CONFOUNDED,
    EFFECTS,
    PAIRS,
    TRIPLES,
    Case,
    confounded,
    hidden,
    null,
    outside,
    slow,
)
from benchmarks.diagnosis_oracle import Oracle, oracle
from benchmarks.diagnosis_outside import OUTSIDE, SLOW, added_to, slowly
from valveflow_ros.diagnosis.diagnose import Record, diagnose
from valveflow_ros.diagnosis.grids import make_grids
from valveflow_ros.diagnosis.result import Diagnosis
from valveflow_ros.errors import ValveflowError
from valveflow_ros.fit.fit import fit, outline
from valveflow_ros.fit.task import FitTask
from valveflow_ros.parameters import Settings
from valveflow_ros.plant.simulator import SimulatedLog, simulate
from valveflow_ros.records import IntArray
from valveflow_ros.signals.static_form import StaticForm

KINDS = ('hidden', 'null', 'pair', 'triple', 'confounded', 'outside', 'slow')
# Four fifths of 64, which is four times the 16 that just reach detection.
ENOUGH = 51.0
OTHER_SEED = 1_000_003  # of the record that an earlier model comes from


def watched(log: SimulatedLog, days: float) -> tuple[FitTask, IntArray, Settings]:
    """Find special segments, and what a curve is found from."""
    settings = study.whole_window(log.unit, days)
    task, segments = study.task_of(log.table, settings)
    spans = np.array([(s.start_ns, s.end_ns) for s in segments], dtype=np.int64)
    return task, spans.reshape(-1, 2), settings


def simulated(case: Case, days: float) -> SimulatedLog:
    """Simulate one plant, with what is outside the catalogue."""
    log = simulate(days, case.seed, case.unit, effects=case.effects)
    if case.outside_share:
        log = added_to(log, case.label, case.seed, case.outside_share)
    if case.kind == 'slow':
        log = slowly(log, case.label, case.seed)
    return log


def run(case: Case, days: float) -> tuple[Diagnosis, SimulatedLog, Record, dict[str, float]]:
    """Simulate and diagnose one plant."""
    log = simulated(case, days)
    begin = time.process_time()
    task, spans, settings = watched(log, days)
    if case.given:
        other = watched(simulate(days, case.seed + OTHER_SEED, case.unit), days)[0]
        model = fit(replace(other, form=StaticForm())).model
    else:
        model, _ = outline(replace(task, form=StaticForm()))
    middle = time.process_time()
    record = Record(
        log.table, settings.real('sample_period'), StaticForm(),
        settings.settle_s, spans,
    )  # fmt: skip
    again = time.process_time()
    found = diagnose(record, model, case.given)
    cpu = {'identify': middle - begin, 'diagnose': time.process_time() - again}
    return found, log, record, cpu


def share_of_oracle(
    found: Diagnosis, log: SimulatedLog, record: Record, best: Oracle | None
) -> float:
    """Return the squared error that is gone on the sealed blocks, in parts of what could go.

    At best the noise stays, and what the finite record costs in curve and dynamics: the
    oracle knows. Where it does not (hidden states), the noise alone.
    """
    before = found.rmse_simulation**2
    floor = _noise_mw(log, record) ** 2 if best is None else best.rmse_mw**2
    total = before - floor
    return (before - found.rmse_extended**2) / total if total > 0.0 else 0.0


def _noise_mw(log: SimulatedLog, record: Record) -> float:
    """Return the root mean square of the noise of ten-second means on the sealed blocks."""
    bad = np.zeros(log.table.values.shape, dtype=bool)
    grids = make_grids(*record.about, bad)
    rows = len(grids.power)
    per = round(grids.mean_s / record.step_s)
    noise = log.noise_mw[: rows * per].reshape(rows, per).mean(axis=1)[grids.sealed_rows]
    return float(np.sqrt(np.mean(noise**2)))


def covered(case: Case, found: Diagnosis) -> dict[str, list[float | bool]]:
    """Return value, truth and whether the interval covers, for parameters of the same name."""
    out: dict[str, list[float | bool]] = {}
    for spec in case.effects:
        for cause in found.causes:
            if cause.name != spec.name:
                continue
            for key, e in cause.parameters.items():
                if key in spec.parameters and isinstance(spec.parameters[key], int | float):
                    truth = float(spec.parameters[key])
                    out[f'{cause.name}.{key}'] = [e.value, truth, bool(e.low <= truth <= e.high)]
    return out


def wrong_sign(case: Case, found: Diagnosis) -> bool:
    """Tell whether a bump was called a dent, or a dent a bump; either of both is not wrong."""
    truth = [s.parameters['h_mw'] for s in case.effects if s.name == 'curve_shape']
    told = [c.parameters['h_mw'] for c in found.causes if c.name == 'curve_shape']
    return any(
        float(h) * e.value < 0.0 and e.low * e.high > 0.0
        for h, e in zip(truth, told, strict=False)
    )


def row_of(case: Case, days: float) -> dict[str, Any]:
    """Diagnose one plant and return what is counted."""
    about = {
        'kind': case.kind, 'label': case.label, 'seed': case.seed,
        'effects': [str(e) for e in case.effects],
    }  # fmt: skip
    try:
        found, log, record, cpu = run(case, days)
    except ValveflowError as error:
        return {**about, 'verdict': 'refused', 'names': [], 'error': str(error)}
    names = [c.name for c in found.causes]
    best = oracle(record, found, case.effects, case.given) if case.names else None
    share = share_of_oracle(found, log, record, best) if case.names else None
    return {
        **about,
        'verdict': found.verdict,
        'names': names,
        'right': _told(found, case.label)
        if case.kind == 'slow'
        else set(names) == set(case.names)
        and not wrong_sign(case, found)
        and (found.verdict == 'unexplained') == (case.kind == 'outside'),
        'not_told_apart': list(found.not_told_apart),
        'unexplained_by': list(found.unexplained_by),
        'disturbance_mw': found.disturbance.rms_mw if found.disturbance else None,
        'shape': found.disturbance.shape if found.disturbance else '',
        'share': None if share is None else round(share, 3),
        'available': None if best is None else round(best.available, 1),
        'p_values': [c.gain.p_value for c in found.causes],
        'parameters': covered(case, found),
        'rejected': {n: r for n, r in found.rejected if n in case.names},
        'cpu_s': {k: round(v, 1) for k, v in cpu.items()},
    }


def _told(found: Diagnosis, label: str) -> bool:
    """Tell whether a slow change was told as one in time, and no cause named in its place.

    An offset that switches is what the cause ``intervals`` is for.
    """
    names = {c.name for c in found.causes}
    if label == 'switching offset' and names:
        return names == {'intervals'}
    return not names and (found.verdict == 'unexplained' or found.disturbance is not None)


def cases(args: argparse.Namespace) -> list[Case]:
    """Return the plants asked for."""
    seeds = range(args.first, args.first + args.seeds)
    times = (args.low, args.high)
    if args.kind == 'null':
        return [null(seed) for seed in seeds]
    if args.kind == 'outside':
        return [outside(label, seed) for seed in seeds for label in OUTSIDE]
    if args.kind == 'slow':
        return [slow(label, seed) for seed in seeds for label in SLOW]
    if args.kind == 'confounded':
        return [confounded(c, seed, args.days, times) for seed in seeds for c in CONFOUNDED]
    if args.kind in ('pair', 'triple'):
        sets = PAIRS if args.kind == 'pair' else TRIPLES
        return [hidden(names, seed, args.days, times) for seed in seeds for names in sets]
    names = args.effect or list(EFFECTS)
    return [hidden((name,), seed, args.days, times) for seed in seeds for name in names]


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the table: by what was hidden, how often right, and what was said instead."""
    table = {}
    for label in dict.fromkeys(r['label'] for r in rows):
        mine = [r for r in rows if r['label'] == label]
        said = Counter('+'.join(sorted(r['names'])) or r['verdict'] for r in mine)
        shares = [r['share'] for r in mine if r.get('right') and r.get('share') is not None]
        inside = [v[2] for r in mine if r.get('right') for v in r['parameters'].values()]
        table[label] = {
            'records': len(mine), 'right': sum(bool(r.get('right')) for r in mine),
            'said': dict(said.most_common()),
            'share_median': float(np.median(shares)) if shares else None,
            'covered': f'{sum(inside)}/{len(inside)}',
        }  # fmt: skip
    return table


def main() -> None:
    """Run the study, print it, and write it beside the other results."""
    parser = study.options(__doc__, seeds=1, first=0, days=10.0, low=2.0, high=4.0)
    parser.add_argument('--kind', choices=KINDS, default='hidden')
    parser.add_argument('--effect', action='append')
    args = parser.parse_args()
    name = study.name_of(f'diagnosis_{args.kind}', args.first, args.seeds)
    rows: list[dict[str, Any]] = []
    for case in cases(args):
        rows.append(row_of(case, args.days))
        print(json.dumps(rows[-1]), flush=True)
        # Hours of work: what is done is kept, whatever comes.
        study.keep(f'{name}_{args.days:g}d', **totals(rows))
    for label, line in summary(rows).items():
        print(f'{label:22} {line["right"]}/{line["records"]}  {line["said"]}')


def totals(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return what is kept of a run."""
    enough = [r for r in rows if (r.get('available') or 0.0) >= ENOUGH]
    return {
        'right': sum(bool(r.get('right')) for r in rows), 'records': len(rows),
        'named_with_confidence_wrongly': sum(map(_confidently_wrong, rows)),
        'detectable_twice': {
            'right': sum(bool(r.get('right')) for r in enough), 'records': len(enough),
            'means': f'the truth is worth {ENOUGH:.0f} in log-likelihood on the open blocks',
        },
        'table': summary(rows), 'rows': rows,
    }  # fmt: skip


def _confidently_wrong(row: dict[str, Any]) -> bool:
    """Tell whether a name that is not the truth was given, and nothing set beside it."""
    none = row['kind'] in ('null', 'outside', 'slow')
    true = set() if none else set(row['label'].split(',')[0].split('+'))
    if row['label'] == 'switching offset':
        true = {'intervals'}
    return bool(set(row['names']) - true) and not true & set(row.get('not_told_apart', ()))


if __name__ == '__main__':
    main()
