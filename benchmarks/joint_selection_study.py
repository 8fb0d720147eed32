# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The number of pieces in the joint fit of random units, and whether its confidence is right.

Run: ``python -m benchmarks.joint_selection_study --seeds 40 --first 5000``. Each seed draws a
unit of two to six pieces, one to three regions and other noise, and one, two or four days of
its operation: short windows, so that some knees are hardly visible. A knee of the
true curve counts where at least 1 % of the samples lie on either side of it. Seeds below 1000
were used to set how far the evidence is believed.
"""

from __future__ import annotations

import json
import time

import numpy as np

from benchmarks import study
from valveflow_ros.errors import ValveflowError
from valveflow_ros.fit.fit import fit
from valveflow_ros.plant.simulator import simulate
from valveflow_ros.plant.unit import random_unit

FIRST_UNTOUCHED = 1000
EDGES = ((0.0, 0.6), (0.6, 0.8), (0.8, 0.9), (0.9, 1.01))


def judged(seed: int) -> dict[str, object]:
    """Simulate one unit and identify it."""
    rng = np.random.default_rng([seed, 5])
    unit = random_unit(rng)
    days = float(rng.choice([1.0, 2.0, 4.0]))
    log = simulate(days, seed, unit)
    begin = time.process_time()
    task, _ = study.task_of(log.table, study.whole_window(unit, days))
    try:
        found = fit(task)
    except ValveflowError as error:
        return {'seed': seed, 'days': days, 'refused': str(error)}
    u = task.contents.u[np.isfinite(task.contents.u)]
    below = np.array([np.mean(u < knot) for knot in unit.curve.knots[1:-1]])
    return {
        'seed': seed, 'days': days,
        'truth': int(np.sum((below > 0.01) & (below < 0.99))) + 1,
        'found': len(found.pieces),
        'confidence': {str(j): round(p, 4) for j, p in found.choice.confidence.items()},
        'identifiable': [s.identifiable for s in found.support],
        'cpu_s': round(time.process_time() - begin, 1),
    }  # fmt: skip


def summary(rows: list[dict[str, object]]) -> dict[str, object]:
    """Return the share right, and how confidence and being right go together."""
    sure = np.array([row['confidence'][str(row['found'])] for row in rows])  # type: ignore[index]
    right = np.array([row['found'] == row['truth'] for row in rows])
    bins = []
    for low, high in EDGES:
        inside = (sure >= low) & (sure < high)
        if inside.any():
            bins.append({
                'from': low, 'to': min(high, 1.0), 'units': int(inside.sum()),
                'said': round(float(sure[inside].mean()), 3),
                'right': round(float(right[inside].mean()), 3),
            })  # fmt: skip
    return {
        'units': len(rows), 'right_percent': round(100.0 * float(right.mean()), 1),
        'mean_confidence': round(float(sure.mean()), 3), 'calibration': bins,
    }  # fmt: skip


def main() -> None:
    """Run the study, print it, and write it beside the other results."""
    parser = study.options(__doc__, seeds=40, first=5000)
    args = parser.parse_args()
    if args.first < FIRST_UNTOUCHED:
        parser.error(f'seeds below {FIRST_UNTOUCHED} were used to set the constants')
    rows = study.rows_of(judged, study.seeds(args.first, args.seeds))
    found = summary([row for row in rows if 'found' in row])
    print(json.dumps(found, indent=1))
    study.keep('joint_selection_study', summary=found, rows=rows)


if __name__ == '__main__':
    main()
