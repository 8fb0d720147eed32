"""Hide effects in plants, diagnose them, and count.

    python -m benchmarks.diagnosis_study --kind hidden --seeds 3 --first 5000 --days 10
    python -m benchmarks.diagnosis_study --kind null --seeds 24 --first 5000 --days 10

Every plant is drawn: the unit (every third is the paper's), the size of what is hidden (2 to
4 times the smallest detectable one), sign, onset and phase. Thresholds were fixed on seeds
below 1000.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.diagnosis_cases import EFFECTS, OUTSIDE, PAIRS, Case, hidden, null, outside
from valveflow_ros.config import Settings
from valveflow_ros.core.events import FitRequested, SegmentClosed
from valveflow_ros.core.fit import fit, outline
from valveflow_ros.core.fit_task import FitTask
from valveflow_ros.core.monitor import Monitor
from valveflow_ros.diagnosis.diagnose import Record, diagnose
from valveflow_ros.diagnosis.grid import make_scene
from valveflow_ros.diagnosis.result import Diagnosis
from valveflow_ros.errors import ValveflowError
from valveflow_ros.plant.simulator import SimulatedLog, simulate
from valveflow_ros.records import IntArray

RESULTS = Path(__file__).parent / 'results'
OTHER_SEED = 1_000_003  # of the record that an earlier model comes from


def watched(log: SimulatedLog, days: float) -> tuple[FitTask, IntArray, Settings]:
    """Find special segments, and what a curve is found from."""
    settings = Settings(
        {'refit_period': 0.0, 'window_days': max(days, 0.1),
         'sample_period': log.unit.sample_period_s}
    )  # fmt: skip
    monitor = Monitor(settings)
    fed = monitor.feed(log.table)
    spans = [
        (e.segment.start_ns, e.segment.end_ns) for e in fed.events if isinstance(e, SegmentClosed)
    ]
    (task,) = (e.task for e in monitor.request_fit() if isinstance(e, FitRequested))
    return task, np.array(spans, dtype=np.int64).reshape(-1, 2), settings


def run(case: Case, days: float) -> tuple[Diagnosis, SimulatedLog, Record, dict[str, float]]:
    """Simulate and diagnose one plant."""
    log = simulate(days, case.seed, case.unit, effects=case.effects)
    begin = time.process_time()
    task, spans, settings = watched(log, days)
    if case.given:
        model = fit(watched(simulate(days, case.seed + OTHER_SEED, case.unit), days)[0]).model
    else:
        model = outline(task)
    middle = time.process_time()
    record = Record(
        log.table, settings.real('sample_period'), settings.real('pressure_exponent'),
        settings.settle_s, spans,
    )  # fmt: skip
    again = time.process_time()
    found = diagnose(record, model, case.given)
    cpu = {'identify': middle - begin, 'diagnose': time.process_time() - again}
    return found, log, record, cpu


def share_of_oracle(found: Diagnosis, log: SimulatedLog, record: Record) -> float:
    """Return the part of the explainable squared error that is gone on the sealed blocks."""
    bad = np.zeros(log.table.values.shape, dtype=bool)
    scene = make_scene(record.table, record.step_s, record.pressure_exponent, record.settle_s, bad)
    rows = len(scene.power)
    per = round(scene.mean_s / record.step_s)
    noise = log.noise_mw[: rows * per].reshape(rows, per).mean(axis=1)[scene.sealed_rows]
    floor = float(np.mean(noise**2))
    total = found.rmse_simulation**2 - floor
    return (found.rmse_simulation**2 - found.rmse_extended**2) / total if total > 0.0 else 0.0


def covered(case: Case, found: Diagnosis) -> dict[str, list[float | bool]]:
    """Return value, truth and whether the interval covers, for parameters of the same name."""
    out: dict[str, list[float | bool]] = {}
    for spec in case.effects:
        for cause in found.causes:
            if cause.name != spec.name:
                continue
            for key, e in cause.parameters.items():
                if key in spec.parameters and isinstance(spec.parameters[key], int | float):
                    truth = float(spec.parameters[key])
                    out[f'{cause.name}.{key}'] = [e.value, truth, bool(e.low <= truth <= e.high)]
    return out


def row_of(case: Case, days: float) -> dict[str, Any]:
    """Diagnose one plant and return what is counted."""
    about = {
        'kind': case.kind, 'label': case.label, 'seed': case.seed,
        'effects': [str(e) for e in case.effects],
    }  # fmt: skip
    try:
        found, log, record, cpu = run(case, days)
    except ValveflowError as error:
        return {**about, 'verdict': 'refused', 'names': [], 'error': str(error)}
    names = [c.name for c in found.causes]
    return {
        **about,
        'verdict': found.verdict,
        'names': names,
        'right': set(names) == set(case.names)
        and (found.verdict == 'unexplained') == (case.kind == 'outside'),
        'not_told_apart': list(found.not_told_apart),
        'unexplained_by': list(found.unexplained_by),
        'disturbance_mw': found.disturbance.rms_mw if found.disturbance else None,
        'share': round(share_of_oracle(found, log, record), 3) if case.names else None,
        'p_values': [c.gain.p_value for c in found.causes],
        'parameters': covered(case, found),
        'rejected': {n: r for n, r in found.rejected if n in case.names},
        'cpu_s': {k: round(v, 1) for k, v in cpu.items()},
    }


def cases(args: argparse.Namespace) -> list[Case]:
    """Return the plants asked for."""
    seeds = range(args.first, args.first + args.seeds)
    times = (args.low, args.high)
    if args.kind == 'null':
        return [null(seed) for seed in seeds]
    if args.kind == 'outside':
        return [outside(label, seed) for seed in seeds for label in OUTSIDE]
    if args.kind == 'pair':
        return [hidden(pair, seed, args.days, times) for seed in seeds for pair in PAIRS]
    names = args.effect or list(EFFECTS)
    return [hidden((name,), seed, args.days, times) for seed in seeds for name in names]


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the table: by what was hidden, how often right, and what was said instead."""
    table = {}
    for label in dict.fromkeys(r['label'] for r in rows):
        mine = [r for r in rows if r['label'] == label]
        said = Counter('+'.join(sorted(r['names'])) or r['verdict'] for r in mine)
        shares = [r['share'] for r in mine if r.get('right') and r.get('share') is not None]
        inside = [v[2] for r in mine if r.get('right') for v in r['parameters'].values()]
        table[label] = {
            'records': len(mine), 'right': sum(bool(r.get('right')) for r in mine),
            'said': dict(said.most_common()),
            'share_median': float(np.median(shares)) if shares else None,
            'covered': f'{sum(inside)}/{len(inside)}',
        }  # fmt: skip
    return table


