# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Streams the engine is tested on, ways of cutting them, and a form to compare events in."""

import dataclasses
import functools
import itertools
import os

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

from valveflow_ros.monitoring.alarms import AlarmChange
from valveflow_ros.monitoring.prediction import PredictionBlock
from valveflow_ros.plant.simulator import simulate
from valveflow_ros.plant.spec import EffectSpec
from valveflow_ros.records import NS_PER_S, SampleTable, Signal
from valveflow_ros.signals.static_form import integrated_input
from valveflow_ros.state import from_bytes, to_bytes

START_NS = 1_700_006_400 * NS_PER_S
INTERPRETED = os.environ.get('NUMBA_DISABLE_JIT', '0') not in ('', '0')
needs_jit = pytest.mark.skipif(INTERPRETED, reason='too many rows for interpreted loops')


def examples(count):
    """Settings of a hypothesis test: fewer examples where loops are interpreted."""
    return settings(
        max_examples=max(3, count // 5) if INTERPRETED else count,
        deadline=None,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
    )


def cuts(rows, most=6):
    """Strategy for the places where a stream of ``rows`` is cut into blocks."""
    return st.lists(st.integers(0, rows), max_size=most).map(sorted)


def blocks_of(rows, places):
    """Return the blocks ``(start, end)`` that the places cut ``rows`` into; some are empty."""
    edges = [0, *places, rows]
    return list(itertools.pairwise(edges))


def grid_ns(n, period_s=1.0, start_ns=START_NS):
    return start_ns + np.arange(n, dtype=np.int64) * round(period_s * NS_PER_S)


def steps_and_ramps(rng, n, low=1100.0, high=1900.0, hold=(40, 120), rate=4.0):
    """Return u without noise: holds with ramps of ``rate`` a row between them."""
    u = np.empty(n)
    at, value = 0, float(rng.uniform(low, high))
    while at < n:
        stay = int(rng.integers(*hold))
        u[at : at + stay] = value
        at += stay
        target = float(rng.uniform(low, high))
        path = np.arange(value, target, rate if target > value else -rate)
        u[at : at + len(path)] = path[: max(0, n - at)]
        at += len(path)
        value = target
    return u


def lagged(x, time_constant, delay, step=1.0):
    """Filter x by a first-order lag with a delay of whole steps."""
    late = np.concatenate([np.full(round(delay / step), x[:1].sum()), x])[: len(x)]
    a = np.exp(-step / time_constant)
    y = np.empty(len(x))
    state = late[:1].sum()
    for t, value in enumerate(late):
        state = a * state + (1.0 - a) * value
        y[t] = state
    return y


def table_of(time_ns, u, power, temperature=None, pressure=16.0, exponent=1.125):
    """Return rows whose integrated input is ``u``, at a constant pressure."""
    n = len(time_ns)
    return SampleTable.from_columns(
        time_ns,
        {
            Signal.VALVE_OPENING: np.asarray(u) / pressure**exponent,
            Signal.MAIN_STEAM_PRESSURE: np.full(n, pressure),
            Signal.MAIN_STEAM_TEMPERATURE: (
                np.full(n, 540.0) if temperature is None else temperature
            ),
            Signal.GENERATED_POWER: power,
        },
    )


def frozen(thing):
    """Turn a value into something that is equal exactly when every bit is."""
    if isinstance(thing, np.ndarray):
        return thing.dtype.str, thing.shape, np.ascontiguousarray(thing).tobytes()
    if isinstance(thing, float):
        return float(thing).hex()
    if dataclasses.is_dataclass(thing) and not isinstance(thing, type):
        fields = [(f.name, frozen(getattr(thing, f.name))) for f in dataclasses.fields(thing)]
        return type(thing).__name__, tuple(fields)
    if isinstance(thing, dict):
        return tuple((k, frozen(v)) for k, v in thing.items())
    if isinstance(thing, list | tuple):
        return tuple(frozen(v) for v in thing)
    if hasattr(thing, 'real') and hasattr(thing, 'text'):  # Settings
        return tuple((k, frozen(v)) for k, v in thing.items())
    return thing


def of_type(events, kind):
    return [e for e in events if isinstance(e, kind)]


@dataclasses.dataclass
class Story:
    """Events in a form that does not show how the stream was cut.

    ``columns`` has one entry a row; ``others`` has every other event with the
    number of rows predicted before it (an alarm's change has a time of its own).
    """

    columns: dict
    others: list


def story(events):
    """Join the predictions of all blocks; keep everything else in its order."""
    columns = {field.name: [] for field in dataclasses.fields(PredictionBlock)}
    others = []
    rows = 0
    for event in events:
        if isinstance(event, PredictionBlock):
            rows += len(event)
            for name, column in columns.items():
                value = getattr(event, name)
                many = isinstance(value, np.ndarray)
                column += map(frozen, value.tolist() if many else [value] * len(event))
        else:
            others.append((None if isinstance(event, AlarmChange) else rows, frozen(event)))
    return Story(columns, others)


def first_difference(a, b):
    """Say where two stories part, for a failing test."""
    for name, column in a.columns.items():
        for k, (x, y) in enumerate(zip(column, b.columns[name], strict=False)):
            if x != y:
                return f'{name} row {k}: {x} != {y}'
        if len(column) != len(b.columns[name]):
            return f'{name}: {len(column)} rows != {len(b.columns[name])}'
    for k, (x, y) in enumerate(zip(a.others, b.others, strict=False)):
        if x != y:
            return f'event {k}: {str(x)[:300]} != {str(y)[:300]}'
    if len(a.others) != len(b.others):
        return f'{len(a.others)} events != {len(b.others)}'
    return ''


def column(events, name):
    return np.concatenate([getattr(b, name) for b in of_type(events, PredictionBlock)])


def taken_up(made, fresh):
    """Return a fresh object that goes on where ``made`` is, by way of bytes."""
    fresh.restore(from_bytes(to_bytes(made.snapshot())))
    return fresh


# A monitor that lives in seconds instead of hours: a few hundred rows hold many fits.
QUICK_MONITOR = {
    'block': 1.0,
    'time_constant': 2.0,
    'delay': 1.0,
    'steady_min': 6.0,
    'slope_min': 6.0,
    'longest_segment': 60.0,
    'input_noise': 1.0,
    'power_noise': 0.3,
    'refine': False,
    'selection_rule': 'paper',
    'min_fit_samples': 20,
    'refit_segments': 3,
    'refit_period': 150.0,
    'window_days': 0.02,
    'max_pieces': 3,
    'min_piece_share': 0.05,
    'alarm_average': 10.0,
    'alarm_on_delay': 5.0,
    'alarm_off_delay': 8.0,
    'alarm_limit': 3.0,
    'alarm_run_length': 1.0,
}


def plant_table(seed, n, harms=(), start_ns=START_NS, fault_mw=8.0):
    """Return rows of a small plant with a fault of the power now and then, and bad rows.

    ``harms`` are (what, row, rows): ``nan_u``, ``nan_power``, ``nan_temperature``,
    ``no_pressure``, ``inf``, ``fault`` or ``leap`` (seconds without rows).
    """
    rng = np.random.default_rng(seed)
    u = steps_and_ramps(rng, n, hold=(30, 90))
    power = lagged(20.0 + 0.1 * u, 2.0, 1.0) + 0.15 * rng.normal(0.0, 1.0, n)
    time_ns = grid_ns(n, start_ns=start_ns)
    table = table_of(time_ns, u + 0.5 * rng.normal(0.0, 1.0, n), power,
                     540.0 + 0.2 * rng.normal(0.0, 1.0, n))  # fmt: skip
    values = table.values
    for what, at, length in harms:
        rows = slice(at, at + length)
        if what == 'fault':
            values[rows, Signal.GENERATED_POWER] += fault_mw
        elif what == 'leap':
            time_ns[at:] += length * NS_PER_S
        elif what == 'inf':
            values[rows, Signal.VALVE_OPENING] = np.inf
        elif what == 'no_pressure':
            values[rows, Signal.MAIN_STEAM_PRESSURE] = 0.0
        else:
            signal = {'nan_u': Signal.VALVE_OPENING, 'nan_power': Signal.GENERATED_POWER,
                      'nan_temperature': Signal.MAIN_STEAM_TEMPERATURE}[what]  # fmt: skip
            values[rows, signal] = np.nan
    return SampleTable(time_ns, values, np.where(np.isnan(values), 2, 0).astype(np.uint8))


def after(monitor, seed, n, harms=(), added_mw=0.0):
    """Return rows of that plant that follow on the monitor's last one."""
    table = plant_table(seed, n, harms, start_ns=monitor.last_ns + NS_PER_S)
    table.values[:, Signal.GENERATED_POWER] += added_mw
    return table


def table_harms(n, most=5):
    """Strategy for what befalls a `plant_table` of n rows."""
    kinds = ['nan_u', 'nan_power', 'nan_temperature', 'no_pressure', 'inf', 'fault', 'fault',
             'leap']  # fmt: skip
    return st.lists(
        st.tuples(st.sampled_from(kinds), st.integers(0, n - 1), st.integers(1, 60)), max_size=most
    )


def simulated(days, seed, effects=()):
    """Return a run of the simulated plant and its measured u; shared, so not to be written."""
    log = _simulated(days, seed, tuple(effects))
    u = integrated_input(
        log.table.column(Signal.VALVE_OPENING), log.table.column(Signal.MAIN_STEAM_PRESSURE)
    )
    return log, u


@functools.lru_cache(maxsize=3)
def _simulated(days, seed, effects):
    return simulate(days, seed, effects=[EffectSpec.parse(e) for e in effects])


def flow_valve(kpa, top, warm):
    """A valve of which the flow is F(V dp^0.5), as a table; knots in u and values of F."""
    rng = np.random.default_rng(1)
    n = 30_000
    changes = np.sort(rng.choice(n, 60, replace=False))
    opening = np.interp(
        np.arange(n), [0, *np.repeat(changes, 2) + np.tile([0, 250], 60), n + 500],
        np.repeat(rng.uniform(15.0, 85.0, 61), 2),
    )  # fmt: skip
    difference = kpa * 2.0 ** np.sin(np.arange(n) / 1100.0)
    u = opening * np.sqrt(difference / 1e3)
    most = 85.0 * np.sqrt(kpa / 500.0)
    knots, values = most * np.array([0.0, 0.35, 0.6, 1.1]), top * np.array([0.0, 0.2, 0.62, 1.0])
    static, lag = np.interp(u, knots, values), np.exp(-1.0 / 12.0)
    answer = np.empty(n)
    answer[0] = static[0]
    for k in range(1, n):
        answer[k] = lag * answer[k - 1] + (1.0 - lag) * static[k - 1]
    columns = {
        'time': 1.7e9 + np.arange(n), 'LV': opening + 0.02 * rng.standard_normal(n),
        'DP': difference, 'FT': answer + 0.002 * top * rng.standard_normal(n),
        'TE': warm + 0.1 * rng.standard_normal(n),
    }  # fmt: skip
    return columns, knots, values
