# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The paper's simulation study: three methods, ten days to learn from, other ten to judge by.

Run: ``python -m benchmarks.compare_study --seeds 5 --first 1``. Each seed is one plant that is
learnt from and, under another seed, judged on. ``--units random`` takes other plants than the
one of eqs. (30)-(31).

'untuned' is a Hammerstein model as one gets it from one start: even knots, n_b = 2, n_f = 3,
a delay of one row, nothing chosen by data held out.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from dataclasses import asdict
from typing import Any

import numpy as np

from benchmarks import study
from valveflow_ros.baselines.comparison import Comparison, compare, finding_of
from valveflow_ros.baselines.hammerstein import (
    OUTPUT_ERROR,
    HammersteinModel,
    first_order,
    grown,
    move,
    with_best_values,
)
from valveflow_ros.baselines.judged import other_data, samples_of
from valveflow_ros.baselines.truth import Truth, curve_error
from valveflow_ros.fit.fit import fit
from valveflow_ros.fit.problem import Samples
from valveflow_ros.plant.simulator import simulate
from valveflow_ros.plant.unit import UnitDescription, random_unit
from valveflow_ros.records import SegmentKind

OTHER_DAYS = 50_000  # added to the seed


def untuned(samples: Samples, pieces: int) -> HammersteinModel:
    """Return a Hammerstein model from one start, orders and delay as they come."""
    u = samples.u[samples.usable > 0]
    knots = np.linspace(u.min(), u.max(), pieces + 1)
    start, _ = with_best_values(samples, first_order(knots, 10.0, samples.step_s, samples.step_s))
    return move(samples, grown(start, 2, 3), OUTPUT_ERROR, 20)[0]


def compared(seed: int, given: argparse.Namespace) -> dict[str, Any]:
    """Learn from one plant, judge on its other days."""
    drawn = given.units == 'random'
    unit = random_unit(np.random.default_rng(seed)) if drawn else UnitDescription()
    settings = study.whole_window(unit, given.days)
    learn, judged = (
        study.task_of(simulate(given.days, s, unit).table, settings)[0]
        for s in (seed, seed + OTHER_DAYS)
    )
    curve = unit.curve
    truth = Truth(curve.knots, curve.slopes, curve.intercepts, unit.pressure_exponent)
    begin = time.perf_counter()
    found = fit(learn)
    fitted = time.perf_counter()
    samples = samples_of(learn.contents, settings)
    result = compare(samples, found, other_data(judged.contents, settings), truth)
    ended = time.perf_counter()
    ends = float(found.breakpoints[0]), float(found.breakpoints[-1])
    plain = untuned(samples, len(found.pieces))
    row = {
        'seed': seed,
        'seconds': {'fit': round(fitted - begin, 1), 'compare': round(ended - fitted, 1)},
        'true_pieces': len(curve.slopes),
        'true_regions': [[r.time_constant_s, r.delay_s] for r in unit.regions],
        **judgement(result),
    }
    row['curve_errors']['untuned'] = asdict(curve_error(plain.static, truth, *ends))
    others = samples_of(judged.contents, settings)
    error = (others.power_mw - plain.run(others)[0])[result.trial.good]
    row['all_rows_mse_mw2']['untuned.dynamic'] = float(np.mean(error**2))
    return row


def judgement(r: Comparison) -> dict[str, Any]:
    """Return the numbers of one comparison."""
    kinds = {'all': None, 'steady': SegmentKind.STEADY, 'slope': SegmentKind.SLOPE}
    j = r.judgement
    return {
        'finding': finding_of(r.pairs).value,
        'pieces': len(r.characteristic.pieces),
        'curve_errors': {m: asdict(e) for m, e in r.errors.items()},
        'mse_mw2': {n: {k: j.mse(n, kind) for k, kind in kinds.items()} for n in r.predictions},
        'all_rows_mse_mw2': dict(r.all_rows),
        'pairs': [
            {
                'terms': p.terms.value, 'against': p.baseline, 'ours': p.mse_ours_mw2,
                'theirs': p.mse_theirs_mw2, 'difference': p.test.mean, 'stderr': p.test.stderr,
                'p_value': p.test.p_value, 'effective': p.test.effective,
                'ours_is': p.outcome.value,
            }
            for p in r.pairs
        ],
    }  # fmt: skip


def summary(rows: list[dict[str, Any]]) -> list[str]:
    """Return what came out over all seeds, a line each."""
    lines = []
    for m in ('paper', 'proposed', 'hammerstein', 'untuned', 'sparse'):
        e = np.array([row['curve_errors'][m]['rmse_mw'] for row in rows])
        lines.append(f'curve against truth, {m}: rms median {np.median(e):.3f} worst '
                     f'{e.max():.3f} MW')  # fmt: skip
    for n in rows[0]['all_rows_mse_mw2']:
        e = np.array([row['all_rows_mse_mw2'][n] for row in rows])
        lines.append(f'all rows, {n}: mse median {np.median(e):.2f} worst {e.max():.2f} MW^2')
    pairs = [
        {**p, 'of': f'{p["terms"]}, against {p["against"]}'} for row in rows for p in row['pairs']
    ]
    for name, own in study.by('of', pairs).items():
        lines.append(f'ours is, {name}: {_counts(p["ours_is"] for p in own)}')
    return [*lines, f"the paper's finding: {_counts(r['finding'] for r in rows)} of {len(rows)}"]


def _counts(words: Any) -> str:
    return ', '.join(f'{count} {word}' for word, count in sorted(Counter(words).items()))


def main() -> None:
    parser = study.options(__doc__, seeds=5, first=1, days=10.0)
    parser.add_argument('--units', choices=('paper', 'random'), default='paper')
    given = parser.parse_args()
    name = study.name_of(f'compare_study_{given.units}', given)
    rows = study.rows_of(name, compared, study.seeds(given), given)
    study.keep(name, summary=summary(rows), rows=rows)


if __name__ == '__main__':
    main()
