# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""How often the 95 % intervals hold the truth, on plants that differ in everything.

Run: ``python -m benchmarks.coverage_study --seeds 200 --first 9000``. Each seed draws a unit
(rated power, 2 to 6 pieces, 1 to 3 regions, noise, load programme, 1 or 2 s sampling) and runs it
for ten days. Parameters are compared where the number of pieces (of regions) is the true one; how
often it is, how sure the fit is of it, and whether a too simple curve is wrong by more than noise,
is told beside. With ``--days 2`` some breakpoints are hardly visible. ``--recording minute``
identifies means over a minute instead.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from typing import Any

import numpy as np

from benchmarks import study
from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.plant.unit import UnitDescription, random_unit
from valveflow_ros.signals.static_form import INTEGRATED_INPUT

_Z95 = 1.959963984540054
_KINDS = ('slope', 'intercept', 'knee', 'time_constant', 'delay')


def scores(found: Characteristic, unit: UnitDescription) -> Iterator[tuple[str, float]]:
    """Yield each parameter's error over its standard error."""
    truth = unit.curve
    if found.axis != INTEGRATED_INPUT:
        return
    if len(found.pieces) == len(truth.slopes):
        for piece, slope, intercept in zip(
            found.pieces, truth.slopes, truth.intercepts, strict=True
        ):
            yield 'slope', (piece.slope - slope) / piece.slope_stderr
            yield 'intercept', (piece.intercept - intercept) / piece.intercept_stderr
        for (low, high), knee, piece in zip(
            found.breakpoint_intervals, truth.knots[1:-1], found.pieces, strict=False
        ):
            yield 'knee', (piece.u_to - knee) / ((high - low) / (2.0 * _Z95))
    if len(found.dynamics) == len(unit.regions):
        for own, true in zip(found.dynamics, unit.regions, strict=True):
            lag = own.time_constant_s - true.time_constant_s
            yield 'time_constant', lag / own.time_constant_stderr_s
            yield 'delay', (own.delay_s - true.delay_s) / own.delay_stderr_s


def judged(seed: int, given: argparse.Namespace) -> dict[str, Any]:
    """Draw one plant and identify it."""
    unit = random_unit(np.random.default_rng(seed))
    begin = time.process_time()
    found = study.identify(unit, seed, given.days, given.recording)
    table: dict[str, list[float]] = {}
    for name, value in scores(found, unit):
        table.setdefault(name, []).append(round(float(value), 3))
    u = np.linspace(found.pieces[0].u_from, found.pieces[-1].u_to, 2000)
    return {
        'seed': seed,
        'cpu_s': round(time.process_time() - begin, 2),
        'pieces': [len(found.pieces), len(unit.curve.slopes)],
        'confidence': round(found.choice.confidence[len(found.pieces)], 4),
        'regions': [len(found.dynamics), len(unit.regions)],
        'curve_rmse_mw': round(float(np.sqrt(np.mean((found(u) - unit.curve(u)) ** 2))), 4),
        'noise_mw': round(float(np.hypot(unit.noise.slow_mw, unit.noise.white_mw)), 2),
        'scores': table,
    }


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return coverage by kind of parameter, and how often the sizes were right."""
    out: dict[str, Any] = {
        'plants': len(rows),
        'pieces_right': sum(r['pieces'][0] == r['pieces'][1] for r in rows),
        'confidence': round(float(np.mean([r['confidence'] for r in rows])), 3),
        'regions_right': sum(r['regions'][0] == r['regions'][1] for r in rows),
    }
    for name in _KINDS:
        z = np.array([v for r in rows for v in r['scores'].get(name, [])])
        known = z[np.isfinite(z)]
        out[name] = {'count': len(z), 'not_known': len(z) - len(known)}
        if len(known):
            out[name] |= {
                'covered_95': round(float(np.mean(np.abs(known) < _Z95)), 4),
                'robust_sd': round(float(1.4826 * np.median(np.abs(known))), 3),
                'bias': round(float(np.mean(np.clip(known, -5, 5))), 3),
            }
    return out


def main() -> None:
    parser = study.options(__doc__, seeds=200, first=9000, days=10.0)
    parser.add_argument('--recording', choices=('1s', 'minute'), default='1s')
    given = parser.parse_args()
    name = study.name_of('coverage' + '_minute' * (given.recording == 'minute'), given)
    rows = study.rows_of(name, judged, study.seeds(given), given)
    study.keep(name, days=given.days, summary=summary(rows), rows=rows)


if __name__ == '__main__':
    main()