def _plain(value: Any) -> Any:
    """JSON has no NaN: absent is null."""
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_plain(v) for v in value]
    return None if isinstance(value, float) and value != value else value


def main() -> None:
    """Run the study, print it, and write it beside the other results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--kind', choices=['hidden', 'null', 'pair', 'outside'], default='hidden')
    parser.add_argument('--effect', action='append')
    parser.add_argument('--seeds', type=int, default=1)
    parser.add_argument('--first', type=int, default=0)
    parser.add_argument('--days', type=float, default=10.0)
    parser.add_argument('--low', type=float, default=2.0)
    parser.add_argument('--high', type=float, default=4.0)
    parser.add_argument('--output', type=Path)
    args = parser.parse_args()
    rows = []
    for case in cases(args):
        rows.append(row_of(case, args.days))
        print(json.dumps(rows[-1]), flush=True)
    table = summary(rows)
    for label, line in table.items():
        print(f'{label:22} {line["right"]}/{line["records"]}  {line["said"]}')
    last = args.first + args.seeds - 1
    name = f'diagnosis_{args.kind}_{args.first}_{last}_{args.days:g}d.json'
    path = args.output or RESULTS / name
    path.parent.mkdir(exist_ok=True)
    total = {
        'command': 'python -m benchmarks.diagnosis_study '
        f'--kind {args.kind} --seeds {args.seeds} --first {args.first} --days {args.days:g} '
        f'--low {args.low:g} --high {args.high:g}',
        'right': sum(bool(r.get('right')) for r in rows), 'records': len(rows),
        'table': table, 'rows': rows,
    }  # fmt: skip
    path.write_text(json.dumps(_plain(total), indent=1) + '\n', encoding='utf-8')


if __name__ == '__main__':
    main()
