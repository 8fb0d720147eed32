# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The closed loop of valve, turbine and power control, step by step."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from valveflow_ros.numerics import jit
from valveflow_ros.plant.effect import ActuatorLimits, AddedCurve, Hooks
from valveflow_ros.plant.unit import Region
from valveflow_ros.records import FloatArray

# The actuator's faults as operators on a moving position, sample by sample.


# Stored positions: after the rate limit, after the stick-slip, after the slack.
N_POSITIONS = 3


def settings(bank: ActuatorLimits, step_s: float) -> FloatArray:
    """Return the settings of `move`: largest step, slip-off, slip-to, top, half slack."""
    return np.array([
        bank.rate_percent_per_s * step_s, (bank.band_percent + bank.jump_percent) / 2.0,
        (bank.band_percent - bank.jump_percent) / 2.0, bank.top_percent, bank.slack_percent / 2.0,
    ])  # fmt: skip


@jit
def rate_limited(wanted: float, before: float, largest: float) -> float:
    """Move towards ``wanted`` by at most ``largest``."""
    if wanted > before + largest:
        return before + largest
    if wanted < before - largest:
        return before - largest
    return wanted


@jit
def stick_slip(wanted: float, before: float, off: float, to: float) -> float:
    """Stay until the distance exceeds ``off`` = (S + J)/2, then slip to ``to`` = (S - J)/2.

    He's two-parameter form of the stick band S and the slip jump J; without a
    jump it is a dead band of width S.
    """
    pull = wanted - before
    if pull > off:
        return wanted - to
    if pull < -off:
        return wanted + to
    return before


@jit
def play(wanted: float, before: float, half: float) -> float:
    """Follow only if pushed by one of the two sides of a slack of width ``2 half``."""
    return min(max(before, wanted - half), wanted + half)


@jit
def move(wanted: float, positions: FloatArray, bank: FloatArray) -> float:
    """Return the position after a bank, and update its stored positions.

    Servo first, then the friction of the stem, its upper stop, the slack of the linkage.
    """
    positions[0] = rate_limited(wanted, positions[0], bank[0])
    positions[1] = stick_slip(positions[0], positions[1], bank[1], bank[2])
    positions[2] = play(min(positions[1], bank[3]), positions[2], bank[4])
    return float(positions[2])


# First-order lags with delay, exact for an input that is linear between two samples.


def lag_coefficients(time_s: float, step_s: float) -> tuple[float, float, float]:
    """Return (a, b, c) of ``y[t] = a y[t-1] + b x[t-1] + c x[t]``; a time of 0 is no lag.

    The paper gives G_i in continuous time, eq. (31). The input of a valve on a ramp
    is linear between two samples, so the response to a ramp lags by exactly
    T + tau at any sample period, as in eq. (13).
    """
    if time_s == 0.0:
        return 0.0, 0.0, 1.0
    a = math.exp(-step_s / time_s)
    mean = (1.0 - a) * time_s / step_s
    return a, mean - a, 1.0 - mean


def lag_table(regions: tuple[Region, ...], step_s: float) -> tuple[FloatArray, int]:
    """Return rows (power_to, a, b, c, delay in samples) and the number of past samples needed."""
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
    """Return the response of G_i at ``now`` for the region i of the present flow, eq. (3)."""
    i = 0
    while i < lags.shape[0] - 1 and flow[now] >= lags[i, 0]:
        i += 1
    old = _late(flow, now - 1, lags[i, 4])
    new = _late(flow, now, lags[i, 4])
    return float(lags[i, 1] * before + lags[i, 2] * old + lags[i, 3] * new)


# From the plug's opening to steam power: eqs. (1) and (2), with the changes by effects.


# Above this ratio the ellipse would give almost no flow.
_LARGEST_RATIO = 0.98


class FlowLaw(NamedTuple):
    """The curve, the added curves, and the nozzle.

    ``added_u``, ``added_x`` (k, m) and ``added_from_s`` (k,) are curves on top
    of F; ``nozzle`` is (kappa, critical ratio, sliding pressure at no load, rise
    of the sliding pressure per MW).
    """

    curve_u: FloatArray
    curve_x: FloatArray
    added_u: FloatArray
    added_x: FloatArray
    added_from_s: FloatArray
    nozzle: FloatArray


