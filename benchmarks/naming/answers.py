# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What answers the benchmark: `valveflow_ros.diagnose` and two plain methods as baselines.

A baseline fits a curve of the power to the first half of a record and judges the residual of the
whole in means over half an hour. Its limit was set on the practice set: just above what the
healthy records there reach.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import valveflow_ros as vf
from benchmarks.naming.records import NAMES
from benchmarks.naming.scoring import UNKNOWN
from valveflow_ros.errors import DataError
from valveflow_ros.records import FloatArray

_CONDENSER = 'condenser_pressure_kpa'
_PAPER_EXPONENT = 1.125


def answer(path: Path, method: str) -> dict[str, Any]:
    """Return the answer of a method to a record."""
    return METHODS[method](pd.read_csv(path, parse_dates=['time']))


def _estimate(value: float, low: float, high: float) -> dict[str, float] | None:
    numbers = {'value': float(value), 'low': float(low), 'high': float(high)}
    return numbers if np.isfinite(list(numbers.values())).all() else None


def valveflow(frame: pd.DataFrame) -> dict[str, Any]:
    """Answer as `valveflow_ros.diagnose` does; a refusal names nothing."""
    physics = _CONDENSER in frame
    covariates = {'vacuum': _CONDENSER} if physics else {}
    # `flow_law` in records.json: known for the plants of the paper's kind.
    law = {} if physics else {'pressure_exponent': _PAPER_EXPONENT}
    try:
        found = vf.diagnose(frame, parameters=law, covariates=covariates).diagnosis
    except DataError:
        return {'names': []}
    causes = [c for c in found.causes if c.name in NAMES]
    if not causes:
        slow = found.disturbance is not None and bool(found.disturbance.shape)
        return {'names': UNKNOWN if found.verdict == 'unexplained' or slow else []}
    said: dict[str, Any] = {'names': [c.name for c in causes]}
    for k, (name, e) in enumerate(causes[0].parameters.items()):
        if k == 0:
            said['size'] = _estimate(e.value, e.low, e.high)
        elif name == 't0_days':
            said['onset_hours'] = _estimate(24.0 * e.value, 24.0 * e.low, 24.0 * e.high)
    return said


# What both baselines start from.

_EXPONENTS = np.arange(0.8, 1.31, 0.05)
_KNOTS = 8


def residual(frame: pd.DataFrame) -> pd.DataFrame:
    """Return half-hour means: signals, power of the curve of the first half, residual.

    The curve is hinges over V p^m, or p^m times hinges over V plus a constant; form and m are
    those of the least squares. ``per_input`` is the power for a relative change of the opening.
    """
    rows = frame.set_index('time').resample('300s').mean().dropna()
    v, p, y = (rows[c].to_numpy() for c in (
        'valve_opening_percent', 'main_steam_pressure_mpa', 'generated_power_mw',
    ))  # fmt: skip
    half = len(rows) // 2
    fits = []
    for m in _EXPONENTS:
        for whole in (True, False):
            basis = _basis(v[:half], p[:half], float(m), whole)
            a = basis(v[:half], p[:half])
            found = np.linalg.lstsq(a, y[:half], rcond=None)[0]
            fits.append((float(np.sum((y[:half] - a @ found) ** 2)), basis, found))
    _, basis, found = min(fits, key=lambda f: f[0])
    rows['curve'] = basis(v, p) @ found
    rows['per_input'] = (basis(1.001 * v, p) @ found - rows['curve']) / 0.001
    rows['residual'] = y - rows['curve']
    moved = np.diff(v, prepend=v[0])
    rows['direction'], rows['ramp'] = np.sign(moved), moved
    return rows.resample('1800s').mean().dropna()


def _basis(
    v: FloatArray, p: FloatArray, m: float, whole: bool
) -> Callable[[FloatArray, FloatArray], FloatArray]:
    x = v * p**m if whole else v
    knots = np.quantile(x, np.linspace(0.0, 1.0, _KNOTS + 2)[1:-1])

    def of(v: FloatArray, p: FloatArray) -> FloatArray:
        x, factor = (v * p**m, np.ones_like(v)) if whole else (v, p**m)
        hinges = [np.maximum(x - k, 0.0) for k in knots]
        return np.column_stack([np.ones_like(v), factor, *(factor * h for h in (x, *hinges))])

    return of


