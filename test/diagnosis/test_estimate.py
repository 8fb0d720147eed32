# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Times as dates: no finer than known, never narrower than the interval, the same everywhere."""

from __future__ import annotations

import math
from datetime import datetime, timezone

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from valveflow_ros.curve.regional_model import RegionalModel
from valveflow_ros.diagnosis.cause import DAY_S, Estimate, FittedCause, dates
from valveflow_ros.diagnosis.causes import catalogue
from valveflow_ros.diagnosis.evidence import Gain
from valveflow_ros.diagnosis.extended import Extended
from valveflow_ros.diagnosis.result import NamedCause, cause_json
from valveflow_ros.records import NS_PER_S
from valveflow_ros.report.diagnosis import cells, times_in_effect
from valveflow_ros.signals.static_form import OPENING, StaticForm

# 2025-03-01 00:00 UTC
ORIGIN_NS = 1_740_787_200 * NS_PER_S
STEPS = {'gain_step': (0.01, 3.5), 'input_step': (-0.01, 3.5),
         'curve_step': (-4.0, 1500.0, 1700.0, 3.5)}  # fmt: skip


def onset(low: float, high: float, value: float = 3.5) -> Estimate:
    return Estimate(value, low, high, 'd', ORIGIN_NS)


def days(said: str) -> float:
    """Read a date back, as days since the origin."""
    form = '%Y-%m-%d %H:%M UTC' if 'UTC' in said else '%Y-%m-%d'
    at = datetime.strptime(said, form).replace(tzinfo=timezone.utc)
    return (at.timestamp() - ORIGIN_NS / NS_PER_S) / DAY_S


@given(st.floats(0.0, 400.0), st.floats(0.0, 30.0), st.floats(0.0, 30.0))
def test_the_dates_hold_what_the_interval_holds_and_little_more(value, before, after):
    low, high = max(0.0, value - before), value + after
    at, between = dates(onset(low, high, value))
    first, last = (days(end) for end in between.split(' to '))
    slack = 1e-6 / DAY_S
    assert first <= low + slack
    assert high - slack <= last
    minute = 60.0 / DAY_S
    step = max(minute, (high - low) / 5)
    assert low - first < step + slack
    assert last - high <= step + slack
    assert abs(days(at) - value) <= 0.5 * step + slack


@pytest.mark.parametrize(
    ('half', 'said'),
    [
        (0.01, ('2025-03-04 12:00 UTC', '2025-03-04 11:45 UTC to 2025-03-04 12:15 UTC')),
        (0.09, ('2025-03-04 12:00 UTC', '2025-03-04 09:50 UTC to 2025-03-04 14:10 UTC')),
        (0.3, ('2025-03-04 12:00 UTC', '2025-03-04 04:00 UTC to 2025-03-04 20:00 UTC')),
        (2.7, ('2025-03-05', '2025-03-01 to 2025-03-08')),
        (math.nan, ('2025-03-04 12:00 UTC', '')),
    ],
)
def test_long_intervals_are_told_coarsely(half, said):
    assert dates(onset(3.5 - half, 3.5 + half)) == said


def test_what_is_no_time_has_no_date():
    with pytest.raises(ValueError, match='no time'):
        dates(Estimate(1.0, 0.5, 1.5, '%'))
    assert cells(Estimate(1.0, 0.5, 1.5, '%'), 1.125) == ('1.000 %', '0.5 to 1.5')


@pytest.mark.parametrize('name', STEPS)
def test_a_sentence_says_when_by_the_calendar(name):
    active = FittedCause(catalogue()[name], STEPS[name])
    known = {n: Estimate(v, v - 0.01, v + 0.01, '') for n, v in active.named().items()}
    known['t0_days'] = onset(3.4, 3.7)
    told = active.sentence(ORIGIN_NS, known)
    at, between = dates(known['t0_days'])
    assert told.startswith(f'From {at} on (95 % interval {between}) the ')
    assert 'days after' not in told
    assert active.sentence(ORIGIN_NS).startswith('From 2025-03-04 12:00 UTC on the ')
    later = active.sentence(ORIGIN_NS + round(DAY_S) * NS_PER_S)
    assert later == active.sentence(ORIGIN_NS).replace('03-04', '03-05')


def test_numbers_stay_numbers_and_say_what_they_count_from():
    cause = NamedCause('gain_step', 'It.', {'t0_days': onset(3.4, 3.7)}, Gain(1.0, 0.5, 0.01))
    (content,) = cause_json(cause)['parameters'].values()
    assert content == {
        'value': 3.5, 'low': 3.4, 'high': 3.7,
        'unit': 'days since 2025-03-01 00:00:00 UTC', 'origin_ns': ORIGIN_NS,
    }  # fmt: skip
    assert cells(onset(3.4, 3.7), 1.125) == dates(onset(3.4, 3.7))
    assert cells(onset(math.nan, math.nan), 1.125) == ('2025-03-04 12:00 UTC', 'unknown')


def test_what_is_switched_in_and_out_has_times_of_its_own():
    end_ns = ORIGIN_NS + round(2 * DAY_S) * NS_PER_S
    said = times_in_effect((3600.0, 7200.0, DAY_S), ORIGIN_NS, end_ns)
    assert said.split('; ') == [
        '2025-03-01 01:00 UTC to 2025-03-01 02:00 UTC',
        '2025-03-02 00:00 UTC to 2025-03-03 00:00 UTC',
    ]
    many = times_in_effect([600.0 * k for k in range(50)], ORIGIN_NS, end_ns)
    assert many.count(' to ') == 20
    assert many.endswith('; and 5 times more')


def test_a_place_on_the_curve_is_told_in_mw_or_as_an_opening():
    knots = np.array([1000.0, 2000.0])
    base = RegionalModel(
        knots, np.array([100.0]), np.array([300.0]), np.empty(0), np.array([10.0]), np.zeros(1)
    )
    step = FittedCause(catalogue()['curve_step'], STEPS['curve_step'])
    model = Extended(base, (step,))
    by_power = step.sentence(ORIGIN_NS, place=model.place_words(StaticForm()))
    assert (
        'gives 4 MW less above 240 MW than before, and nothing has changed below 200 MW'
        in by_power
    )
    assert model.place_words(StaticForm())(9e9) == '300 MW'  # beyond the curve
    by_opening = model.place_words(StaticForm(OPENING, 1.0))
    assert 'above 62.5 % opening than' in FittedCause(
        step.cause, (-4.0, 50.0, 62.5, 3.5)
    ).sentence(ORIGIN_NS, place=by_opening)  # fmt: skip
