# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The extended model against two learners that know no cause, on the same sealed blocks.

    pip install scikit-learn
    python -m benchmarks.learners --seeds 1 --first 35000 --days 5

One effect is hidden in each plant, as in `benchmarks.diagnosis_study`. The diagnosis extends the
model by the cause that it names. A Gaussian process and gradient boosting learn the residual of
the plain model instead, from minute means of the open blocks: opening, pressure, temperature, u,
time, time of day, and how far the valve moved in 3 and in 15 minutes. All are judged by the RMSE
of minute means in the sealed blocks. To these nothing was fitted but the onset of a change, which
the diagnosis dates with all blocks.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from benchmarks import diagnosis_cases as plants
from benchmarks import study
from benchmarks.diagnosis_study import record_of, right
from valveflow_ros.diagnosis.diagnose import diagnose
from valveflow_ros.diagnosis.evidence import fair_open_residual
from valveflow_ros.diagnosis.fitting import Task
from valveflow_ros.diagnosis.grids import DAY_S, ORDER, Grids
from valveflow_ros.errors import ValveflowError
from valveflow_ros.records import BoolArray, FloatArray

LEARNERS = ('gaussian_process', 'boosting')
_MINUTE_S = 60.0
_MOST_ROWS = 1000  # of a Gaussian process
_SEED = 1


def minutes(grids: Grids, series: FloatArray) -> FloatArray:
    """Return minute means of the means of the grids."""
    rows = round(_MINUTE_S / grids.mean_s)
    m = len(series) // rows
    out: FloatArray = series[: m * rows].reshape(m, rows).mean(axis=1)
    return out


def features(grids: Grids) -> FloatArray:
    """Return what the learners see in each minute, (minutes, 9)."""
    opening = np.where(np.isfinite(grids.v), grids.v, 0.0)
    v = minutes(grids, grids.means(grids.coarse(opening)))
    p, t, u, time_s = (
        minutes(grids, grids.means(x))
        for x in (grids.pressure, grids.temperature, grids.u, grids.time_s)
    )
    turn = 2.0 * np.pi * time_s / DAY_S
    moved = [v - np.concatenate([np.full(back, v[0]), v[:-back]]) for back in (3, 15)]
    return np.column_stack([v, p, t, u, time_s, np.sin(turn), np.cos(turn), *moved])


def learned(x: FloatArray, rest: FloatArray, rows: BoolArray) -> dict[str, FloatArray]:
    """Return what each learner predicts of the residual in every minute, from ``rows``."""
    from sklearn.ensemble import HistGradientBoostingRegressor
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, WhiteKernel

    x = (x - x[rows].mean(axis=0)) / np.maximum(x[rows].std(axis=0), 1e-9)
    rng = np.random.default_rng(_SEED)
    few = rng.permutation(np.flatnonzero(rows))[:_MOST_ROWS]
    kernel = 1.0 * RBF(np.ones(x.shape[1]), (0.05, 1e3)) + WhiteKernel(1.0)
    process = GaussianProcessRegressor(kernel, normalize_y=True, random_state=_SEED)
    trees = HistGradientBoostingRegressor(
        learning_rate=0.05, max_iter=300, min_samples_leaf=40, early_stopping=True,
        random_state=_SEED,
    )  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')  # a length scale at its bound
        process.fit(x[few], rest[few])
    trees.fit(x[rows], rest[rows])
    return {'gaussian_process': process.predict(x), 'boosting': trees.predict(x)}


def row_of(case: plants.Case, days: float) -> dict[str, Any]:
    """Diagnose a plant; return the RMSE in the sealed blocks of the models, MW."""
    about = {'label': case.label, 'seed': case.seed, 'effects': [str(e) for e in case.effects]}
    record, model = record_of(case, days)
    try:
        found = diagnose(record, model, case.given)
    except ValveflowError as error:
        return {**about, 'error': str(error), 'right': False}
    grids = record.grids(record.faults()[0])
    task = Task(grids, grids.open_rows, np.zeros(ORDER))
    rest = minutes(grids, task.residual(found.simulation))
    ours = minutes(grids, fair_open_residual(task, found.extended))
    opened, sealed = (
        minutes(grids, rows.astype(np.float64)) == 1.0
        for rows in (grids.open_rows, grids.sealed_rows)
    )
    guessed = learned(features(grids), rest, opened)
    left = {'plain': rest, 'extended': ours} | {n: rest - y for n, y in guessed.items()}
    return {
        **about, 'names': [c.name for c in found.causes], 'right': right(case, found),
        'rmse_mw': {n: round(float(np.sqrt(np.mean(e[sealed] ** 2))), 4) for n, e in left.items()},
    }  # fmt: skip


def compared(errors: list[dict[str, float]]) -> dict[str, Any]:
    """Return the records, in how many ours is as good as a learner, and the reductions."""
    if not errors:
        return {'records': 0}
    return {
        'records': len(errors),
        'at_least_as_good_as': {
            key: sum(r['extended'] <= r[key] for r in errors) for key in LEARNERS
        },
        'median_reduction': {
            key: round(float(np.median([1.0 - r[key] / r['plain'] for r in errors])), 4)
            for key in ('extended', *LEARNERS)
        },
    }


def main() -> None:
    parser = study.options(__doc__, seeds=1, first=35000, days=5.0)
    given = parser.parse_args()
    cases = [
        plants.hidden((name,), seed, given.days, (2.0, 3.0))
        for seed in study.seeds(given) for name in plants.EFFECTS
    ]  # fmt: skip
    name = study.name_of('learners', given)
    rows = study.rows_of(name, row_of, cases, given.days)
    done = {
        'all': [r['rmse_mw'] for r in rows if 'rmse_mw' in r],
        'named': [r['rmse_mw'] for r in rows if r['right']],
    }
    study.keep(name, **{which: compared(errors) for which, errors in done.items()}, rows=rows)


if __name__ == '__main__':
    main()
