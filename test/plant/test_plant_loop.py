# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The closed loop against plain Python without arrays; the actuator by its laws."""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from plants import UNITS, naive_lag
from step_plan import StepPlan, step_test

from valveflow_ros.plant import loop
from valveflow_ros.plant.effect import DAY_S, ActuatorLimits
from valveflow_ros.plant.plant import Disturbance, LoadProgramme
from valveflow_ros.plant.simulator import WARM_UP_S, simulate
from valveflow_ros.plant.spec import EffectSpec
from valveflow_ros.plant.unit import Region, UnitDescription, random_unit


@dataclass
class Faults:
    """What may be wrong with the naive plant; as printed, nothing is."""

    slack: float = 0.0
    stick: float = 0.0
    jump: float = 0.0
    speed: float = 1e9
    top: float = 1e9
    kappa: float = 0.0
    alpha: float = 1.0
    reheat_s: float = 0.0


def naive_curve(unit, u):
    """Evaluate eq. (2) piece by piece."""
    curve = unit.curve
    for j in range(len(curve.slopes)):
        if u < curve.knots[j + 1] or j == len(curve.slopes) - 1:
            return float(curve.slopes[j] * u + curve.intercepts[j])
    raise AssertionError


def naive_inverse(unit, x):
    """Solve F(u) = x by halving."""
    low, high = 0.0, 10_000.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if naive_curve(unit, middle) < x else (low, middle)
    return 0.5 * (low + high)


def naive_at(history, index, first):
    """Read a history between samples; before its begin it was ``first``."""

    def get(i):
        return history[i] if i >= 0 else first

    whole = math.floor(index)
    return (
        get(whole) + (index - whole) * (get(whole + 1) - get(whole))
        if index != whole
        else get(whole)
    )


def naive_psi(ratio):
    """Return the ellipse of sub-critical flow."""
    critical = 0.546
    return 1.0 if ratio < critical else math.sqrt(1 - ((ratio - critical) / (1 - critical)) ** 2)


def naive_plug(wanted, memory, h, faults):
    """Pass an opening through servo, friction, stop and slack."""
    limit = faults.speed * h
    memory[0] += min(max(wanted - memory[0], -limit), limit)
    pull = memory[0] - memory[1]
    if abs(pull) > (faults.stick + faults.jump) / 2:
        memory[1] = memory[0] - math.copysign((faults.stick - faults.jump) / 2, pull)
    stopped = min(memory[1], faults.top)
    if stopped > memory[2] + faults.slack / 2:
        memory[2] = stopped - faults.slack / 2
    elif stopped < memory[2] - faults.slack / 2:
        memory[2] = stopped + faults.slack / 2
    return memory[2]


def naive_plant(unit, days, seed, faults):
    """Run the plant of the paper row by row; columns command, plug, u, power."""
    h, plan = unit.sample_period_s, unit.programme
    skip, rows = round(WARM_UP_S / h), round(days * DAY_S / h)
    drive = LoadProgramme(unit, seed, (skip + rows) * h, -WARM_UP_S)
    outside = drive.advance(0, skip + rows)
    noise = Disturbance(unit, seed).advance(outside.load_mw)
    first = float(outside.load_mw[0])
    correction, direct, reheated = 0.0, first, first
    memory = []
    flow = []
    out = []
    for t in range(skip + rows):
        load, p = float(outside.load_mw[t]), float(outside.pressure_mpa[t])
        density = p**1.125
        command = (naive_inverse(unit, load) + correction) / density
        command = min(max(command + float(outside.moves_percent[t]), 0.0), 100.0)
        memory = memory or [command] * 3
        plug = naive_plug(command, memory, h, faults)
        u = plug * density
        if faults.kappa:
            x = naive_curve(unit, u)
            line = plan.pressure_low_mpa + plan.pressure_rise_mpa * (
                (x - plan.load_low_mw) / plan.pressure_span_mw
            )
            u = u * naive_psi(faults.kappa * x / p) / naive_psi(faults.kappa * x / line)
        flow.append(naive_curve(unit, u))
        region = next(r for r in unit.regions if flow[t] < r.power_to_mw)
        back = region.delay_s / h
        old, new = naive_at(flow, t - 1 - back, first), naive_at(flow, t - back, first)
        before, direct = direct, naive_lag(direct, old, new, region.time_constant_s, h)
        reheated = naive_lag(reheated, before, direct, faults.reheat_s, h)
        power = faults.alpha * direct + (1 - faults.alpha) * reheated
        if plan.feedback and load < plan.feedback_off_above_mw:
            error = load - (power + float(noise[t]))
            correction += h / plan.feedback_s * error / plan.feedback_slope_mw
            correction = min(max(correction, -plan.feedback_limit_u), plan.feedback_limit_u)
        elif plan.feedback:
            correction -= correction * h / plan.feedback_s
        out.append((command, plug, u, power))
    return np.array(out)[skip:]


