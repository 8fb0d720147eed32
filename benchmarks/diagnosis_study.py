# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Hide effects in plants, diagnose them, and count.

    python -m benchmarks.diagnosis_study --kind hidden --seeds 3 --first 5000 --days 10
    python -m benchmarks.diagnosis_study --kind null --seeds 24 --first 5000 --days 10

Every plant is drawn: the unit (every third is the paper's), the size of what is hidden (2 to
4 times the smallest detectable one), sign, onset and phase. ``--recording minute`` diagnoses
means over a minute, without an earlier model. The first thresholds were fixed on
seeds below 1000; later ones name the seeds where they stand.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Collection, Iterable
from dataclasses import replace
from typing import Any

import numpy as np

import valveflow_ros as vf
from benchmarks import diagnosis_cases as plants
from benchmarks import study
from benchmarks.diagnosis_best import best_of, summary
from benchmarks.diagnosis_cases import Case
from benchmarks.diagnosis_outside import OUTSIDE, SLOW, added_to, slowly
from valveflow_ros.curve.regional_model import RegionalModel
from valveflow_ros.diagnosis.causes.since_model import CURVE
from valveflow_ros.diagnosis.diagnose import Record, diagnose
from valveflow_ros.diagnosis.result import Diagnosis
from valveflow_ros.errors import ValveflowError
from valveflow_ros.fit.fit import fit, outline
from valveflow_ros.interface.simulate import Simulation
from valveflow_ros.plant.simulator import SimulatedLog, simulate
from valveflow_ros.signals.static_form import StaticForm

KINDS = ('hidden', 'null', 'pair', 'triple', 'confounded', 'outside', 'slow')
OTHER_SEED = 1_000_003  # of the record that an earlier model comes from


def simulated(case: Case, days: float) -> SimulatedLog:
    """Simulate one plant, with what is outside the catalogue."""
    log = simulate(days, case.seed, case.unit, effects=case.effects)
    if case.outside_share:
        log = added_to(log, case.label, case.seed, case.outside_share)
    if case.kind == 'slow':
        log = slowly(log, case.label, case.seed)
    return log


def record_of(case: Case, days: float) -> tuple[Record, RegionalModel]:
    """Return the record of one plant, and the model of this record or of an earlier one."""
    log = simulated(case, days)
    settings = study.whole_window(case.unit, days)
    task, segments = study.task_of(log.table, settings)
    spans = np.array([(s.start_ns, s.end_ns) for s in segments], dtype=np.int64).reshape(-1, 2)
    if case.given:
        earlier = simulate(days, case.seed + OTHER_SEED, case.unit).table
        other, _ = study.task_of(earlier, settings)
        model = fit(replace(other, form=StaticForm())).model
    else:
        model, _ = outline(replace(task, form=StaticForm()))
    period_s = settings.real('sample_period')
    return Record(log.table, period_s, StaticForm(), settings.settle_s, spans), model


def covered(case: Case, found: Diagnosis) -> dict[str, list[Any]]:
    """Return value, truth and whether the interval covers, for parameters of the same name."""
    truths = {
        f'{spec.name}.{key}': float(value) for spec in case.effects
        for key, value in spec.parameters.items() if isinstance(value, int | float)
    }  # fmt: skip
    told = {f'{c.name}.{key}': e for c in found.causes for key, e in c.parameters.items()}
    return {
        key: [e.value, truths[key], bool(e.low <= truths[key] <= e.high)]
        for key, e in told.items() if key in truths
    }  # fmt: skip


def told_of(true: Collection[str], names: Iterable[str]) -> set[str]:
    """Return the names; a change of the curve is the bump, if that has no other name."""
    bump, told = 'curve_shape', set(names)
    if bump in true and bump not in told and CURVE in told:
        told = told - {CURVE} | {bump}
    return told


def right(case: Case, found: Diagnosis) -> bool:
    """Tell whether all causes and no others are named, or what has no name is said to be there.

    A bump that is called a dent is wrong; either of both is not. Beside an earlier model a bump is
    also a change of the curve since then. A slow change is to be told as one in time, and no cause
    named in its place; an offset that switches is what the cause ``intervals`` is for.
    """
    names = told_of(case.names, [c.name for c in found.causes])
    if case.kind == 'slow':
        if case.label == 'switching offset' and names:
            return names == {'intervals'}
        return not names and (found.verdict == 'unexplained' or found.disturbance is not None)
    truth = [s.parameters['h_mw'] for s in case.effects if s.name == 'curve_shape']
    told = [c.parameters['h_mw'] for c in found.causes if c.name == 'curve_shape']
    wrong_sign = any(
        float(h) * e.value < 0.0 and e.low * e.high > 0.0
        for h, e in zip(truth, told, strict=False)
    )
    unexplained = found.verdict == 'unexplained'
    return names == set(case.names) and not wrong_sign and unexplained == (case.kind == 'outside')


