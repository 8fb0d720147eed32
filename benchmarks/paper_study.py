# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The paper's simulation study, many times over: how far the curve found is from the true one.

Run: ``python -m benchmarks.paper_study --seeds 20 --first 1000``. Each seed is ten days at 1 s
of the plant of eqs. (30)-(31). Both curves are judged: the published one, and the exact
partition's of the special segments alone with the paper's rule (24). With ``--irregular`` a
gateway sends each signal by itself: three readings in ten are missing, the others come up to 0.4 s
early or late, and the aligner makes a table of them.
"""

from __future__ import annotations

import time
from functools import partial

import numpy as np

from benchmarks import study
from valveflow_ros.curve.characteristic import Piece
from valveflow_ros.fit.fit import fit
from valveflow_ros.parameters import Settings
from valveflow_ros.plant.simulator import simulate
from valveflow_ros.plant.unit import UnitDescription, paper_curve
from valveflow_ros.records import Readings, SampleTable, table_to_readings
from valveflow_ros.signals.align import Aligner


def errors(pieces: tuple[Piece, ...]) -> dict[str, float]:
    """Return the largest errors against the true curve; slopes and knees only if J is right."""
    truth = paper_curve()
    u = np.linspace(pieces[0].u_from, pieces[-1].u_to, 2000)
    knees = np.array([p.u_to for p in pieces[:-1]])
    slopes = np.array([p.slope for p in pieces])
    k = np.searchsorted(knees, u, side='right')
    found = slopes[k] * u + np.array([p.intercept for p in pieces])[k]
    out = {
        'pieces': len(pieces),
        'curve_rmse_mw': float(np.sqrt(np.mean((found - truth(u)) ** 2))),
    }
    if len(pieces) == len(truth.slopes):
        out['slope'] = float(np.abs(slopes - truth.slopes).max())
        out['knee'] = float(np.abs(knees - truth.knots[1:-1]).max())
    return out


def irregular(table: SampleTable, seed: int, settings: Settings) -> SampleTable:
    """Return the table that the aligner makes of readings at odd moments, some missing."""
    readings = table_to_readings(table)
    rng = np.random.default_rng(seed)
    keep = rng.random(len(readings)) < 0.7
    moved = readings.time_ns + rng.integers(-4e8, 4e8, len(readings))
    order = np.flatnonzero(keep)[np.argsort(moved[keep], kind='stable')]
    odd = Readings(
        moved[order], readings.signal[order], readings.value[order], readings.quality[order]
    )
    return Aligner(settings).feed(odd).table


def judged(seed: int, days: float, odd: bool) -> dict[str, object]:
    """Simulate one plant and identify it."""
    table = simulate(days, seed).table
    settings = study.whole_window(UnitDescription(), days)
    begin = time.perf_counter()
    found = fit(study.task_of(irregular(table, seed, settings) if odd else table, settings)[0])
    return {
        'seed': seed,
        'seconds': round(time.perf_counter() - begin, 2),
        'special_samples': found.source.samples,
        'published': errors(found.pieces),
        'partition': errors(found.partition_pieces),
    }


def summary(rows: list[dict[str, object]], which: str) -> str:
    """Return one line on one of the curves."""
    found = [row[which] for row in rows]
    right = [f for f in found if 'slope' in f]  # type: ignore[operator]
    slopes = np.array([f['slope'] for f in right])  # type: ignore[index]
    knees = np.array([f['knee'] for f in right])  # type: ignore[index]
    curve = np.array([f['curve_rmse_mw'] for f in found])  # type: ignore[index]
    return (
        f'{which}: J right {len(right)}/{len(found)}; largest slope error median '
        f'{np.median(slopes):.4f} worst {slopes.max():.4f}; largest knee error median '
        f'{np.median(knees):.1f} worst {knees.max():.1f}; curve rmse median '
        f'{np.median(curve):.3f} worst {curve.max():.3f} MW'
    )


def main() -> None:
    """Run the study, print it, and write it beside the other results."""
    parser = study.options(__doc__, seeds=10, first=1, days=10.0)
    parser.add_argument('--irregular', action='store_true')
    args = parser.parse_args()
    work = partial(judged, days=args.days, odd=args.irregular)
    rows = study.rows_of(work, study.seeds(args.first, args.seeds))
    lines = [summary(rows, which) for which in ('published', 'partition')]
    print('\n'.join(lines))
    kind = 'paper_study_irregular' if args.irregular else 'paper_study'
    name = study.name_of(kind, args.first, args.seeds)
    study.keep(name, days=args.days, summary=lines, rows=rows)


if __name__ == '__main__':
    main()
