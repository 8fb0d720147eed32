# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Values that do not suit their unit, and the unit that would."""

from __future__ import annotations

import numpy as np
import pytest

from valveflow_ros.interface.plausibility import doubt
from valveflow_ros.parameters import Settings
from valveflow_ros.records import SIGNALS, Signal
from valveflow_ros.signals.units import UNITS

USUAL = {
    Signal.VALVE_OPENING: (31.0, 94.0),
    Signal.MAIN_STEAM_PRESSURE: (8.0, 17.1),
    Signal.MAIN_STEAM_TEMPERATURE: (525.0, 545.0),
    Signal.GENERATED_POWER: (140.0, 310.0),
    Signal.VALVE_COMMAND: (0.5, 99.0),
}
CASES = [(s, unit) for s in Signal for unit in UNITS[s]]


def written_in(signal, unit):
    """Usual values of a signal as a log in ``unit`` would hold them."""
    low, high = USUAL[signal]
    values = np.linspace(low, high, 1000)
    return (values - UNITS[signal][unit].offset) / UNITS[signal][unit].scale


@pytest.mark.parametrize(('signal', 'unit'), CASES)
def test_values_in_their_own_unit_raise_no_doubt(signal, unit):
    assert doubt(signal, written_in(signal, unit), unit, Settings()) is None


@pytest.mark.parametrize(('signal', 'unit'), CASES)
def test_values_in_another_unit_are_recognised(signal, unit):
    for taken, factor in UNITS[signal].items():
        # 812 K read as degF is 433 degC, which a small unit may have.
        if factor == UNITS[signal][unit] or (unit, taken) == ('K', 'degF'):
            continue
        found = doubt(signal, written_in(signal, unit), taken, Settings())
        assert found is not None, taken
        assert UNITS[signal][found.looks_like] == UNITS[signal][unit]
        assert found.looks_like in found.sentence


def test_impossible_values_without_a_better_unit():
    found = doubt(Signal.GENERATED_POWER, np.array([200.0] * 9 + [-5000.0]), 'MW', Settings())
    assert found.looks_like == ''
    assert '10 % of them are impossible' in found.sentence


@pytest.mark.parametrize('info', SIGNALS, ids=lambda i: i.topic)
def test_no_values_raise_no_doubt(info):
    nothing = np.array([np.nan, np.inf, -np.inf])
    assert doubt(info.signal, nothing, info.unit, Settings()) is None
