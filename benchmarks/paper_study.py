# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The paper's simulation study, many times over: how far the curve found is from the true one.

Run: ``python -m benchmarks.paper_study --seeds 20 --first 1000``. Each seed is ten days at 1 s
of the plant of eqs. (30)-(31). Both curves are judged: the published one, and the exact
partition's of the special segments alone with the paper's rule (24).
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from benchmarks import study
from valveflow_ros.curve.characteristic import Piece
from valveflow_ros.plant.unit import UnitDescription, paper_curve


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


def judged(seed: int, days: float) -> dict[str, Any]:
    begin = time.perf_counter()
    found = study.identify(UnitDescription(), seed, days)
    return {
        'seed': seed, 'seconds': round(time.perf_counter() - begin, 2),
        'special_samples': found.source.samples, 'published': errors(found.pieces),
        'partition': errors(found.partition_pieces),
    }  # fmt: skip


def summary(rows: list[dict[str, Any]], which: str) -> str:
    """Return one line on one of the curves."""
    found = [row[which] for row in rows]
    right = [f for f in found if 'slope' in f]
    slopes, knees = (np.array([f[key] for f in right]) for key in ('slope', 'knee'))
    curve = np.array([f['curve_rmse_mw'] for f in found])
    return (
        f'{which}: J right {len(right)}/{len(found)}; largest slope error median '
        f'{np.median(slopes):.4f} worst {slopes.max():.4f}; largest knee error median '
        f'{np.median(knees):.1f} worst {knees.max():.1f}; curve rmse median '
        f'{np.median(curve):.3f} worst {curve.max():.3f} MW'
    )


def main() -> None:
    given = study.options(__doc__, seeds=10, first=1, days=10.0).parse_args()
    name = study.name_of('paper_study', given)
    rows = study.rows_of(name, judged, study.seeds(given), given.days)
    lines = [summary(rows, which) for which in ('published', 'partition')]
    study.keep(name, days=given.days, summary=lines, rows=rows)


if __name__ == '__main__':
    main()