EVERYTHING = Faults(0.6, 1.0, 0.7, 0.12, 84.0, 0.0, 0.3, 20.0)
EVERYTHING_SPECS = ('backlash', 'stiction', 'rate_limit', 'saturation', 'reheater')


@pytest.mark.parametrize('number', [None, 1, 3])
@pytest.mark.parametrize('faulty', [False, True])
def test_the_fast_loop_is_the_slow_one(number, faulty):
    rng = np.random.default_rng(number)
    unit = UnitDescription() if number is None else random_unit(rng)
    plan = unit.programme
    kappa = (
        0.65 * float(plan.sliding_pressure_mpa(np.array(plan.load_high_mw))) / plan.load_high_mw
    )
    faults = dataclasses.replace(EVERYTHING, kappa=kappa) if faulty else Faults()
    effects = [EffectSpec.parse(name) for name in EVERYTHING_SPECS] if faulty else []
    effects += [EffectSpec.of('choked', kappa=kappa)] if faulty else []
    log = simulate(0.03, seed=5, unit=unit, effects=effects)
    slow = naive_plant(unit, 0.03, 5, faults)
    np.testing.assert_allclose(log.table.values[:, 4], np.round(slow[:, 0], 2), atol=0.0101)
    np.testing.assert_allclose(log.plug_percent, slow[:, 1], rtol=1e-9)
    np.testing.assert_allclose(log.true_u, slow[:, 2], rtol=1e-9)
    np.testing.assert_allclose(log.true_power_mw, slow[:, 3], rtol=1e-9)


def test_sampling_twice_as_often_gives_the_same_plant():
    # Noise would differ from rate to rate; a manual step test has none here.
    plan = StepPlan(pressure_wander_mpa=0.0, steps=4, hold_s=600.0)
    one, two = (
        step_test(1, plan, dataclasses.replace(
            UNITS['quiet'], regions=(Region(np.inf, 30.0, 4.0),), sample_period_s=h
        )).true_power_mw
        for h in (1.0, 2.0)
    )  # fmt: skip
    # Straight between samples is exact but for the corners of the moves.
    np.testing.assert_allclose(one[::2], two, atol=0.4)
    assert np.abs(one[::2] - two).mean() < 0.02


# The operators of the actuator.

paths = st.lists(st.floats(0.0, 100.0, width=32), min_size=1, max_size=60)
widths = st.floats(0.0, 5.0, width=32)


def through(path, step_s=1.0, **limits):
    """Send a path through a bank that rests at its first value."""
    settings = loop.settings(ActuatorLimits(**limits), step_s)
    positions = np.full(loop.N_POSITIONS, path[0])
    return np.array([loop.move(v, positions, settings) for v in path])


@given(paths, widths, st.integers(2, 5))
def test_play_stays_within_half_its_width_at_any_speed(path, width, times):
    fast = through(path, slack_percent=width)
    assert np.all(np.abs(fast - path) <= width / 2 + 1e-9)
    # Straight between its points and slower by a factor: the same at the points.
    slow = np.interp(np.arange((len(path) - 1) * times + 1) / times, np.arange(len(path)), path)
    np.testing.assert_allclose(through(slow, slack_percent=width)[::times], fast, atol=1e-9)
    # Stick-slip without a jump is play.
    np.testing.assert_allclose(through(path, band_percent=width), fast, atol=1e-9)


@given(paths, widths, st.floats(0.0, 1.0))
def test_a_sticking_valve_stays_or_jumps(path, band, share):
    jump = share * band
    position = through(path, band_percent=band, jump_percent=jump)
    moves = np.abs(np.diff(position))
    assert np.all((moves == 0.0) | (moves >= jump - 1e-9))
    assert np.all(np.abs(position - path) <= (band + jump) / 2 + 1e-9)


@given(paths, st.floats(0.1, 10.0), st.sampled_from([0.5, 2.0]), st.floats(1.0, 100.0))
def test_rate_and_stop_are_kept(path, rate, step_s, top):
    position = through([*path, *[50.0] * 2_000], step_s, rate_percent_per_s=rate)
    assert np.all(np.abs(np.diff(position)) <= rate * step_s + 1e-9)
    assert position[-1] == 50.0, 'it ends where it is sent if it is given the time'
    np.testing.assert_array_equal(through(path, top_percent=top)[1:], np.minimum(path, top)[1:])
