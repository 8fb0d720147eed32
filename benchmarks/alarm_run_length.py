# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Days between false residual alarms under correlated noise.

Run: ``python -m benchmarks.alarm_run_length --records 40``. This asks the chart and the alarm
alone, row by row at 1 Hz, without a plant: AR(1) noise of the coefficients given, scaled so that a
mean over one block has an sd of ``--block-sd``. The chart designs itself from ten days of it, as
it does on the days a curve was fitted to, and then watches others (``--days``), during which the
curve is wrong by an error that the load, drifting by the hour and by the day, leads along the
curve. The error is drawn from the standard error that the design was told of; the ten days do not
show it.
"""

from __future__ import annotations

import argparse
import math
from typing import Any

import numpy as np
from scipy.signal import lfilter

from benchmarks import study
from valveflow_ros.fit.residual_chart import ResidualChart, design_chart
from valveflow_ros.monitoring.alarms import AlarmState, ResidualAlarm
from valveflow_ros.parameters import Settings
from valveflow_ros.records import NS_PER_S, FloatArray

PHI = (0.0, 0.5, 0.9, 0.98, 0.995)
_DAY = 86400
_DESIGN_DAYS = 10
_KNOTS = 5
_SETTINGS = Settings()
_BLOCK = round(_SETTINGS.real('alarm_block'))
_RUN_DAYS = _SETTINGS.real('alarm_run_length')
_DRAWS = 2000


def block_sd(phi: float) -> float:
    """Return the sd of a mean over one block of AR(1) noise of sd 1."""
    lags = np.arange(1, _BLOCK)
    return math.sqrt((1.0 + 2.0 * float(((1.0 - lags / _BLOCK) * phi**lags).sum())) / _BLOCK)


def noise(rng: np.random.Generator, rows: int, phi: float, sd: float) -> FloatArray:
    """Return AR(1) noise."""
    white = rng.standard_normal(rows)
    white[1:] *= math.sqrt(1.0 - phi * phi)
    return np.asarray(lfilter([sd], [1.0, -phi], white))


def curve_error(rng: np.random.Generator, rows: int, error_mw: float) -> FloatArray:
    """Return how wrong a curve is where a drifting load leads, row by row."""
    minutes = rows // 60
    slow = noise(rng, minutes, math.exp(-1.0 / 120.0), 0.15)
    daily = 0.3 * np.sin(2.0 * np.pi * (np.arange(minutes) / 1440.0 + rng.random()))
    at_knots = rng.normal(0.0, error_mw, _KNOTS)
    error = np.interp(0.5 + daily + slow, np.linspace(0.0, 1.0, _KNOTS), at_knots)
    return np.repeat(error, 60)


def record(seed: int, phi: float, given: argparse.Namespace) -> dict[str, Any]:
    """Design a chart on ten days and watch the others with the alarm's own delays."""
    rng = np.random.default_rng((seed, round(1000 * phi)))
    sd = given.block_sd / block_sd(phi)
    known = noise(rng, _DESIGN_DAYS * _DAY, phi, sd)
    design = design_chart(
        known, np.ones(len(known), np.uint8), 1.0, block_s=float(_BLOCK),
        run_length_days=_RUN_DAYS, floor_mw=_SETTINGS.real('alarm_floor'),
        curve_error_mw=given.curve_error,
    )  # fmt: skip
    rows = given.days * _DAY
    residual = noise(rng, rows, phi, sd) + curve_error(rng, rows, given.curve_error)
    chart, alarm = ResidualChart(design, 1.0), ResidualAlarm(_SETTINGS)
    raised_ns: list[int] = []
    for day in range(given.days):
        part = slice(day * _DAY, (day + 1) * _DAY)
        time_ns = np.arange(part.start, part.stop, dtype=np.int64) * NS_PER_S
        changes = alarm.feed(time_ns, *chart.feed(time_ns, residual[part]), 'm')
        raised_ns += [c.time_ns for _, c in changes if c.state == AlarmState.UNACKNOWLEDGED]
    return {
        'alarms': alarm.occurrence,
        # The third announcement within a minute, and each more.
        'chattering': sum(
            c - a < 60 * NS_PER_S for a, c in zip(raised_ns, raised_ns[2:], strict=False)
        ),
        'correlation': design.correlation,
    }


def summary(phi: float, given: argparse.Namespace) -> dict[str, Any]:
    """Return the figures of one coefficient.

    The mean time between alarms has a lower 95 % bound by drawing records anew. An alarm more is
    counted in each drawing, so that records without any prove no more than they can.
    """
    found = [record(seed, phi, given) for seed in range(given.first, given.first + given.records)]
    alarms = np.array([r['alarms'] for r in found], dtype=np.float64)
    days = given.days * len(found)
    mean = days / max(float(alarms.sum()), 1.0)
    drawn = np.random.default_rng(1).choice(alarms, (_DRAWS, len(alarms))).sum(axis=1)
    return {
        'phi': phi, 'records': len(found), 'days': days, 'alarms': int(alarms.sum()),
        'days_per_alarm': round(mean, 1),
        'days_per_alarm_low_95': round(float(np.quantile(days / (drawn + 1.0), 0.05)), 1),
        'alarms_per_30_days': round(30.0 / mean, 2),
        'most_alarms_in_a_record': int(alarms.max()),
        'chattering': sum(r['chattering'] for r in found),
        'block_correlation': round(float(np.median([r['correlation'] for r in found])), 3),
    }  # fmt: skip


def main() -> None:
    given = study.options(
        __doc__, records=40, days=60, first=5000, block_sd=5.0, curve_error=0.2
    ).parse_args()
    name = f'alarm_run_length_{given.first}_{given.first + given.records - 1}'
    rows = study.rows_of(name, summary, PHI, given)
    study.keep(name, noise=rows)


if __name__ == '__main__':
    main()
