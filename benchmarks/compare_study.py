# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The paper's simulation study: three methods, ten days to learn from, other ten to judge by.

Run: ``python -m benchmarks.compare_study --seeds 5 --first 1``. Each seed is one plant that is
learnt from and, under another seed, judged on. ``--units random`` takes other plants than the
one of eqs. (30)-(31). ``--figure FILE`` draws a result instead (needs matplotlib).

'untuned' is a Hammerstein model as one gets it from one start: even knots, n_b = 2, n_f = 3,
a delay of one row, nothing chosen by data held out.
"""

from __future__ import annotations

import json
import time
from dataclasses import asdict
from functools import partial
from pathlib import Path

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


def compared(seed: int, days: float, random: bool) -> dict[str, object]:
    """Learn from one plant, judge on its other days."""
    unit = random_unit(np.random.default_rng(seed)) if random else UnitDescription()
    settings = study.whole_window(unit, days)
    learn, judged = (
        study.task_of(simulate(days, s, unit).table, settings)[0]
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
        **summary(result),
    }
    row['curve_errors']['untuned'] = asdict(curve_error(plain.static, truth, *ends))
    answer, _ = plain.run(judged_samples := samples_of(judged.contents, settings))
    good = result.trial.good
    row['all_rows_mse_mw2']['untuned.dynamic'] = float(
        np.mean((judged_samples.power_mw - answer)[good] ** 2)
    )
    return row


def summary(r: Comparison) -> dict[str, dict[str, object]]:
    """Return the numbers of one comparison."""
    kinds = {'all': None, 'steady': SegmentKind.STEADY, 'slope': SegmentKind.SLOPE}
    j = r.judgement
    return {
        'finding': finding_of(r.pairs).value,
        'pieces': len(r.characteristic.pieces),
        'hammerstein': {
            'noise': r.hammerstein.noise, 'taps': len(r.hammerstein.model.b),
            'poles': len(r.hammerstein.model.denominator),
            'time_constants_s': r.hammerstein.model.time_constants_s.tolist(),
        },
        'sparse': {'failure': r.failure} if r.sparse is None else {
            'form': r.sparse.form.kind, 'window_s': r.sparse.form.window_s,
            'functions': list(r.sparse.model.terms), 'tried': r.sparse.mse_by_form,
        },
        'curve_errors': {m: asdict(e) for m, e in r.errors.items()},
        'segments': {k: len(j.kinds(kind)) for k, kind in kinds.items()},
        'samples_per_independent_value': j.widening,
        'mse_mw2': {n: {k: j.mse(n, kind) for k, kind in kinds.items()} for n in r.predictions},
        'all_rows_mse_mw2': dict(r.all_rows),
        'zero_mean_stands': {
            n: {'each_sample': j.passed(n, as_paper=True), 'counted': j.passed(n, as_paper=False)}
            for n in r.predictions
        },
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


def lines_of(rows: list[dict[str, object]]) -> list[str]:
    """Return what came out over all seeds, a line each."""
    lines = []
    for m in ('paper', 'proposed', 'hammerstein', 'untuned', 'sparse'):
        e = np.array([row['curve_errors'][m]['rmse_mw'] for row in rows])
        lines.append(f'curve against truth, {m}: rms median {np.median(e):.3f} worst '
                     f'{e.max():.3f} MW')  # fmt: skip
    for n in rows[0]['all_rows_mse_mw2']:
        e = np.array([row['all_rows_mse_mw2'][n] for row in rows])
        lines.append(f'all rows, {n}: mse median {np.median(e):.2f} worst {e.max():.2f} MW^2')
    verdicts: dict[str, list[str]] = {}
    for row in rows:
        for p in row['pairs']:
            verdicts.setdefault(f'{p["terms"]}, against {p["against"]}', []).append(p['ours_is'])
    for name, outcomes in verdicts.items():
        told = ', '.join(f'{outcomes.count(o)} {o}' for o in sorted(set(outcomes)))
        lines.append(f'ours is, {name}: {told}')
    findings = [row['finding'] for row in rows]
    told = ', '.join(f'{f} {findings.count(f)}' for f in sorted(set(findings)))
    return [*lines, f"the paper's finding: {told} of {len(rows)}"]


def draw(source: Path, target: Path) -> None:
    """Draw curve errors and errors of simulation of all seeds."""
    rows = json.loads(source.read_text(encoding='utf-8'))['rows']
    names = {
        'paper': "paper's\ncurve", 'proposed': 'valveflow', 'hammerstein': 'Hammer-\nstein',
        'untuned': 'Hammerstein,\nuntuned', 'sparse': 'sparse',
    }  # fmt: skip
    fig, axes = study.plots().subplots(1, 3, figsize=(13, 4.4), layout='constrained')
    panels: list[tuple[str, dict[str, list[float]]]] = [
        ('curve against the truth, rms (MW)',
         {m: [row['curve_errors'][m]['rmse_mw'] for row in rows] for m in names}),
        ('special segments, MSE relative to valveflow simulated',
         {m: [row['mse_mw2'][f'{m}.{"static" if m == "paper" else "dynamic"}']['all']
              / row['mse_mw2']['proposed.dynamic']['all'] for row in rows]
          for m in names if m != 'untuned'}),
        ('all rows, MSE relative to valveflow simulated',
         {m: [row['all_rows_mse_mw2'][f'{m}.dynamic']
              / row['all_rows_mse_mw2']['proposed.dynamic'] for row in rows]
          for m in names if m != 'paper'}),
    ]  # fmt: skip
    for k, (title, columns) in enumerate(panels):
        axis = axes[k]
        for place, column in enumerate(columns.values()):
            axis.plot([place] * len(column), column, 'o', color='#1f4e86', alpha=0.6)
            middle = float(np.median(column))
            axis.plot([place - 0.3, place + 0.3], [middle] * 2, color='#d55e00', lw=2)
            axis.annotate(f'{middle:.3g}', (place + 0.12, middle), fontsize=8, va='bottom')
        axis.set_xticks(range(len(columns)), [names[m] for m in columns], fontsize=8)
        if k == 0:
            axis.set_yscale('log')
        axis.set_title(title, fontsize=10)
        axis.grid(axis='y', which='both', alpha=0.25)
    fig.suptitle(f'{len(rows)} plants: a point each, the bar is the median', fontsize=10)
    fig.savefig(target, dpi=130)


def main() -> None:
    """Run the study, print it, and write it beside the other results."""
    parser = study.options(__doc__, seeds=5, first=1, days=10.0)
    parser.add_argument('--units', choices=('paper', 'random'), default='paper')
    parser.add_argument('--figure', action='store_true', help='draw what is there, run nothing')
    args = parser.parse_args()
    name = study.name_of(f'compare_study_{args.units}', args.first, args.seeds)
    place = study.RESULTS / f'{name}.json'
    if not args.figure:
        work = partial(compared, days=args.days, random=args.units == 'random')
        rows = study.rows_of(work, study.seeds(args.first, args.seeds))
        lines = lines_of(rows)
        print('\n'.join(lines))
        study.keep(name, summary=lines, rows=rows)
    draw(place, place.with_suffix('.png'))


if __name__ == '__main__':
    main()