def _same_length(curves: list[AddedCurve]) -> tuple[FloatArray, FloatArray]:
    """Return curves as two tables; short ones are extended by points on their constant end."""
    m = max((c.u.size for c in curves), default=2)
    u, x = np.zeros((len(curves), m)), np.zeros((len(curves), m))
    for k, curve in enumerate(curves):
        missing = m - curve.u.size
        u[k] = np.append(curve.u, curve.u[-1] + 1.0 + np.arange(missing))
        x[k] = np.append(curve.x_mw, np.full(missing, curve.x_mw[-1]))
    return u, x


def flow_law(hooks: Hooks) -> FlowLaw:
    """Collect the flow law of a run from its hooks."""
    plan = hooks.unit.programme
    curve_x, curve_u = hooks.unit.curve.inverse_table()
    rise = plan.pressure_rise_mpa / plan.pressure_span_mw
    at_no_load = plan.pressure_low_mpa - rise * plan.load_low_mw
    nozzle = (hooks.kappa_mpa_per_mw, hooks.critical_ratio, at_no_load, rise)
    since = np.array([curve.from_s for curve in hooks.added_curves])
    return FlowLaw(curve_u, curve_x, *_same_length(hooks.added_curves), since, np.array(nozzle))


@jit
def interpolate(x: float, xs: FloatArray, ys: FloatArray) -> float:
    """Interpolate linearly; the outer pieces extend beyond the ends."""
    k = 0
    while k < xs.size - 2 and x >= xs[k + 1]:
        k += 1
    return float(ys[k] + (ys[k + 1] - ys[k]) * (x - xs[k]) / (xs[k + 1] - xs[k]))


@jit
def subcritical_factor(ratio: float, critical: float) -> float:
    """Return the flow relative to the choked flow at a pressure ratio (after / before)."""
    if ratio <= critical:
        return 1.0
    share = (min(ratio, _LARGEST_RATIO) - critical) / (1.0 - critical)
    return float(np.sqrt(1.0 - share * share))


@jit
def nozzle_factor(x: float, pressure: float, nozzle: FloatArray) -> float:
    """Return the factor on u by the pressure after the valve, relative to the sliding line."""
    kappa, critical = nozzle[0], nozzle[1]
    if kappa == 0.0:
        return 1.0
    usual = subcritical_factor(kappa * x / (nozzle[2] + nozzle[3] * x), critical)
    return float(subcritical_factor(kappa * x / pressure, critical) / usual)


@jit
def added(
    u: float, time_s: float, curve_u: FloatArray, curve_x: FloatArray, from_s: FloatArray
) -> float:
    """Return the sum in MW of the added curves that have begun."""
    total = 0.0
    for k in range(from_s.size):
        if time_s >= from_s[k]:
            inside = min(max(u, curve_u[k, 0]), curve_u[k, -1])
            total += interpolate(inside, curve_u[k], curve_x[k])
    return total


class Series(NamedTuple):
    """The inputs of the loop; float64 (n,) each.

    ``density`` is p^m, ``noise`` the disturbance of the power in MW, the rest
    as in `Outside` and `Forcing`.
    """

    time_s: FloatArray
    load: FloatArray
    pressure: FloatArray
    density: FloatArray
    moves: FloatArray
    noise: FloatArray
    gain: FloatArray
    input_gain: FloatArray
    offset: FloatArray


class Motion(NamedTuple):
    """The outputs of the loop; float64 (n,) each: %, %, %, % MPa^m, MW."""

    command: FloatArray
    sensor: FloatArray
    plug: FloatArray
    u: FloatArray
    power: FloatArray


class Law(NamedTuple):
    """The constants of a run.

    ``control`` is (fraction of the error corrected per step or 0, limit of u, off
    above MW, fraction forgotten per step, manual or 0), ``lags`` the table of `lag_table`,
    ``reheater`` is (fraction after it, a, b before, b now).
    """

    flow: FlowLaw
    control: FloatArray
    lags: FloatArray
    reheater: FloatArray
    before_sensor: FloatArray
    after_sensor: FloatArray


