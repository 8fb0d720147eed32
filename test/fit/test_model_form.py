# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The form of the static power is found where the pressure tells it, and left open where not.

The units here are drawn in tables of flow: no hinge, no exponent grid and no engine makes them.
"""

import numpy as np
import pytest

from valveflow_ros.errors import TooFewSamplesError
from valveflow_ros.fit.model_form import find_form, find_misfit
from valveflow_ros.signals.static_form import INTEGRATED_INPUT, OPENING, StaticForm

HOURS, PER_HOUR = 60, 60
PERIOD_S = 60.0
PAPER = 1.125
# Flow over opening: three slopes, and a smooth one.
TABLES = {
    'bent': ([0.0, 35.0, 60.0, 100.0], [0.0, 12.0, 18.0, 20.0]),
    'smooth': (np.linspace(0.0, 100.0, 200), 20.0 * np.sqrt(np.linspace(0.0, 1.0, 200))),
}


def unit(form: str, table: str, seed: int, slides: bool = True, exponent: float = 1.0):
    """Return opening, pressure, power and spans of a unit that visits its range."""
    draw = np.random.default_rng(seed)
    hour = np.arange(HOURS * PER_HOUR) / PER_HOUR
    opening = np.interp(hour, np.arange(HOURS + 1), draw.uniform(30.0, 90.0, HOURS + 1))
    low, high = (8.0, 17.0) if slides else (15.99, 16.01)
    pressure = np.interp(hour, np.arange(HOURS + 1), draw.uniform(low, high, HOURS + 1))
    v, flow = TABLES[table]
    if form == OPENING:
        power = pressure**exponent * np.interp(opening, v, flow) - 9.0
    else:
        u = opening * pressure**exponent
        power = 15.0 * np.interp(u / u.max() * 100.0, v, flow)
    power += draw.normal(0.0, 0.5, len(power))
    spans = np.column_stack([np.arange(HOURS), np.arange(1, HOURS + 1)]) * PER_HOUR
    return opening, pressure, power, spans.astype(np.int64)


def late(power, time_constant_s):
    """Return the power behind a lag, which on a ramp is late by its time constant."""
    out, state = np.empty(len(power)), power[0]
    keep = np.exp(-PERIOD_S / time_constant_s)
    for t, y in enumerate(power):
        state = keep * state + (1.0 - keep) * y
        out[t] = state
    return out


@pytest.mark.parametrize('table', TABLES)
@pytest.mark.parametrize(('exponent', 'seed'), [(1.0, 0), (1.1, 1)])
def test_knees_at_fixed_openings_are_found_at_sliding_pressure(table, exponent, seed) -> None:
    v, p, y, spans = unit(OPENING, table, seed, exponent=exponent)
    found = find_form(v, p, y, spans, PERIOD_S, PAPER)
    assert found.evidence.told
    assert found.evidence.chosen == found.form.axis == OPENING
    assert found.form.exponent == pytest.approx(exponent, abs=0.02)
    assert found.offset_mw == pytest.approx(-9.0, abs=3.0)
    assert found.evidence.rmse_mw < 1.0, 'the noise is 0.5 MW, and bends lie between the knots'
    assert found.evidence.rmse_other_mw > 2.0 * found.evidence.rmse_mw


@pytest.mark.parametrize('table', TABLES)
@pytest.mark.parametrize(('exponent', 'seed'), [(1.0, 0), (1.125, 1), (1.25, 2)])
def test_the_paper_s_form_is_found_with_its_exponent(table, exponent, seed) -> None:
    v, p, y, spans = unit(INTEGRATED_INPUT, table, seed, exponent=exponent)
    found = find_form(v, p, y, spans, PERIOD_S, PAPER)
    assert found.evidence.told
    assert found.form.axis == INTEGRATED_INPUT
    if exponent == PAPER:
        assert found.form.exponent == PAPER, 'the data give no reason to leave it'
    assert found.form.exponent == pytest.approx(exponent, abs=0.02)
    assert found.offset_mw == 0.0


@pytest.mark.parametrize('form', [OPENING, INTEGRATED_INPUT])
@pytest.mark.parametrize('seed', range(2))
def test_where_the_pressure_stands_still_nothing_is_told(form, seed) -> None:
    v, p, y, spans = unit(form, 'bent', seed, slides=False)
    found = find_form(v, p, y, spans, PERIOD_S, PAPER)
    assert not found.evidence.told
    assert found.exponent_held
    assert found.form.exponent in (1.0, PAPER)
    assert found.evidence.apart_mw < 0.5, 'they are one curve there'


@pytest.mark.parametrize('form', [OPENING, INTEGRATED_INPUT])
def test_a_power_that_is_late_on_ramps_has_the_same_form(form) -> None:
    v, p, y, spans = unit(form, 'bent', 3, exponent=1.1)
    here, there = (find_form(v, p, x, spans, PERIOD_S, PAPER) for x in (y, late(y, 90.0)))
    assert there.form.axis == here.form.axis == form
    assert there.evidence.told
    assert there.form.exponent == pytest.approx(1.1, abs=0.03)


def test_a_form_that_is_given_is_kept_and_contradicted_where_it_is_wrong() -> None:
    v, p, y, spans = unit(OPENING, 'bent', 1)
    wrong = find_form(v, p, y, spans, PERIOD_S, PAPER, held=StaticForm())
    assert wrong.form == StaticForm()
    assert wrong.evidence.contradicted
    assert not wrong.evidence.told
    right = find_form(v, p, y, spans, PERIOD_S, PAPER, held=StaticForm(OPENING, 1.0))
    assert right.form == StaticForm(OPENING, 1.0)
    assert not right.evidence.contradicted
    asked = find_form(v, p, y, spans, PERIOD_S, PAPER, axis=INTEGRATED_INPUT)
    assert asked.form == StaticForm()


@pytest.mark.parametrize('form', [OPENING, INTEGRATED_INPUT])
@pytest.mark.parametrize('factor', [0.1, 30.0])
def test_the_unit_of_pressure_changes_no_exponent_and_scales_the_rest(form, factor) -> None:
    v, p, y, spans = unit(form, 'smooth', 2, exponent=1.07)
    one, other = (find_form(v, f * p, y, spans, PERIOD_S, PAPER) for f in (1.0, factor))
    assert other.form == one.form
    assert other.offset_mw == pytest.approx(one.offset_mw, abs=0.02)
    assert other.evidence.rmse_mw == pytest.approx(one.evidence.rmse_mw)


def test_the_unit_of_power_missing_values_and_the_order_of_segments_change_nothing() -> None:
    v, p, y, spans = unit(OPENING, 'bent', 5)
    found = find_form(v, p, y, spans, PERIOD_S, PAPER)
    scaled = find_form(v, p, 3.0 * y, spans, PERIOD_S, PAPER)
    assert scaled.form.exponent == pytest.approx(found.form.exponent, abs=4e-3)
    assert scaled.evidence.rmse_mw == pytest.approx(3.0 * found.evidence.rmse_mw, rel=0.02)
    assert scaled.offset_mw == pytest.approx(3.0 * found.offset_mw, abs=0.5)
    y[::17] = np.nan
    holed = find_form(v, p, y, spans, PERIOD_S, PAPER)
    assert holed.form.exponent == pytest.approx(found.form.exponent, abs=0.02)


@pytest.mark.parametrize('seed', range(3))
def test_two_hours_that_visit_the_range_tell_the_form(seed) -> None:
    """A day of a healthy unit may have no more: without the form its curve was 20 MW off."""
    for form in (OPENING, INTEGRATED_INPUT):
        v, p, y, spans = unit(form, 'bent', seed)
        few = np.column_stack([spans[:12, 0], spans[:12, 0] + PER_HOUR // 6])
        found = find_form(v, p, y, few, PERIOD_S, PAPER)
        assert found.form.axis == form or not found.evidence.told


def test_too_few_means_tell_no_form_and_cannot_be_put_into_one() -> None:
    v, p, y, spans = unit(OPENING, 'bent', 5)
    half_an_hour = spans[:1] // [1, 2]
    for few in (half_an_hour, spans[:0]):
        assert find_form(v, p, y, few, PERIOD_S, PAPER) is None
        with pytest.raises(TooFewSamplesError, match='numbers of'):
            find_form(v, p, y, few, PERIOD_S, PAPER, axis=OPENING)
        with pytest.raises(TooFewSamplesError, match='numbers of'):
            find_form(v, p, y, few, PERIOD_S, PAPER, held=StaticForm(OPENING, 1.0))
        given = find_form(v, p, y, few, PERIOD_S, PAPER, held=StaticForm(exponent=1.0))
        assert (given.form, given.evidence) == (StaticForm(exponent=1.0), None)


def test_what_is_known_of_the_form_stays_until_data_tell_of_another() -> None:
    known = StaticForm(OPENING, 1.07)
    v, p, y, spans = unit(OPENING, 'bent', 2, slides=False)
    calm = find_form(v, p, y, spans, PERIOD_S, PAPER, known=known)
    assert calm.form == known, 'a calm day tells nothing of it'
    v, p, y, spans = unit(OPENING, 'bent', 2, exponent=1.0)
    moved = find_form(v, p, y, spans, PERIOD_S, PAPER, known=known)
    assert moved.form.exponent == pytest.approx(1.0, abs=0.02)
    v, p, y, spans = unit(INTEGRATED_INPUT, 'bent', 2)
    other = find_form(v, p, y, spans, PERIOD_S, PAPER, known=known)
    assert other.form.axis == INTEGRATED_INPUT


@pytest.mark.parametrize('seed', range(2))
def test_what_a_curve_gets_wrong_is_told_with_its_place(seed) -> None:
    v, p, y, spans = unit(OPENING, 'bent', seed)
    right = p * np.interp(v, *TABLES['bent']) - 9.0
    assert find_misfit(v, p, y - right, y, spans, PERIOD_S) is None
    wrong = right + np.where((v > 60.0) & (p > 14.0), 12.0, 0.0)
    found = find_misfit(v, p, y - wrong, y, spans, PERIOD_S)
    opening, pressure, most = found.worst
    assert opening > 60.0
    assert pressure > 14.0
    assert most == pytest.approx(-12.0, abs=3.0)
    # Small in the mean of all rows, large at one place.
    low, high = np.quantile(v, (0.68, 0.82))
    here = right + np.where((v > low) & (v < high) & (p > np.median(p)), 10.0, 0.0)
    found = find_misfit(v, p, y - here, y, spans, PERIOD_S)
    assert low < found.worst[0] < high
    # What comes once and never again is no fault of the curve.
    once = np.where(np.arange(len(y)) < 400, 15.0, 0.0)
    assert find_misfit(v, p, y - right + once, y, spans, PERIOD_S) is None
