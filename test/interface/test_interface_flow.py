# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A flow in place of the power, a pressure difference in place of the pressure, any fluid."""

import re

import numpy as np
import pytest
from streams import flow_valve

import valveflow_ros as vf
from valveflow_ros.errors import InputError, UsageError, ValveflowError

POWER = 'generated_power_mw'
IN_MW = re.compile(r'\bMW\b|\b[Pp]ower\b')


def curve_of(log, **how):
    return vf.identify(log, **how).characteristic


@pytest.fixture(scope='module')
def frame(log):
    return log.to_dataframe()


@pytest.fixture(scope='module')
def usual(log):
    return curve_of(log)


def flow(frame, factor, unit='t/h'):
    scaled = frame.assign(**{POWER: factor * frame[POWER]})
    return vf.open_log(scaled, columns={'generated_power': f'{POWER}:{unit}'})


@pytest.fixture(scope='module')
def in_tons(frame):
    return vf.identify(flow(frame, 3.0))


@pytest.fixture(scope='module')
def small(frame):
    return curve_of(flow(frame, 0.01, 'kg/s'))


def test_two_units_of_one_output_give_one_curve(frame, small):
    large = curve_of(flow(frame, 1e4, 'lb/h'))
    assert large.breakpoints == pytest.approx(small.breakpoints, rel=1e-9)
    assert large.values() == pytest.approx(1e6 * small.values(), rel=1e-9)
    assert large.residuals.rmse_mw == pytest.approx(1e6 * small.residuals.rmse_mw, rel=1e-9)


@pytest.mark.parametrize(('factor', 'unit'), [
    (0.01, 'kg/s'), pytest.param(3.0, 't/h', marks=pytest.mark.long),
])  # fmt: skip
def test_a_scaled_output_gives_the_scaled_curve(frame, usual, small, factor, unit):
    found = small if factor == 0.01 else curve_of(flow(frame, factor, unit))
    assert found.output_unit == unit
    # The steps of the searches in MW are not scaled exactly (`output_size`), so breakpoints agree
    # within a part of their own error, and the curves closer than that.
    moved = np.abs(found.breakpoints - usual.breakpoints)[1:-1]
    assert np.all(moved < 0.25 * np.diff(usual.breakpoint_intervals)[:, 0])
    at = np.linspace(*usual.breakpoints[[0, -1]], 200)
    scaled = np.interp(at, found.breakpoints, found.values() / factor)
    assert scaled == pytest.approx(np.interp(at, usual.breakpoints, usual.values()), rel=2e-3)
    assert found.residuals.rmse_mw / factor == pytest.approx(usual.residuals.rmse_mw, rel=2e-3)
    assert found.residuals.width_mw / factor == pytest.approx(usual.residuals.width_mw, rel=1e-2)
    for mine, theirs in zip(found.dynamics, usual.dynamics, strict=True):
        assert mine.time_constant_s == pytest.approx(
            theirs.time_constant_s, abs=0.5 * theirs.time_constant_stderr_s
        )
        assert mine.delay_s == pytest.approx(theirs.delay_s, abs=0.5 * theirs.delay_stderr_s)


def test_everything_that_is_told_of_a_flow_is_in_its_unit(in_tons, tmp_path):
    found = in_tons
    found.write(tmp_path, tables=True)
    names = [f'tables/{f.name}.csv' for f in found.page().figures]
    for name in ('characteristic.json', *names):
        assert not IN_MW.search((tmp_path / name).read_text()), name
    page = (tmp_path / 'report.html').read_text()
    page = page[page.index('<main>') : page.index('<script id="library"')]
    assert not IN_MW.search(page)
    assert 'flow (t/h)' in page
    assert found.plot().layout.yaxis.title.text == 'flow (t/h)'
    assert found.to_json()['output_unit'] == 't/h'


def test_the_unit_stays_with_the_curve_and_another_one_is_refused(
    frame, log, usual, in_tons, tmp_path
):
    in_tons.write(tmp_path)
    read = vf.load_characteristic(tmp_path)
    assert (read.output_unit, read.model_id) == ('t/h', in_tons.characteristic.model_id)
    assert vf.validate(flow(frame, 3.0), tmp_path).output_unit == 't/h'
    for wrong, curve in ((log, read), (flow(frame, 3.0), usual), (flow(frame, 3.0, 'kg/s'), read)):
        for call in (
            lambda one, c: vf.validate(one, c),
            lambda one, c: vf.identify(one, reference=c),
            lambda one, c: vf.diagnose(one, model=c),
        ):
            with pytest.raises(UsageError, match='name its unit with --column'):
                call(wrong, curve)


def test_a_curve_at_one_pressure_is_told_over_the_opening(frame):
    """A control valve with opening and flow only; the file keeps u."""
    pressure_mpa = 4.0
    u = frame['valve_opening_percent'] * (frame['main_steam_pressure_mpa'] / 16.0) ** 1.125
    table = frame.assign(valve_opening_percent=u, main_steam_pressure_mpa=pressure_mpa)
    found = vf.identify(flow(table, 3.0))
    over_u, over_opening = found.characteristic, found.data.shown
    assert over_opening.breakpoints == pytest.approx(over_u.breakpoints / pressure_mpa**1.125)
    assert over_opening.values() == pytest.approx(over_u.values())
    v = np.linspace(*over_opening.breakpoints[[0, -1]], 9)[1:-1]
    assert over_opening(v) == pytest.approx(over_u.power(v, pressure_mpa))
    page = found.page().to_html()
    for part in (' % opening: from ', 'valve opening (%)', ' per %)', 'in all rows: the curve'):
        assert part in page, part
    assert not re.search(r'% MPa<sup>|integrated input|\bu %|at every u\b|at each u\b', page)


def test_a_unit_among_the_parameters_does_not_rename_what_the_log_holds(log):
    with pytest.raises(InputError, match='say what it is with --column'):
        vf.identify(log, parameters={'generated_power_unit': 't/h'})


def test_an_unknown_unit_is_told_the_known_ones(frame):
    with pytest.raises(ValveflowError, match='use one of MW, kW, W, GW, t/h, '):
        vf.open_log(frame, columns={'generated_power': f'{POWER}:barrels'})


@pytest.mark.parametrize(
    ('kpa', 'top', 'unit', 'warm'),
    [(8.0, 5.0, 'kg/s', 20.0), (400.0, 2000.0, 'm3/h', -160.0)],
    ids=['water', 'cold gas'],
)
def test_a_flow_over_a_pressure_difference_gives_its_curve(kpa, top, unit, warm):
    import pandas as pd

    columns, knots, values = flow_valve(kpa, top, warm)
    log = vf.open_log(pd.DataFrame(columns), columns={
        'valve_opening': 'LV', 'main_steam_pressure': 'DP:kPad', 'generated_power': f'FT:{unit}',
        'main_steam_temperature': 'TE',
    })  # fmt: skip
    assert not log.doubts
    found = vf.identify(log)
    c = found.characteristic
    assert (c.output_unit, c.pressure_exponent, c.axis) == (unit, 0.5, 'integrated_input')
    refused = [n for by in found.data.counts.values() for r, n in by.items() if r != 'accepted']
    assert sum(refused) == 0
    u = np.linspace(c.breakpoints[0], c.breakpoints[-1], 50)
    assert c(u) == pytest.approx(np.interp(u, knots, values), abs=0.003 * top)
    assert np.isfinite(c.source.temperature_mean_degc)
