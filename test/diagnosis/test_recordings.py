# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a diagnosis makes of how a record was kept: coarse rows, held values, a valve at rest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from diagnosis_records import record, table, unit
from streams import needs_jit

import valveflow_ros as vf
from valveflow_ros.diagnosis import record_faults
from valveflow_ros.diagnosis.cause import Estimate, FittedCause
from valveflow_ros.diagnosis.causes import catalogue
from valveflow_ros.diagnosis.grids import Blur, Grids, blur_of
from valveflow_ros.diagnosis.loop import actuator
from valveflow_ros.diagnosis.search import hidden, unseen
from valveflow_ros.records import SampleTable, Signal
from valveflow_ros.signals.compression import Compression, Updates

pytestmark = needs_jit
TIMED = {'clock': (5.0,), 'reheater': (0.3, 20.0), 'region_lag': (30.0, 5.0, 250.0)}
SLACK = {'backlash': (0.6,), 'stiction': (1.0, 0.7)}


@pytest.fixture(scope='module')
def samples() -> SampleTable:
    return table(0.4, 2, (), unit())


@pytest.fixture(scope='module')
def grids(samples: SampleTable) -> Grids:
    return record(samples).grids(np.zeros(samples.values.shape, dtype=bool))


def compression(interval_s: float) -> Compression:
    """A log with values so far apart."""
    updates = {s: Updates(interval_s, 0.5) for s in (Signal.VALVE_OPENING, Signal.GENERATED_POWER)}
    return Compression(updates, 600.0, 10.0, own_times=True)


def test_fine_rows_hide_nothing(grids: Grids) -> None:
    assert grids.blur == Blur() == blur_of(np.arange(9.0), 19.9, None)
    for name, cause in catalogue().items():
        assert unseen(name, grids) == ''
        assert hidden(FittedCause(cause, (0.1,) * len(cause.unknowns)), grids) == ''


@pytest.mark.parametrize('step_s', [20.0, 60.0, 300.0])
def test_a_coarse_step_hides_what_is_shorter(grids: Grids, step_s: float) -> None:
    moves = np.cumsum(np.tile([0.1, -0.1, 0.2, -0.2], 50))
    blur = blur_of(moves, step_s, None)
    assert blur.time_s == step_s
    assert blur.opening_percent == pytest.approx(0.6)
    coarse = replace(grids, blur=blur)
    for name, values in TIMED.items():
        short, long = (
            (*(f * step_s if k == 'time' else v for k, v in zip(keys(name), values, strict=True)),)
            for f in (0.9, 1.1)
        )
        assert hidden(FittedCause(catalogue()[name], short), coarse).startswith(
            f'cannot be judged at this sampling: rows {step_s:g} s apart hide lags and delays'
        )
        assert hidden(FittedCause(catalogue()[name], long), coarse) == ''
    for name in SLACK:
        assert hidden(FittedCause(catalogue()[name], (0.59, 0.5)[: len(SLACK[name])]), coarse)
        assert not hidden(FittedCause(catalogue()[name], (0.61, 0.5)[: len(SLACK[name])]), coarse)
    assert hidden(FittedCause(catalogue()['rate_limit'], (0.61 / step_s,)), coarse)
    assert not hidden(FittedCause(catalogue()['rate_limit'], (0.59 / step_s,)), coarse)
    assert not hidden(FittedCause(catalogue()['gain_drift'], (0.01,)), coarse)


def keys(name: str) -> list[str]:
    """Which value of a cause is its time scale."""
    return {'clock': ['time'], 'reheater': ['', 'time'], 'region_lag': ['time', '', '']}[name]


def test_a_compressed_log_hides_its_interval_and_half_of_it_of_a_clock(grids: Grids) -> None:
    held = replace(grids, blur=blur_of(grids.v, 10.0, compression(54.0)))
    assert (held.blur.time_s, held.blur.least_s('clock')) == (54.0, 27.0)
    assert hidden(FittedCause(catalogue()['reheater'], (0.3, 50.0)), held) != ''
    assert held.blur.opening_percent >= 2.0
    why = hidden(FittedCause(catalogue()['clock'], (26.0,)), held)
    assert why == (
        'cannot be judged: values of the power in this compressed log are typically 54 s apart, '
        'which hides lags and delays below 27 s'
    )
    assert hidden(FittedCause(catalogue()['clock'], (28.0,)), held) == ''
    assert 'compressed' in actuator.hindered(replace(held, command=held.v + 1.0))