class Memory(NamedTuple):
    """The state of the loop: (correction, power before the reheater, after it), positions."""

    state: FloatArray
    before_sensor: FloatArray
    after_sensor: FloatArray


@jit
def _command(
    load: float, move: float, density: float, correction: float, flow: FlowLaw, manual: float
) -> float:
    wanted = move
    if manual == 0.0:
        u = interpolate(load, flow.curve_x, flow.curve_u) + correction
        wanted += u / density
    return min(max(wanted, 0.0), 100.0)


@jit
def _corrected(correction: float, load: float, error: float, control: FloatArray) -> float:
    if control[0] == 0.0:
        return correction
    if load < control[2]:
        return float(min(max(correction + control[0] * error, -control[1]), control[1]))
    # Prevent integrator windup at the flat end: reduce the correction.
    return float(correction * (1.0 - control[3]))


@jit
def _run(series: Series, law: Law, memory: Memory, flow: FloatArray, out: FloatArray) -> None:
    """Fill ``out`` (5, n) as `Motion`; ``flow`` begins with the flow of the past."""
    n = series.load.size
    past = flow.size - n
    control, curve, reheater = law.control, law.flow, law.reheater
    correction, direct, reheated = memory.state
    for t in range(n):
        load, density = series.load[t], series.density[t]
        command = _command(load, series.moves[t], density, correction, curve, control[4])
        sensor = move(command, memory.before_sensor, law.before_sensor)
        plug = move(sensor, memory.after_sensor, law.after_sensor)
        u = plug * density * series.input_gain[t]
        u *= nozzle_factor(
            interpolate(u, curve.curve_u, curve.curve_x), series.pressure[t], curve.nozzle
        )
        x = interpolate(u, curve.curve_u, curve.curve_x)
        x += added(u, series.time_s[t], curve.added_u, curve.added_x, curve.added_from_s)
        flow[past + t] = x * series.gain[t]
        before = direct
        direct = answer(flow, past + t, before, law.lags)
        reheated = reheater[1] * reheated + reheater[2] * before + reheater[3] * direct
        power = direct + reheater[0] * (reheated - direct) + series.offset[t]
        error = load - power - series.noise[t]
        correction = _corrected(correction, load, error, control)
        out[0, t] = command
        out[1, t] = sensor
        out[2, t] = plug
        out[3, t] = u
        out[4, t] = power
    memory.state[:] = (correction, direct, reheated)


class ClosedLoop:
    """Valve, turbine and power control, run part by part; it begins in steady state."""

    def __init__(self, hooks: Hooks, manual: bool) -> None:
        plan, h = hooks.unit.programme, hooks.unit.sample_period_s
        lags, self._depth = lag_table(hooks.regions, h)
        share = h / plan.feedback_s if plan.feedback and not manual else 0.0
        control = (
            share / plan.feedback_slope_mw, plan.feedback_limit_u, plan.feedback_off_above_mw,
            share, float(manual),
        )  # fmt: skip
        reheater = (1.0 - hooks.reheater_share, *lag_coefficients(hooks.reheater_s, h))
        self._law = Law(
            flow_law(hooks), np.array(control), lags, np.array(reheater),
            settings(hooks.before_sensor, h), settings(hooks.after_sensor, h),
        )  # fmt: skip
        self._memory: Memory | None = None
        self._past = np.empty(0)

    def advance(self, series: Series) -> Motion:
        """Run the next rows."""
        if self._memory is None:
            self._memory = self._begin(series)
        flow = np.concatenate([self._past, np.empty(series.load.size)])
        out = np.empty((len(Motion._fields), series.load.size))
        _run(series, self._law, self._memory, flow, out)
        self._past = flow[flow.size - self._depth :].copy()
        return Motion(*out)

    def _begin(self, series: Series) -> Memory:
        load = float(series.load[0])
        self._past = np.full(self._depth, load)
        opening = _command(
            load, series.moves[0], series.density[0], 0.0, self._law.flow, self._law.control[4]
        )
        resting = np.full(N_POSITIONS, opening)
        return Memory(np.array([0.0, load, load]), resting, resting.copy())
