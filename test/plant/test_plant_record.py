# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Faults of the record: where they are, how large, and that nothing else is touched."""

from __future__ import annotations

import numpy as np
import pytest

from valveflow_ros.plant.effects.record import spikes
from valveflow_ros.plant.simulator import simulate
from valveflow_ros.plant.spec import EffectSpec
from valveflow_ros.plant.unit import UnitDescription
from valveflow_ros.records import SIGNALS, Signal

DAYS = 0.2


@pytest.mark.parametrize('info', SIGNALS, ids=lambda info: info.topic)
def test_a_flat_line_holds_its_first_value(info: object) -> None:
    effect = EffectSpec.of('flatline', signal=info.topic, t0_days=0.1, minutes=30.0)
    none, log = simulate(DAYS, 1), simulate(DAYS, 1, effects=[effect])
    column, clean = log.table.column(info.signal), none.table.column(info.signal)
    window = slice(8640, 8640 + 1800)
    assert np.all(column[window] == clean[8640])
    outside = np.ones(len(log), dtype=bool)
    outside[window] = False
    np.testing.assert_array_equal(column[outside], clean[outside])


def test_two_signals_may_stand_still() -> None:
    pair = [
        EffectSpec.of('flatline', signal=topic, t0_days=0.1)
        for topic in ('valve_opening', 'generated_power')
    ]
    log = simulate(DAYS, 1, effects=pair)
    for signal in (Signal.VALVE_OPENING, Signal.GENERATED_POWER):
        assert np.ptp(log.table.column(signal)[8700:12000]) == 0.0


@pytest.mark.parametrize(('topic', 'step'), [('generated_power', 5.0), ('valve_opening', 0.5)])
def test_a_coarse_record_knows_multiples_only(topic: str, step: float) -> None:
    effect = EffectSpec.of('quantisation', signal=topic, step=step)
    none, log = simulate(DAYS, 1), simulate(DAYS, 1, effects=[effect])
    signal = next(info.signal for info in SIGNALS if info.topic == topic)
    column, clean = log.table.column(signal), none.table.column(signal)
    np.testing.assert_allclose(column / step, np.round(column / step), atol=1e-9)
    assert np.abs(column - clean).max() <= step / 2 + 1e-9
    # Coarse enough to be told from a clean record by its repeated values.
    assert np.mean(np.diff(column) == 0.0) > 0.5 > 0.1 > np.mean(np.diff(clean) == 0.0)


@pytest.mark.parametrize('step_s', [1.0, 2.0])
def test_spikes_are_where_their_pattern_says(step_s: float) -> None:
    effect = EffectSpec.parse('spikes:per_day=200,height=30')
    unit = UnitDescription(sample_period_s=step_s)
    none, log = simulate(DAYS, 1, unit), simulate(DAYS, 1, unit, effects=[effect])
    added = log.table.column(Signal.GENERATED_POWER) - none.table.column(Signal.GENERATED_POWER)
    expected = np.zeros(len(log))
    for second, sign in spikes(effect.values, DAYS * 86_400.0):
        expected[int(second / step_s)] += 30.0 * sign
    np.testing.assert_allclose(added, expected, atol=1e-9)
    assert {-30.0, 30.0} <= set(np.round(added, 6))


def test_another_pattern_has_other_spikes() -> None:
    drawn = [spikes(EffectSpec.of('spikes', pattern=k).values, 864_000.0) for k in (1, 2)]
    assert not np.array_equal(drawn[0][:5], drawn[1][:5])
    assert all(60 < len(d) < 140 for d in drawn)