def test_held_values_are_no_flatline_and_no_steps(samples: SampleTable) -> None:
    values = samples.values.copy()
    values[500:900, Signal.GENERATED_POWER] = values[500, Signal.GENERATED_POWER]
    still = SampleTable(samples.time_ns, values, samples.quality)
    one = record(still)
    bad, found = one.faults()
    assert [(f.name, f.signal.signal) for f in found] == [('flatline', Signal.GENERATED_POWER)]
    bad, found = replace(one, compression=compression(50.0)).faults()
    assert not found
    assert not bad.any()


@pytest.mark.parametrize('level', [0.0, 100.0, None])
def test_a_valve_at_its_stop_is_no_dead_transmitter(samples: SampleTable, level) -> None:
    values = samples.values.copy()
    opening = values[:, Signal.VALVE_OPENING]
    top = float(np.nanmax(opening)) if level is None else level
    opening[500:2500] = top
    at_stop = SampleTable(samples.time_ns, values, samples.quality)
    bad, found = record_faults.faults(at_stop, 2.0)
    assert not found
    assert not bad.any()
    opening[500:2500] = 0.5 * (np.nanmin(opening[2500:]) + np.nanmax(opening[2500:]))
    _, found = record_faults.faults(SampleTable(samples.time_ns, values, samples.quality), 2.0)
    assert [f.name for f in found] == ['flatline']


@pytest.mark.parametrize(
    'effect', [(), pytest.param(('backlash:w_percent=1',), marks=pytest.mark.long)]
)
def test_means_of_a_minute_name_no_slack_of_another_size(effect: tuple[str, ...]) -> None:
    """A slack is found with an interval that holds the truth, or cannot be judged."""
    plant = vf.simulate(3, 2, effect, unit='choked_fixed:number=2', recording='minute')
    found = vf.diagnose(plant.log).diagnosis
    named = {c.name: c for c in found.causes}
    if 'backlash' in named:
        width = named['backlash'].parameters['w_percent']
        assert effect
        assert width.low <= 1.0 <= width.high
    else:
        said = dict(found.rejected)['backlash']
        assert said.startswith('cannot be judged at this sampling: rows 60 s apart hide a slack')
        assert not named
    assert any('may come from that' in note for note in found.notes)


@pytest.mark.long
def test_the_size_of_a_temperature_effect_beside_unlogged_weather_holds_the_truth() -> None:
    """A condenser that is not in the log agrees a little with the temperature."""
    unit = 'choked:number=1401'
    plant = vf.simulate(8, 1401, ['temperature:k=-0.0016'], unit=unit, recording='minute')
    (cause,) = vf.diagnose(plant.log).diagnosis.causes
    k = cause.parameters['k']
    assert cause.name == 'temperature'
    assert k.low < -0.0016 < k.high < -0.0014


def test_a_lag_that_its_error_exceeds_is_not_told() -> None:
    """The values stay in the parameters; the sentence does not tell them."""
    lag = FittedCause(catalogue()['region_lag'], (30.0, 5.0, 250.0))
    bounds = {'time_s': (25.0, 35.0), 'delay_s': (-6.0, 16.0), 'level_mw': (240.0, 260.0)}
    told = {name: Estimate(lag.named()[name], *ends, 's') for name, ends in bounds.items()}
    said = lag.sentence(0, told)
    assert 'a time constant of 30 s and a delay that is not known' in said
    assert 'a delay of 5 s' in lag.sentence(0, None)


@pytest.mark.parametrize(
    ('unit', 'true'),
    [('choked_fixed:number=5008', {'vacuum'}),
     pytest.param('integrated_input_fixed:number=5012', {'vacuum', 'exponent'},
                  marks=pytest.mark.long)],
)  # fmt: skip
def test_the_rounded_curve_of_a_healthy_unit_is_no_cause(unit: str, true: set[str]) -> None:
    """Its law has another exponent than the paper's, which is true, and it follows the vacuum."""
    _, number = unit.split('=')
    log = vf.simulate(3.0, int(number), [], unit=unit, recording='minute')
    found = vf.diagnose(log.to_dataframe(), covariates={'vacuum': 'condenser_pressure_kpa'})
    assert {c.name for c in found.diagnosis.causes} <= true