def _least_squares(a: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Return coefficients, their standard errors with AR(1) residuals, and the sum of squares."""
    found, inverse = np.linalg.pinv(a) @ y, np.linalg.pinv(a.T @ a)
    left = y - a @ found
    squares = float(left @ left)
    phi = min(max(float(left[1:] @ left[:-1]) / squares, 0.0), 0.95)
    variance = squares / (len(y) - a.shape[1]) * (1.0 + phi) / (1.0 - phi)
    return found, np.sqrt(variance * np.diag(inverse)), squares


def _splits(rows: int) -> range:
    return range(max(rows // 10, 8), rows - max(rows // 10, 8))


# Baseline 1: the residual against what could explain it.

_REGRESSION_LIMIT = 5.0  # |t|
_COLUMN_NAMES = {
    'temperature': 'temperature', 'pressure': 'exponent', 'opening': 'curve_shape',
    'direction': 'backlash', 'trend': 'gain_drift', 'step': 'gain_step', 'sine': 'diurnal',
    'cosine': 'diurnal',
}  # fmt: skip


def regression(frame: pd.DataFrame) -> dict[str, Any]:
    """Name the cause of the column with the largest t-value, by a fixed table."""
    rows = residual(frame)
    hours = 0.5 * np.arange(len(rows))
    day = 2.0 * np.pi * (rows.index.hour + rows.index.minute / 60.0).to_numpy() / 24.0
    power = rows['curve'].to_numpy()
    columns = {
        'temperature': rows['main_steam_temperature_degc'].to_numpy(),
        'pressure': rows['main_steam_pressure_mpa'].to_numpy(),
        'opening': rows['valve_opening_percent'].to_numpy(),
        'direction': rows['direction'].to_numpy(), 'ramp': rows['ramp'].to_numpy(),
        'trend': power * hours, 'sine': power * np.sin(day), 'cosine': power * np.cos(day),
    }  # fmt: skip
    if _CONDENSER in rows:  # it explains, but it is no cause
        columns['condenser'] = rows[_CONDENSER].to_numpy()
    plain = np.column_stack([np.ones(len(rows)), *columns.values()])
    y = rows['residual'].to_numpy()
    fits = []
    for k in _splits(len(rows)):
        step = np.where(np.arange(len(rows)) >= k, power, 0.0)
        fits.append((k, *_least_squares(np.column_stack([plain, step]), y)))
    k, found, errors, _ = min(fits, key=lambda fit: fit[3])
    t = dict(zip((*columns, 'step'), found[1:] / errors[1:], strict=True))
    best = max(_COLUMN_NAMES, key=lambda name: abs(t[name]))
    if abs(t[best]) < _REGRESSION_LIMIT:
        return {'names': []}
    said: dict[str, Any] = {'names': [_COLUMN_NAMES[best]]}
    if best == 'step':
        half = 1.96 * errors[-1]
        said['size'] = _estimate(found[-1], found[-1] - half, found[-1] + half)
        said['onset_hours'] = _estimate(hours[k], hours[k] - 0.5, hours[k] + 0.5)
    return said


# Baseline 2: the moment at which the mean of the residual changes.

_CUSUM_LIMIT = 1.5


def changepoint(frame: pd.DataFrame) -> dict[str, Any]:
    """Find changes by binary segmentation; name a single one by its size over the load.

    Several changes, and one of the same size at each load, have no name.
    """
    rows = residual(frame)
    y = rows['residual'].to_numpy()
    if _CONDENSER in rows:
        a = np.column_stack([np.ones(len(y)), rows[_CONDENSER]])
        y = y - a @ np.linalg.lstsq(a, y, rcond=None)[0]
    largest, k = _cusum(y)
    if largest < _CUSUM_LIMIT:
        return {'names': []}
    after = np.arange(len(y)) >= k
    if max(_cusum(y[:k])[0], _cusum(y[k:])[0]) >= _CUSUM_LIMIT:
        return {'names': UNKNOWN}
    opening = rows['valve_opening_percent'].to_numpy()
    shapes = {
        'offset': np.ones(len(y)), 'gain_step': rows['curve'].to_numpy(),
        'input_step': rows['per_input'].to_numpy(),
        'curve_step': (opening > np.median(opening)).astype(float),
    }  # fmt: skip
    fits = {
        name: _least_squares(np.column_stack([np.ones(len(y)), after * shape]), y)
        for name, shape in shapes.items()
    }
    best = min(fits, key=lambda name: fits[name][2])
    if best == 'offset':
        return {'names': UNKNOWN}
    said: dict[str, Any] = {'names': [best]}
    said['onset_hours'] = _estimate(0.5 * k, 0.5 * k - 0.5, 0.5 * k + 0.5)
    if best != 'curve_step':
        g, half = fits[best][0][1], 1.96 * fits[best][1][1]
        said['size'] = _estimate(g, g - half, g + half)
    return said


def _cusum(y: FloatArray) -> tuple[float, int]:
    """Return the largest CUSUM in parts of the long-run standard deviation, and its row."""
    if len(y) < 24:
        return 0.0, 0
    x = y - y.mean()
    sums = np.cumsum(x)[:-1]
    k = 1 + int(np.argmax(np.abs(sums)))
    # About the means before and after: the change itself is no noise.
    left = np.concatenate([y[:k] - y[:k].mean(), y[k:] - y[k:].mean()])
    phi = min(max(float(left[1:] @ left[:-1]) / float(left @ left), 0.0), 0.95)
    sd = float(left.std()) * np.sqrt((1.0 + phi) / (1.0 - phi))
    return float(abs(sums[k - 1])) / (sd * np.sqrt(len(y))), k


METHODS: dict[str, Callable[[pd.DataFrame], dict[str, Any]]] = {
    'valveflow': valveflow, 'regression': regression, 'changepoint': changepoint,
}  # fmt: skip
