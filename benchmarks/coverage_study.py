# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""How often the 95 % intervals hold the truth, on plants that differ in everything.

Run: ``python -m benchmarks.coverage_study --seeds 200 --first 9000``. Each seed draws a unit
(rated power, 2 to 6 pieces, 1 to 3 regions, noise, load programme, 1 or 2 s sampling) and runs it
for ten days. Parameters are compared where the number of pieces (of regions) is the true one; how
often it is, and whether a too simple curve is wrong by more than noise, is told beside.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from functools import partial

import numpy as np

from benchmarks import study
from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.plant.unit import UnitDescription, random_unit

_Z95 = 1.959963984540054


def scores(found: Characteristic, unit: UnitDescription) -> Iterator[tuple[str, float]]:
    """Yield each parameter's error over its standard error."""
    truth = unit.curve
    if len(found.pieces) == len(truth.slopes):
        for piece, slope, intercept in zip(
            found.pieces, truth.slopes, truth.intercepts, strict=True
        ):
            yield 'slope', (piece.slope - slope) / piece.slope_stderr
            yield 'intercept', (piece.intercept - intercept) / piece.intercept_stderr
        for (low, high), knee, piece in zip(
            found.breakpoint_intervals, truth.knots[1:-1], found.pieces, strict=False
        ):
            error = (high - low) / (2.0 * _Z95)
            yield 'knee', (piece.u_to - knee) / error
    if len(found.dynamics) == len(unit.regions):
        for region, true in zip(found.dynamics, unit.regions, strict=True):
            yield (
                'time_constant',
                (region.time_constant_s - true.time_constant_s) / region.time_constant_stderr_s,
            )
            yield 'delay', (region.delay_s - true.delay_s) / region.delay_stderr_s


def judged(seed: int, days: float) -> dict[str, object]:
    """Draw one plant and identify it."""
    unit = random_unit(np.random.default_rng(seed))
    begin = time.process_time()
    found = study.identify(unit, seed, days)
    table: dict[str, list[float]] = {}
    for name, value in scores(found, unit):
        table.setdefault(name, []).append(round(float(value), 3))
    u = np.linspace(found.pieces[0].u_from, found.pieces[-1].u_to, 2000)
    return {
        'seed': seed,
        'cpu_s': round(time.process_time() - begin, 2),
        'pieces': [len(found.pieces), len(unit.curve.slopes)],
        'regions': [len(found.dynamics), len(unit.regions)],
        'curve_rmse_mw': round(float(np.sqrt(np.mean((found(u) - unit.curve(u)) ** 2))), 4),
        'noise_mw': round(float(np.hypot(unit.noise.slow_mw, unit.noise.white_mw)), 2),
        'scores': table,
    }


def summary(rows: list[dict[str, object]]) -> dict[str, object]:
    """Return coverage by kind of parameter, and how often the sizes were right."""
    out: dict[str, object] = {
        'plants': len(rows),
        'pieces_right': sum(r['pieces'][0] == r['pieces'][1] for r in rows),  # type: ignore[index]
        'regions_right': sum(r['regions'][0] == r['regions'][1] for r in rows),  # type: ignore[index]
    }
    for name in ('slope', 'intercept', 'knee', 'time_constant', 'delay'):
        z = np.array([v for r in rows for v in r['scores'].get(name, [])])  # type: ignore[attr-defined]
        known = z[np.isfinite(z)]
        out[name] = {
            'count': len(z),
            'not_known': len(z) - len(known),
            'covered_95': round(float(np.mean(np.abs(known) < _Z95)), 4) if len(known) else None,
            'robust_sd': round(float(1.4826 * np.median(np.abs(known))), 3)
            if len(known)
            else None,
            'bias': round(float(np.mean(np.clip(known, -5, 5))), 3) if len(known) else None,
        }
    return out


def main() -> None:
    """Run the study, print it, and write it beside the other results."""
    args = study.options(__doc__, seeds=200, first=9000, days=10.0).parse_args()
    rows = study.rows_of(partial(judged, days=args.days), study.seeds(args.first, args.seeds))
    result = summary(rows)
    print(json.dumps(result, indent=1))
    name = study.name_of('coverage', args.first, args.seeds)
    study.keep(name, strict=False, days=args.days, summary=result, rows=rows)


if __name__ == '__main__':
    main()
