# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""How well special segments are found: precision and recall against the simulator's truth.

Run: ``python -m benchmarks.segment_study --seeds 4 --first 3000``. What is special in truth
says `segment_truth`. A found segment is right when at least nine tenths of its rows are
special in truth and of its kind; a true stretch is found when half of its rows lie in found
segments of its kind. Rows are counted as well, also against a truth in which a ramp that
crosses a knee of the curve stays one ramp: a bend that small cannot be seen in u. The same
runs are also judged with thresholds that stand on the noise of the ordinary plant instead of
what they learn.
"""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial

import numpy as np

from benchmarks import study
from benchmarks.segment_truth import Stretch, by_row, true_stretches
from valveflow_ros.monitoring.rows import Rows
from valveflow_ros.parameters import Settings
from valveflow_ros.plant.simulator import SimulatedLog, simulate
from valveflow_ros.plant.unit import UnitDescription
from valveflow_ros.records import SegmentKind
from valveflow_ros.segments.segmenter import Segmenter

RIGHT, FOUND = 0.9, 0.5
KINDS = {'steady': SegmentKind.STEADY, 'slope': SegmentKind.SLOPE}
PLANTS = {
    'as in the paper': (1.0, 1.0),
    'noise x 0.5': (0.5, 1.0),
    'noise x 2': (2.0, 1.0),
    '2 s sampling': (1.0, 2.0),
}


def plant(noise: float, period_s: float) -> UnitDescription:
    """Return the paper's unit with other noise: of power, sensors and the valve's own jitter."""
    unit = UnitDescription(sample_period_s=period_s)
    n, p = unit.noise, unit.programme
    return replace(
        unit,
        noise=replace(
            n, slow_mw=noise * n.slow_mw, white_mw=noise * n.white_mw,
            opening_percent=noise * n.opening_percent, pressure_mpa=noise * n.pressure_mpa,
        ),
        programme=replace(p, jitter_percent=noise * p.jitter_percent),
    )  # fmt: skip


def found_segments(
    log: SimulatedLog, settings: Settings
) -> tuple[list[Stretch], dict[str, float]]:
    """Return the segments found and the noise they stand on."""
    segmenter = Segmenter(settings)
    rows = Rows.of(log.table, settings.real('pressure_exponent'))
    out = segmenter.feed(rows.time_ns, rows.u, rows.power_mw, rows.temperature_degc)
    noise = segmenter.noise()
    stretches = [Stretch(f.first_row, f.end_row, int(f.segment.kind)) for _, f in out.found]
    return stretches, {'input': round(noise.input, 3), 'power_mw': round(noise.power_mw, 3)}


def compare(
    true: list[Stretch], without_knees: list[Stretch], found: list[Stretch], n: int, kind: int
) -> dict[str, int]:
    """Count segments and rows of one kind."""
    truth, seen = by_row(true, n), by_row(found, n)
    driven = by_row(without_knees, n)
    right = [float(np.mean(truth[a:b] == kind)) >= RIGHT for a, b, k in found if k == kind]
    hit = [float(np.mean(seen[a:b] == kind)) >= FOUND for a, b, k in true if k == kind]
    return {
        'found': len(right), 'right': sum(right), 'true': len(hit), 'hit': sum(hit),
        'rows_found': int(np.sum(seen == kind)), 'rows_true': int(np.sum(truth == kind)),
        'rows_both': int(np.sum((seen == kind) & (truth == kind))),
        'rows_driven_so': int(np.sum((seen == kind) & (driven == kind))),
    }  # fmt: skip


def shares(counts: dict[str, int]) -> dict[str, float | None]:
    """Return precision and recall, of segments and of rows."""

    def share(part: str, whole: str) -> float | None:
        return round(counts[part] / counts[whole], 3) if counts[whole] else None

    return {
        'precision': share('right', 'found'), 'recall': share('hit', 'true'),
        'row_precision': share('rows_both', 'rows_found'),
        'row_recall': share('rows_both', 'rows_true'),
        'row_precision_but_for_knees': share('rows_driven_so', 'rows_found'),
    }  # fmt: skip


def judged(name: str, seeds: range, days: float, fixed: dict[str, float]) -> dict[str, object]:
    """Judge one kind of plant over some seeds, with learnt and with fixed thresholds."""
    noise, period_s = PLANTS[name]
    given = {'sample_period': period_s}
    learnt = Settings(given)
    rigid = Settings({**given, 'input_noise': fixed['input'], 'power_noise': fixed['power_mw']})
    totals: dict[str, dict[str, dict[str, int]]] = {'learnt': {}, 'fixed': {}}
    levels = []
    for seed in seeds:
        log = simulate(days, seed, plant(noise, period_s))
        true = true_stretches(log, seed, learnt)
        without_knees = true_stretches(log, seed, learnt, knees=False)
        for how, settings in (('learnt', learnt), ('fixed', rigid)):
            found, level = found_segments(log, settings)
            if how == 'learnt':
                levels.append(level)
            for kind, number in KINDS.items():
                counts = compare(true, without_knees, found, len(log.load_mw), number)
                sums = totals[how].setdefault(kind, dict.fromkeys(counts, 0))
                for key, value in counts.items():
                    sums[key] += value
    return {
        'plant': name, 'noise_learnt': levels,
        **{
            how: {kind: {**shares(c), 'counts': c} for kind, c in kinds.items()}
            for how, kinds in totals.items()
        },
    }  # fmt: skip


def ordinary_noise(seeds: range, days: float) -> dict[str, float]:
    """Return the noise learnt on the ordinary plant, the mean over the seeds."""
    found = [found_segments(simulate(days, s, plant(1.0, 1.0)), Settings({}))[1] for s in seeds]
    return {key: float(np.mean([f[key] for f in found])) for key in found[0]}


def main() -> None:
    """Run the study, print it, and write it beside the other results."""
    parser = study.options(__doc__, seeds=4, first=3000, days=5.0)
    parser.add_argument('--figure', action='store_true', help='draw the result (needs matplotlib)')
    args = parser.parse_args()
    if args.figure:
        from benchmarks.segment_figure import draw

        place = study.RESULTS / 'segment_study.json'
        draw(json.loads(place.read_text(encoding='utf-8')), place.with_suffix('.png'))
        return
    seeds = study.seeds(args.first, args.seeds)
    fixed = ordinary_noise(seeds, min(args.days, 2.0))
    rows = study.rows_of(partial(judged, seeds=seeds, days=args.days, fixed=fixed), PLANTS)
    study.keep('segment_study', first_seed=args.first, fixed_noise=fixed, plants=rows)


if __name__ == '__main__':
    main()
