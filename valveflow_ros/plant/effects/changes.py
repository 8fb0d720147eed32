# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Effects that are a change in time: drifts, steps, intervals and the daily cycle."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

from valveflow_ros.parameters import Parameter
from valveflow_ros.plant.effect import (  # fmt: skip
    DAY_S,
    ONSET,
    Hooks,
    Values,
    effect,
    not_above,
    ramp,
    step,
)
from valveflow_ros.records import FloatArray


@effect(
    'The power belonging to a flow rises or falls steadily.',
    Parameter('g', 0.01, '1/(10 d)', 'Relative change in ten days.', -0.2, 0.2),
)
def gain_drift(values: Values, hooks: Hooks) -> None:
    """The power per flow drifts.

    Erosion and deposits after the valve, decreasing efficiency of the cycle, and a
    drifting scale of the power transducer have the same effect on the four signals:

        x = F(u) (1 + g t / 10 d),  t from the first row on
    """
    hooks.scale_power(lambda rows: 1.0 + values['g'] * ramp(rows.time_s))


@effect(
    'The power belonging to a flow changes at one moment.',
    Parameter('g', 0.006, '', 'Relative change.', -0.2, 0.2),
    ONSET,
)
def gain_step(values: Values, hooks: Hooks) -> None:
    """The power per flow changes suddenly and permanently.

    Possible causes are maintenance, another power meter, and a heater or an
    extraction that is permanently switched on or off:

        x = F(u) (1 + g),  t >= t0
    """
    hooks.scale_power(lambda rows: 1.0 + values['g'] * step(rows.time_s, values))


@effect(
    'The pressure or position transmitter drifts: at the same reading more or less steam flows.',
    Parameter('g', 0.01, '1/(10 d)', 'Relative change in ten days.', -0.2, 0.2),
)
def input_drift(values: Values, hooks: Hooks) -> None:
    """The error of the opening or of the pressure grows, or the seat wears.

    A drifting scale of the pressure transmitter, a drifting scale of the position
    sensor and a wearing seat all change the ratio of true u to measured u:

        u_true = u (1 + g t / 10 d),  t from the first row on
    """
    hooks.scale_input(lambda rows: 1.0 + values['g'] * ramp(rows.time_s))


@effect(
    'A transmitter is recalibrated: from then on more or less steam flows at the same reading.',
    Parameter('g', 0.006, '', 'Relative change.', -0.2, 0.2),
    ONSET,
)
def input_step(values: Values, hooks: Hooks) -> None:
    """The pressure or position transmitter is recalibrated.

    After that the same measured u corresponds to another flow area:

        u_true = u (1 + g),  t >= t0
    """
    hooks.scale_input(lambda rows: 1.0 + values['g'] * step(rows.time_s, values))


@effect(
    'The power drifts by the same amount at any load.',
    Parameter('b_mw', 2.0, 'MW/(10 d)', 'Change in ten days.', -50.0, 50.0),
)
def output_offset_drift(values: Values, hooks: Hooks) -> None:
    """The zero of the power drifts.

    A drifting zero of the power transducer, or a slowly growing auxiliary load,
    adds the same power at any load:

        y = G x + b t / 10 d,  t from the first row on
    """
    hooks.add_power(lambda rows: values['b_mw'] * ramp(rows.time_s))


_HOUR_S = 3600.0


def _draw(values: Values) -> Iterator[tuple[float, float]]:
    """Yield start and end of successive intervals, in seconds."""
    rng = np.random.default_rng([int(values['pattern']), 1])
    end = 0.0
    while True:
        start = end + _HOUR_S * rng.uniform(values['off_low_h'], values['off_high_h'])
        end = start + _HOUR_S * rng.uniform(values['on_low_h'], values['on_high_h'])
        yield start, end


def intervals_s(values: Values, length_s: float) -> FloatArray:
    """Return start and end of every interval that begins in a run, (k, 2), in seconds."""
    rows = itertools.takewhile(lambda row: row[0] < length_s, _draw(values))
    return np.array(list(rows)).reshape(-1, 2)


@effect(
    'For hours at a time the power belonging to a flow is another one.',
    Parameter('g', -0.01, '', 'Relative change inside an interval.', -0.2, 0.2),
    Parameter('on_low_h', 5.0, 'h', 'Shortest interval.', 0.1, 1000.0),
    Parameter('on_high_h', 22.0, 'h', 'Longest interval.', 0.1, 1000.0),
    Parameter('off_low_h', 24.0, 'h', 'Shortest pause.', 0.1, 1000.0),
    Parameter('off_high_h', 60.0, 'h', 'Longest pause.', 0.1, 1000.0),
    Parameter('pattern', 1, '', 'Which sequence of times.', 0, 2**31 - 1),
    starts_days=lambda values: next(_draw(values))[0] / DAY_S,
    problem=not_above(('on_low_h', 'on_high_h'), ('off_low_h', 'off_high_h')),
)
def intervals(values: Values, hooks: Hooks) -> None:
    """At some times a part of the steam or of the heat is used elsewhere.

    An extraction or a feed water heater is in or out of service for hours:

        x = F(u) (1 + g w(t)),  w = 0 or 1

    w begins with 0; the duration of each state is uniform between two bounds. A
    separate random generator is used: ``pattern`` defines a fixed sequence of times.
    """
    edges = intervals_s(values, hooks.length_s).ravel()
    hooks.scale_power(
        lambda rows: 1.0 + values['g'] * (np.searchsorted(edges, rows.time_s, side='right') % 2)
    )


@effect(
    'The power belonging to a flow rises and falls once a day.',
    Parameter('a', 0.005, '', 'Relative amplitude.', -0.2, 0.2),
    Parameter('peak_h', 5.0, 'h', 'Time of day of the highest power, UTC.', 0.0, 24.0),
)
def diurnal(values: Values, hooks: Hooks) -> None:
    """The power depends on the time of day.

    The pressure in the condenser depends on the ambient air or the cooling water, and
    it changes the enthalpy drop. Auxiliary load due to the weather has the same effect.

        x = F(u) (1 + a cos(2 pi (t - t_peak) / 24 h)),  t the time of day, UTC
    """
    peak_s = values['peak_h'] * 3600.0
    hooks.scale_power(
        lambda rows: 1.0 + values['a'] * np.cos(2.0 * np.pi * (rows.clock_s - peak_s) / DAY_S)
    )