def row_of(case: Case, days: float, recording: str) -> dict[str, Any]:
    """Diagnose one plant and return what is counted."""
    about: dict[str, Any] = {
        'kind': case.kind, 'label': case.label, 'seed': case.seed,
        'effects': [str(e) for e in case.effects],
    }  # fmt: skip
    begin = time.process_time()
    try:
        if recording == 'minute':
            plant = Simulation(simulated(case, days), days, case.seed)
            found = vf.diagnose(study.means(plant)).diagnosis
        else:
            record, model = record_of(case, days)
            found = diagnose(record, model, case.given)
            if case.effects:
                about['best'] = best_of(case, record, model, found)
    except ValveflowError as error:
        return {**about, 'verdict': 'refused', 'names': [], 'right': False, 'error': str(error),
                'not_told_apart': [], 'parameters': {}}  # fmt: skip
    drift = found.disturbance
    return {
        **about,
        'verdict': found.verdict,
        'names': [c.name for c in found.causes],
        'right': right(case, found),
        'not_told_apart': list(found.not_told_apart),
        'unexplained_by': list(found.unexplained_by),
        'disturbance_mw': drift.rms_mw if drift else None,
        'shape': drift.shape if drift else '',
        'p_values': [c.gain.p_value for c in found.causes],
        'parameters': covered(case, found),
        'rejected': {n: r for n, r in found.rejected if n in case.names},
        'cpu_s': round(time.process_time() - begin, 1),
    }


def cases(given: argparse.Namespace) -> list[Case]:
    """Return the plants asked for."""
    own = given.days, (given.low, given.high)
    make = {
        'null': lambda seed: [plants.null(seed)],
        'outside': lambda seed: [
            plants.outside(label, seed, (given.least_share, given.largest_share))
            for label in OUTSIDE
        ],
        'slow': lambda seed: [plants.slow(label, seed) for label in SLOW],
        'confounded': lambda seed: [
            plants.confounded(label, seed, *own) for label in plants.CONFOUNDED
        ],
        'pair': lambda seed: [plants.hidden(names, seed, *own) for names in plants.PAIRS],
        'triple': lambda seed: [plants.hidden(names, seed, *own) for names in plants.TRIPLES],
        'hidden': lambda seed: [
            plants.hidden((name,), seed, *own) for name in given.effect or plants.EFFECTS
        ],
    }[given.kind]
    return [case for seed in study.seeds(given) for case in make(seed)]


def confidently_wrong(row: dict[str, Any]) -> bool:
    """Tell whether a name that is not the truth was given, and nothing set beside it."""
    none = row['kind'] in ('null', 'outside', 'slow')
    true = set() if none else set(row['label'].split(',')[0].split('+'))
    if row['label'] == 'switching offset':
        true = {'intervals'}
    return bool(told_of(true, row['names']) - true) and not true & set(row['not_told_apart'])


def counts(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return how often right, and what was said instead."""
    said = Counter('+'.join(sorted(r['names'])) or r['verdict'] for r in rows)
    inside = [v[2] for r in rows if r['right'] for v in r['parameters'].values()]
    return {
        'records': len(rows), 'right': sum(r['right'] for r in rows),
        'said': dict(said.most_common()), 'covered': f'{sum(inside)}/{len(inside)}',
    }  # fmt: skip


def main() -> None:
    parser = study.options(__doc__, seeds=1, first=0, days=10.0, low=2.0, high=4.0)
    parser.add_argument('--kind', choices=KINDS, default='hidden')
    parser.add_argument('--least-share', type=float, default=plants.SHARES[0])
    parser.add_argument('--largest-share', type=float, default=plants.SHARES[1])
    parser.add_argument('--effect', action='append')
    parser.add_argument('--recording', choices=('1s', 'minute'), default='1s')
    given = parser.parse_args()
    kind = given.kind + '_minute' * (given.recording == 'minute')
    name = f'{study.name_of(f"diagnosis_{kind}", given)}_{given.days:g}d'
    rows = study.rows_of(name, row_of, cases(given), given.days, given.recording)
    study.keep(
        name, right=sum(r['right'] for r in rows), records=len(rows),
        named_with_confidence_wrongly=sum(map(confidently_wrong, rows)),
        visible_at_best=summary(rows),
        table={label: counts(own) for label, own in study.by('label', rows).items()}, rows=rows,
    )  # fmt: skip


if __name__ == '__main__':
    main()
