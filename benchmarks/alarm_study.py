"""How often the residual alarm cries wolf, and how soon it finds a shift.

Run: ``python -m benchmarks.alarm_study --plants 20 --days 30 --first 300``. Each plant is drawn at
random and identified on ten clean days; then it runs on for ``--days`` with the curve held, first
clean, then with a lasting shift of 1 and of 3 sd of a block mean set in at fifty moments. The
second part asks the chart alone: autocorrelated residuals, limits from ten days, sixty days of
others.
"""

from __future__ import annotations

import json
import math
from functools import partial

import numpy as np

from benchmarks import study
from valveflow_ros.fit.residual_chart import ChartDesign, ResidualChart, block_means, design_chart
from valveflow_ros.monitoring.prediction import Predictor
from valveflow_ros.parameters import Settings
from valveflow_ros.plant.simulator import simulate
from valveflow_ros.plant.unit import random_unit
from valveflow_ros.records import NS_PER_S, Signal
from valveflow_ros.signals.static_form import integrated_input

_MOMENTS = 50


def delays_min(
    design: ChartDesign, time_ns: np.ndarray, residual: np.ndarray, step_s: float, shift: float
) -> list[float]:
    """Return the minutes until a shift is found, for moments spread over the record."""
    found = []
    ahead = round(4 * 3600 / step_s)
    for start in np.linspace(ahead, len(residual) - 4 * ahead, _MOMENTS).astype(int):
        part = slice(start - ahead, start + 3 * ahead)
        r = residual[part].copy()
        r[ahead:] += shift
        evidence, _ = ResidualChart(design, step_s).feed(time_ns[part], r)
        late = np.flatnonzero(np.abs(evidence[ahead:]) > 1.0)
        found.append(float(late[0]) * step_s / 60.0 if len(late) else math.inf)
    return found


def plant(seed: int, days: float) -> dict[str, object]:
    """Identify one plant on ten days and watch it for more of them."""
    unit = random_unit(np.random.default_rng(seed))
    curve = study.identify(unit, seed, 10.0)
    design = curve.residuals.chart
    assert design is not None
    log = simulate(10.0 + days, seed, unit)
    step_s = unit.sample_period_s
    settings = Settings({'sample_period': step_s})
    u = integrated_input(
        log.table.column(Signal.VALVE_OPENING),
        log.table.column(Signal.MAIN_STEAM_PRESSURE),
        settings.real('pressure_exponent'),
    )
    begin = round(10.0 * 86400.0 / step_s)
    power = log.table.column(Signal.GENERATED_POWER)
    predictor = Predictor(curve, step_s, settings.settle_s, 300.0)
    kinds = np.ones(len(u) - begin, dtype=np.uint8)
    block = predictor.predict(
        log.table.time_ns[begin:], u[begin:], np.ascontiguousarray(power[begin:]), kinds
    )
    rows = max(1, round(60.0 / step_s))
    means = block_means(
        np.nan_to_num(block.residual_mw), np.isfinite(block.residual_mw).astype(np.uint8), rows
    )
    sd = float(np.nanstd(means))
    out: dict[str, object] = {
        'seed': seed, 'days': days, 'alarms': study.episodes(block.evidence),
        'block_sd_mw': round(sd, 3), 'correlation': round(design.correlation, 3),
        'limit': [round(v, 2) for v in design.limit],
    }  # fmt: skip
    for size in (1.0, 3.0):
        delays = delays_min(design, block.time_ns, block.residual_mw, step_s, size * sd)
        out[f'delay_min_{size:g}_sd'] = [round(v, 1) for v in delays]
    return out


def alone(correlation: float, seeds: int) -> dict[str, object]:
    """Ask the chart alone: sixty days of AR(1) blocks of 1 s rows are not needed, minutes do."""
    count = 0
    for seed in range(seeds):
        rng = np.random.default_rng((seed, round(1000 * correlation)))
        white = rng.standard_normal((10 + 60) * 1440) * math.sqrt(1.0 - correlation**2)
        series, value = np.empty(len(white)), 0.0
        for k, w in enumerate(white.tolist()):
            value = correlation * value + w
            series[k] = value
        known = series[: 10 * 1440]
        design = design_chart(
            known, np.ones(len(known), np.uint8), 60.0, block_s=60.0, run_length_days=30.0,
            floor_mw=0.0, curve_error_mw=0.0,
        )  # fmt: skip
        time_ns = np.arange(60 * 1440) * 60 * NS_PER_S
        evidence, _ = ResidualChart(design, 60.0).feed(time_ns, series[10 * 1440 :])
        count += study.episodes(evidence)
    return {
        'correlation': correlation,
        'days': 60 * seeds,
        'alarms': count,
        'days_per_alarm': round(60.0 * seeds / max(count, 1), 1),
    }


def main() -> None:
    """Run both parts, print them, and write them beside the other results."""
    args = study.options(__doc__, plants=20, days=30.0, first=300, series=40).parse_args()
    rows = study.rows_of(partial(plant, days=args.days), study.seeds(args.first, args.plants))
    charts = [alone(c, args.series) for c in (0.0, 0.5, 0.9, 0.98)]
    watched, false = args.days * len(rows), sum(int(r['alarms']) for r in rows)  # type: ignore[call-overload]
    summary = {
        'days_watched': watched,
        'false_alarms': false,
        'days_per_false_alarm': round(watched / max(false, 1), 1),
    }
    for size in ('1', '3'):
        delays = np.array([v for r in rows for v in r[f'delay_min_{size}_sd']])  # type: ignore[attr-defined]
        summary[f'median_delay_min_{size}_sd'] = float(np.median(delays))
        summary[f'missed_{size}_sd'] = int(np.isinf(delays).sum())
        summary[f'tried_{size}_sd'] = len(delays)
    print(json.dumps({'plants': summary, 'chart_alone': charts}, indent=1))
    name = study.name_of('alarm', args.first, args.plants)
    study.keep(name, strict=False, summary=summary, chart_alone=charts, plants=rows)


if __name__ == '__main__':
    main()
