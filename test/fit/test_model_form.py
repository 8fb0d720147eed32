"""A valve whose knees stand at fixed openings is told from the paper's, and nothing else is.

The units here are drawn in tables of flow: no hinge, no exponent grid and no engine makes them.
"""

from __future__ import annotations

import numpy as np
import pytest

from valveflow_ros.fit.model_form import find_wrong_form

HOURS, PER_HOUR = 60, 60
PERIOD_S = 60.0
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
    low, high = (8.0, 17.0) if slides else (15.9, 16.1)
    pressure = np.interp(hour, np.arange(HOURS + 1), draw.uniform(low, high, HOURS + 1))
    v, flow = TABLES[table]
    if form == 'opening':
        power = pressure**exponent * np.interp(opening, v, flow) - 9.0
    else:
        u = opening * pressure**exponent
        power = 15.0 * np.interp(u / u.max() * 100.0, v, flow)
    power += draw.normal(0.0, 0.5, len(power))
    spans = np.column_stack([np.arange(HOURS), np.arange(1, HOURS + 1)]) * PER_HOUR
    return opening, pressure, power, spans.astype(np.int64)


@pytest.mark.parametrize('table', TABLES)
@pytest.mark.parametrize('exponent', [1.0, 1.1])
@pytest.mark.parametrize('seed', range(4))
def test_knees_at_fixed_openings_are_found_at_sliding_pressure(table, exponent, seed) -> None:
    v, p, y, spans = unit('opening', table, seed, exponent=exponent)
    found = find_wrong_form(v, p, y, spans, PERIOD_S)
    assert found is not None
    assert found.rmse_other_mw < 1.0, 'the noise is 0.5 MW, and bends lie between the knots'
    # Between the two lies what the paper's form gets wrong, and the noise of both.
    assert found.apart_mw == pytest.approx(found.rmse_mw, rel=0.5)
    assert f'{found.worst[0]:.0f} % and {found.worst[1]:.1f} MPa' in found.sentence


@pytest.mark.parametrize('table', TABLES)
@pytest.mark.parametrize('exponent', [1.0, 1.125, 1.25])
@pytest.mark.parametrize('seed', range(4))
def test_it_is_silent_about_the_paper_s_form(table, exponent, seed) -> None:
    v, p, y, spans = unit('integrated_input', table, seed, exponent=exponent)
    assert find_wrong_form(v, p, y, spans, PERIOD_S) is None


@pytest.mark.parametrize('form', ['opening', 'integrated_input'])
@pytest.mark.parametrize('seed', range(4))
def test_it_is_silent_where_the_pressure_stands_still(form, seed) -> None:
    v, p, y, spans = unit(form, 'bent', seed, slides=False)
    assert find_wrong_form(v, p, y, spans, PERIOD_S) is None


def test_units_of_power_and_missing_values_change_nothing() -> None:
    v, p, y, spans = unit('opening', 'bent', 5)
    found = find_wrong_form(v, p, y, spans, PERIOD_S)
    scaled = find_wrong_form(v, p, 3.0 * y, spans, PERIOD_S)
    assert found is not None
    assert scaled is not None
    assert scaled.rmse_mw == pytest.approx(3.0 * found.rmse_mw)
    y[::17] = np.nan
    holed = find_wrong_form(v, p, y, spans, PERIOD_S)
    assert holed is not None
    assert np.isfinite(holed.apart_mw)
    few = spans[:3]
    assert find_wrong_form(v, p, y, few, PERIOD_S) is None
    assert find_wrong_form(v, p, y, spans[:0], PERIOD_S) is None
