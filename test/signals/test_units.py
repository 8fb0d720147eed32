# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from streams import examples

from valveflow_ros.errors import InputError
from valveflow_ros.parameters import PARAMETERS
from valveflow_ros.records import FLOW_UNITS, SIGNALS, Signal
from valveflow_ros.signals.static_form import integrated_input
from valveflow_ros.signals.units import (
    DIFFERENCES,
    UNITS,
    convert,
    engine_unit,
    in_unit,
    known_units,
    unit_of,
)

# The same state of a plant, told in every unit there is (NIST SP 811 for the definitions).
SAME = {
    Signal.VALVE_OPENING: {'%': 42.0, 'percent': 42.0, 'fraction': 0.42},
    Signal.VALVE_COMMAND: {'%': 42.0, 'percent': 42.0, 'fraction': 0.42},
    Signal.MAIN_STEAM_PRESSURE: {
        'MPa': 16.7,
        'kPa': 16_700.0,
        'Pa': 16_700_000.0,
        'bar': 167.0,
        'psi': 16.7e6 / (0.45359237 * 9.80665 / 0.0254**2),
    },
    Signal.MAIN_STEAM_TEMPERATURE: {'degC': 538.0, 'K': 811.15, 'degF': 1000.4},
    Signal.GENERATED_POWER: {'MW': 300.0, 'kW': 300_000.0, 'W': 3e8},
}


@pytest.mark.parametrize(
    ('signal', 'name'), [(s, name) for s, units in SAME.items() for name in units]
)
def test_every_unit_tells_the_same_state(signal, name):
    engine = next(iter(SAME[signal].values()))
    got = convert(signal, name, np.array([SAME[signal][name]]))
    assert got[0] == pytest.approx(engine, rel=1e-12)


def test_every_unit_there_is_has_been_compared():
    assert {s: set(units) for s, units in UNITS.items()} == {s: set(u) for s, u in SAME.items()}


@pytest.mark.parametrize('info', SIGNALS)
def test_the_parameter_offers_the_units_that_a_log_may_have(info):
    # A gateway sends no pressure difference, and nobody logs GW.
    left_out = {'GW', *DIFFERENCES}
    parameter = PARAMETERS[f'{info.topic}_unit']
    assert set(parameter.choices) == set(known_units(info.signal)) - left_out
    assert unit_of(info.signal, parameter.default) == unit_of(info.signal, info.unit)


@pytest.mark.parametrize(
    ('name', 'sent', 'mpa'),
    [('barg', 159.0, 16.001325), ('psig', 0.0, 0.101325), ('kg/cm2', 100.0, 9.80665)],
)
def test_a_gauge_sends_what_is_above_the_air(name, sent, mpa):
    assert name in PARAMETERS['main_steam_pressure_unit'].choices
    got = convert(Signal.MAIN_STEAM_PRESSURE, name, np.array([sent]))
    assert got[0] == pytest.approx(mpa, rel=1e-12)


@pytest.mark.parametrize('spelling', ['mpa', ' MPA ', 'Mpa'])
def test_capitals_and_blanks_do_not_matter(spelling):
    assert unit_of(Signal.MAIN_STEAM_PRESSURE, spelling).scale == 1.0


@pytest.mark.parametrize('name', ['', 'atm', 'MW', 'mm', '\x00', 'M Pa'])
def test_an_unknown_unit_is_refused_and_the_known_ones_named(name):
    with pytest.raises(InputError) as caught:
        unit_of(Signal.MAIN_STEAM_PRESSURE, name)
    sentence = str(caught.value)
    assert 'main_steam_pressure' in sentence
    assert all(unit in sentence for unit in ('MPa', 'kPa', 'Pa', 'bar', 'psi'))


@examples(60)
@given(
    st.lists(st.floats(0.0, 110.0), min_size=1, max_size=20),
    st.floats(0.1, 30.0),
    st.floats(0.5, 2.0),
)
def test_u_is_opening_times_pressure_to_the_exponent(opening, pressure, exponent):
    u = integrated_input(np.array(opening), np.full(len(opening), pressure), exponent)
    assert u == pytest.approx([v * math.exp(exponent * math.log(pressure)) for v in opening])
    twice = integrated_input(2.0 * np.array(opening), np.full(len(opening), pressure), exponent)
    assert twice == pytest.approx(2.0 * u)


def test_an_infinite_input_gives_no_finite_u():
    assert not np.isfinite(integrated_input(np.array([np.inf]), np.array([10.0])))
    assert not np.isfinite(integrated_input(np.array([50.0]), np.array([np.inf])))
    assert np.isnan(integrated_input(np.array([np.nan]), np.array([10.0])))


def test_single_precision_inputs_are_computed_in_double():
    opening, pressure = np.array([37.3], dtype=np.float32), np.array([11.7], dtype=np.float32)
    u = integrated_input(opening, pressure)
    assert u.dtype == np.float64
    assert u[0] == pytest.approx(float(opening[0]) * float(pressure[0]) ** 1.125, rel=1e-12)


def test_empty_and_read_only_arrays():
    assert len(integrated_input(np.empty(0), np.empty(0))) == 0
    values = np.array([1.0, 2.0])
    values.setflags(write=False)
    assert convert(Signal.GENERATED_POWER, 'kW', values).tolist() == [0.001, 0.002]
    assert integrated_input(values, values).shape == (2,)


@pytest.mark.parametrize(
    ('said', 'told'),
    [
        ('Power: 0.3 MW (0.1 MW², 0.1 MW^2).', 'Flow: 0.3 t/h (0.1 (t/h)², 0.1 (t/h)^2).'),
        ('0.5 MPa/MW; 2 MW/(10 d); MW per unit', '0.5 MPa/(t/h); 2 (t/h)/(10 d); t/h per unit'),
        ('the generated power, {"power": "power"}', 'the flow, {"power": "flow"}'),
        ('Generated power of generated_power, rmse_mw', 'Flow of generated_power, rmse_mw'),
        ("at one load, all the loads seen; a workload, load the log, x='the load'",
         "at one flow, all the flows seen; a workload, load the log, x='the load'"),
        ("power.csv, 'Power [t/h]', --column generated_power=MW_GROSS:MW", ''),
        ('GENERATED_POWER_MW of 12MW, MWh, powerful', ''),
    ],
)  # fmt: skip
def test_a_sentence_in_megawatts_becomes_one_of_a_flow(said, told):
    assert in_unit(said, 'MW') == said
    assert in_unit(said, 't/h') == (told or said)
    assert in_unit(in_unit(said, 't/h'), 't/h') == (told or said)


@pytest.mark.parametrize('unit', FLOW_UNITS)
def test_a_flow_keeps_its_unit_and_its_values(unit):
    values = np.array([0.0, 1.25, 1e6])
    assert (convert(Signal.GENERATED_POWER, unit, values) == values).all()
    assert engine_unit(Signal.GENERATED_POWER, unit) == unit
    assert engine_unit(Signal.GENERATED_POWER, 'kW') == 'MW'


def test_a_pressure_difference_is_a_pressure_without_the_air():
    for unit in ('MPa', 'kPa', 'Pa', 'bar', 'psi', 'mbar'):
        there = np.array([0.5, 2.0])
        absolute, difference = (
            convert(Signal.MAIN_STEAM_PRESSURE, name, there) for name in (unit, f'{unit}d')
        )
        assert (absolute == difference).all()
        assert engine_unit(Signal.MAIN_STEAM_PRESSURE, f'{unit}d') == 'MPad'
