"""A model to begin with where special segments give none."""

from __future__ import annotations

import numpy as np

from valveflow_ros.curve.model import RegionalModel
from valveflow_ros.errors import DataError
from valveflow_ros.fit.problem import Samples
from valveflow_ros.fit.refine import refine
from valveflow_ros.records import FloatArray, SampleTable, Signal
from valveflow_ros.signals.units import integrated_input

_PIECES, _MOST = 4, 6
_LEAST_SPREAD = 0.02


def first_model(
    table: SampleTable, step_s: float, exponent: float, settle_s: float
) -> RegionalModel:
    """Fit curve and dynamics to all rows, beginning with a regression on hats of u.

    Raises
    ------
    DataError
        The valve hardly moves, or too little was measured.
    """
    u = integrated_input(
        table.column(Signal.VALVE_OPENING), table.column(Signal.MAIN_STEAM_PRESSURE), exponent
    )
    power = table.column(Signal.GENERATED_POWER)
    usable = np.isfinite(u) & np.isfinite(power)
    if usable.sum() < 1000:
        raise DataError('Too few rows have opening, pressure and power together.')
    knots = np.quantile(u[usable], np.linspace(0.0, 1.0, _PIECES + 1))
    if knots[-1] - knots[0] < _LEAST_SPREAD * abs(knots[-1]):
        raise DataError('The valve hardly moves in this record: there is nothing to compare.')
    values = _hats(u[usable], knots, power[usable])
    start = RegionalModel(
        knots, values[:-1].copy(), values[1:].copy(), np.empty(0), np.ones(1), np.zeros(1)
    )
    flags = usable.astype(np.uint8)
    flags[1:][np.diff(table.time_ns) > 1.5e9 * step_s] = 0
    samples = Samples(
        np.where(usable, u, 0.0), np.where(usable, power, 0.0), flags, step_s, settle_s,
        max(1, round(10.0 / step_s)),
    )  # fmt: skip
    return refine(samples, start, _MOST).model


def _hats(u: FloatArray, knots: FloatArray, power: FloatArray) -> FloatArray:
    """Return the least squares values at the knots."""
    knots += np.arange(len(knots)) * 1e-6 * (knots[-1] - knots[0])
    table = np.column_stack([np.interp(u, knots, row) for row in np.eye(len(knots))])
    return np.asarray(np.linalg.lstsq(table, power, rcond=None)[0])
