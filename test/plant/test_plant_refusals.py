# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What cannot be simulated is refused in one sentence: effects, units, runs and records."""

import dataclasses
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from valveflow_ros.errors import InputError
from valveflow_ros.plant.effects import catalogue
from valveflow_ros.plant.historian import Historian
from valveflow_ros.plant.simulator import simulate, simulate_parts
from valveflow_ros.plant.spec import EffectSpec
from valveflow_ros.plant.thermal_effects import area_step, thermal_catalogue
from valveflow_ros.plant.thermal_plant import simulate_thermal
from valveflow_ros.plant.thermal_unit import (
    GovernorValve,
    SequencedValves,
    SmoothArea,
    ThermalUnit,
    unit_of,
)
from valveflow_ros.plant.unit import Curve, Noise, Programme, Region, UnitDescription

END, LOW = Region(np.inf, 10.0, 3.0), Region(240.0, 10.0, 3.0)
EFFECTS = [
    ('gain_stp', r"Effect 'gain_stp' is unknown: use one of backlash, .*'gain_step'\?$"),
    ('', r"Effect '' is unknown: use one of backlash, "),
    ('gain_step:h=1', r"'gain_step' has no parameter 'h': it has g, t0_days \(d\)\.$"),
    ('gain_step:g=a', r"'gain_step': g must be a number, not 'a'\.$"),
    ('gain_step:g=0.3', r"'gain_step': g must be from -0\.2 to 0\.2, not 0\.3\.$"),
    ('gain_step:g=nan', r"'gain_step': g must be from .* not nan\.$"),
    ('gain_step:t0_days=-1', r't0_days must be from 0 to 400 d, not -1\.0\.$'),
    ('gain_step:g', r"'gain_step': 'g' is not of the form key=value\.$"),
    ('gain_step:g=', r"'g=' is not of the form key=value"),
    ('gain_step:=1', r"'=1' is not of the form key=value"),
    ('gain_step:g=0.1,g=0.1', r"'gain_step': g is given twice\.$"),
    ('rate_limit:before_sensor=0.5', r"before_sensor must be a whole number, not '0\.5'"),
    ('flatline:signal=power', r'signal must be one of valve_opening, .* not .power.\.$'),
    ('stiction:s_percent=0.5', r"'stiction': j_percent must not exceed s_percent\.$"),
    ('curve_step:u_from=1800', r"'curve_step': u_from must be less than u_to\.$"),
    ('intervals:on_low_h=30', r'on_low_h must not exceed on_high_h'),
    ('intervals:off_low_h=90', r'off_low_h must not exceed off_high_h'),
]
HISTORIANS = [
    ('', r"no recording '': use one of 1s, minute, compressed\.$"),
    ('compressed:band=1', "Recording 'compressed' has no option 'band': it has band_percent"),
    ('compressed:band_percent=x', "band_percent must be a number, not 'x'"),
    ('compressed:band_percent=nan', 'finite'),
    ('compressed:band_percent=-1', 'band_percent must be 0 to 50'),
    ('compressed:scan_low_s=40', 'scans must be'),
    ('compressed:longest_s=20', 'longest_s must not be below scan_high_s'),
    ('compressed:resample_s=1.5', 'whole seconds'),
    ('minute:resample_s=60', "belongs to the recording 'compressed'"),
    ('1s:dropouts_per_day=1000', 'dropouts_per_day must be 0 to 100'),
    ('1s:dropout_minutes=0', 'dropout_minutes'),
]
UNITS = [
    ('', "no unit '': use one of choked, "),
    ('choked:n=1', "Unit 'choked' has no option 'n': it has number, "),
    ('choked:number=1.5', 'number must be a whole number, not 1.5'),
    ('choked:number=-1', 'must be 0 or more, not -1'),
    ('choked:number=1,number=2', 'number is given twice'),
]
RUNS = [
    ({'days': 0.0}, 'more than 0'),
    ({'days': np.nan}, 'more than 0'),
    ({'days': 401.0}, 'at most 400'),
    ({'seed': -1}, 'seed must be 0 or more, not -1'),
    ({'start_ns': -1}, 'between the years'),
    ({'start_ns': 2**63 - 2}, 'between the years'),
    ({'effects': [EffectSpec.of(area_step, t0_days=0.0)]}, 'thermal unit only'),
    ({'effects': [EffectSpec.parse('spikes:per_day=0.01')]}, 'begin after .* simulate longer'),
    *(
        ({'effects': [EffectSpec.parse(name)]}, r'would begin after .* lasts 0\.1: simulate')
        for name in ('gain_step', 'input_step', 'curve_step', 'flatline', 'intervals')
    ),
    *(
        ({'effects': [EffectSpec.parse(name)] * 2}, f"'{name}'.* is given twice")
        for name in ('backlash', 'stiction', 'rate_limit', 'saturation', 'region_lag', 'reheater',
                     'choked', 'clock')
    ),
]  # fmt: skip
THERMAL_RUNS = [
    ({'days': np.nan}, 'more than 0 and at most 60 days, not nan'),
    ({'days': 61.0}, 'at most 60 days, not 61'),
    ({'seed': -1}, 'seed must be 0 or more, not -1'),
    ({'start_ns': 0}, 'between the years'),
    ({'effects': ['gain_stp']}, r"'gain_stp' is unknown: use one of area_step.*gain_step"),
    ({'effects': ['area_step:h=1']}, "'area_step' has no parameter 'h'"),
    ({'effects': ['pressure_scale'] * 2}, 'given twice'),
    ({'effects': ['area_step']}, 'would begin after 5 days'),
    *(
        ({'effects': [name]}, 'no meaning on the unit')
        for name in sorted(set(catalogue()) - set(thermal_catalogue()))
    ),
]
THERMAL_UNITS = [
    ({'reheater_s': 0.0}, 'times must be above 0 s'),
    ({'exponent': np.nan}, 'exponent must be'),
    ({'no_load_mw': -1.0}, 'no_load_mw'),
    ({'load_low_mw': 325.0}, 'loads must be'),
    ({'slide_from_mw': 310.0}, 'slide_from_mw'),
    ({'pressure_low_mpa': 17.0}, 'pressures must be'),
    ({'full_opening_percent': 101.0}, 'full_opening_percent'),
    ({'reserve_hours': 1.1}, 'reserve_hours'),
    ({'high_pressure_share': 1.1}, 'high_pressure_share'),
    ({'droop': 0.0}, 'droop'),
    ({'vacuum_per_kpa': -1.0}, 'vacuum_per_kpa'),
]
PROGRAMMES = [
    {'load_mean_mw': 100.0}, {'full_load_from_mw': 300.0}, {'full_load_share': 1.1},
    {'load_spread_mw': -1.0}, {'hold_min_s': -1.0}, {'ramp_low_mw_per_min': 0.0},
    {'ramp_low_mw_per_min': 7.0}, {'pressure_low_mpa': np.nan}, {'pressure_span_mw': 0.0},
    {'jitter_s': 0.0}, {'temperature_pressure_correlation': 1.1}, {'pulse_low_percent': 5.0},
    {'feedback_slope_mw': 0.0},
]  # fmt: skip
NOISES = [{'slow_time_s': 0.0}, {'white_mw': -1.0}, {'load_dependence': np.nan}]
REFUSED = [
    *((EffectSpec.parse, (text,), {}, said) for text, said in EFFECTS),
    *((Historian.parse, (text,), {}, said) for text, said in HISTORIANS),
    *((unit_of, (text,), {}, said) for text, said in UNITS),
    *((simulate, (), {'days': 0.1, 'seed': 1, **given}, said) for given, said in RUNS),
    *((simulate_thermal, (), {'days': 0.1, 'seed': 1, **g}, said) for g, said in THERMAL_RUNS),
    *((ThermalUnit, (), given, said) for given, said in THERMAL_UNITS),
    *((Programme, (), given, 'This programme cannot be simulated: ') for given in PROGRAMMES),
    *((Noise, (), given, 'This noise cannot be simulated: ') for given in NOISES),
    *(
        (simulate_parts, (0.1, 1), {'part_s': part_s}, 'one sample period')
        for part_s in (0.0, np.nan)
    ),
    *(
        (UnitDescription, (), {'regions': regions}, 'follow each other')
        for regions in ((), (LOW,), (END, END), (LOW, Region(230.0, 5.0, 3.0), END))
    ),
    (UnitDescription, (), {'sample_period_s': 61.0}, 'between 0.01 and 60 s'),
    *(
        (Region, (np.inf, *pair), {}, 'time constant above 0')
        for pair in ((0.0, 1.0), (np.inf, 1.0), (1.0, -1.0), (1.0, np.nan))
    ),
    (Curve.through, (np.arange(3.0), np.array([1.0, 3.0, 2.0])), {}, 'must increase'),
    (Curve, (np.arange(3.0), np.ones(1), np.ones(1)), {}, r'needs J \+ 1 ends'),
    (SmoothArea, ((70.0, 50.0),), {}, 'rising knees'),
    (SequencedValves, ((GovernorValve(50.0, 50.0, 1.0),),), {}, '1 to 8 valves'),
    (simulate_thermal, (0.1, 1), {'effects': [
        dataclasses.replace(EffectSpec.parse('backlash'), effect=catalogue()['choked'])
    ]}, 'no meaning on the unit'),
]  # fmt: skip


@pytest.mark.parametrize(('make', 'given', 'more', 'said'), REFUSED)
def test_what_cannot_be_simulated_is_refused(make, given, more, said):
    with pytest.raises(InputError) as caught:
        make(*given, **more)
    assert re.search(said, str(caught.value)), caught.value
    assert str(caught.value)[-1] in '.?'


@given(st.text(max_size=40))
def test_any_text_is_either_an_effect_or_a_sentence(text):
    for candidate in (text, f'gain_step:{text}', f'gain_step:g={text}'):
        said = ''
        try:
            EffectSpec.parse(candidate)
        except InputError as error:
            said = str(error)
        assert said == '' or said.startswith('Effect ')
