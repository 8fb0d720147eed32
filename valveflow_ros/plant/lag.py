"""First-order lags with delay, exact for an input that is straight between two samples."""

from __future__ import annotations

import math

import numpy as np

from valveflow_ros.jit import jit
from valveflow_ros.plant.unit import Region
from valveflow_ros.records import FloatArray


def lag_coefficients(time_s: float, step_s: float) -> tuple[float, float, float]:
    """Return (a, b, c) of ``y[t] = a y[t-1] + b x[t-1] + c x[t]``; a time of 0 is no lag.

    The paper gives G_i in continuous time, eq. (31). Between two samples the
    input of a valve on a ramp is straight, so a ramp is answered late by
    exactly T + tau at any sample period, as eq. (13) says.
    """
    if time_s == 0.0:
        return 0.0, 0.0, 1.0
    a = math.exp(-step_s / time_s)
    mean = (1.0 - a) * time_s / step_s
    return a, mean - a, 1.0 - mean


def lag_table(regions: tuple[Region, ...], step_s: float) -> tuple[FloatArray, int]:
    """Return rows (power_to, a, b, c, delay in samples) and how many past samples they need."""
    rows = [
        (r.power_to_mw, *lag_coefficients(r.time_constant_s, step_s), r.delay_s / step_s)
        for r in regions
    ]
    return np.array(rows), int(max(row[4] for row in rows)) + 3


@jit
def _late(flow: FloatArray, now: int, delay: float) -> float:
    """Return the flow ``delay`` samples before ``now``, linear between samples."""
    whole = int(delay)
    part = delay - whole
    return float(flow[now - whole] * (1.0 - part) + flow[now - whole - 1] * part)


@jit
def answer(flow: FloatArray, now: int, before: float, lags: FloatArray) -> float:
    """Return the answer of G_i at ``now``, i being the region of the present flow, eq. (3)."""
    i = 0
    while i < lags.shape[0] - 1 and flow[now] >= lags[i, 0]:
        i += 1
    old = _late(flow, now - 1, lags[i, 4])
    new = _late(flow, now, lags[i, 4])
    return float(lags[i, 1] * before + lags[i, 2] * old + lags[i, 3] * new)
