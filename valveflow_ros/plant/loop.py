"""The closed loop of valve, turbine and power control, one step after the other."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from valveflow_ros.jit import jit
from valveflow_ros.plant import actuator
from valveflow_ros.plant.flow import FlowLaw, added, flow_law, interpolate, nozzle_factor
from valveflow_ros.plant.hooks import Hooks
from valveflow_ros.plant.lag import answer, lag_coefficients, lag_table
from valveflow_ros.records import FloatArray


class Series(NamedTuple):
    """What drives the loop; float64 (n,) each.

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
    """What the loop did; float64 (n,) each: %, %, %, % MPa^m, MW."""

    command: FloatArray
    sensor: FloatArray
    plug: FloatArray
    u: FloatArray
    power: FloatArray


class Law(NamedTuple):
    """What stays the same during a run.

    ``control`` is (share of the error corrected per step or 0, limit of u, off
    above MW, share let go per step, manual or 0), ``lags`` the table of `lag_table`,
    ``reheater`` is (share after it, a, b before, b now).
    """

    flow: FlowLaw
    control: FloatArray
    lags: FloatArray
    reheater: FloatArray
    before_sensor: FloatArray
    after_sensor: FloatArray


class Memory(NamedTuple):
    """What the loop remembers: (correction, power before the reheater, behind it), positions."""

    state: FloatArray
    before_sensor: FloatArray
    after_sensor: FloatArray


@jit
def _command(
    load: float, move: float, density: float, correction: float, flow: FlowLaw, manual: float
) -> float:
    """Return the opening the controller asks for, in %."""
    wanted = move
    if manual == 0.0:
        u = interpolate(load, flow.curve_x, flow.curve_u) + correction
        wanted += u / density
    return min(max(wanted, 0.0), 100.0)


@jit
def _corrected(correction: float, load: float, error: float, control: FloatArray) -> float:
    """Let the power control integrate its error in MW into a correction of u."""
    if control[0] == 0.0:
        return correction
    if load < control[2]:
        return float(min(max(correction + control[0] * error, -control[1]), control[1]))
    # On the flat end an integrator would wind up: it is let go.
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
        sensor = actuator.move(command, memory.before_sensor, law.before_sensor)
        plug = actuator.move(sensor, memory.after_sensor, law.after_sensor)
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
    """Valve, turbine and power control, run part by part; begins in equilibrium."""

    def __init__(self, hooks: Hooks, manual: bool) -> None:
        lags, self._depth = lag_table(hooks.regions, hooks.unit.sample_period_s)
        self._law = _law(hooks, lags, manual)
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
        """Return the state of a plant that has stood at the first load for ever."""
        load = float(series.load[0])
        self._past = np.full(self._depth, load)
        opening = _command(
            load, series.moves[0], series.density[0], 0.0, self._law.flow, self._law.control[4]
        )
        resting = np.full(actuator.N_POSITIONS, opening)
        return Memory(np.array([0.0, load, load]), resting, resting.copy())


def _law(hooks: Hooks, lags: FloatArray, manual: bool) -> Law:
    """Collect what stays the same during a run."""
    plan, h = hooks.unit.programme, hooks.unit.sample_period_s
    share = h / plan.feedback_s if plan.feedback and not manual else 0.0
    control = (
        share / plan.feedback_slope_mw,
        plan.feedback_limit_u,
        plan.feedback_off_above_mw,
        share,
        float(manual),
    )
    reheater = (1.0 - hooks.reheater_share, *lag_coefficients(hooks.reheater_s, h))
    return Law(
        flow_law(hooks),
        np.array(control),
        lags,
        np.array(reheater),
        actuator.settings(hooks.before_sensor, h),
        actuator.settings(hooks.after_sensor, h),
    )
