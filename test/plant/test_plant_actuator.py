# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The operators of the actuator, by their laws."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from valveflow_ros.plant import loop
from valveflow_ros.plant.effect import ActuatorLimits

paths = st.lists(st.floats(0.0, 100.0, width=32), min_size=1, max_size=60)
widths = st.floats(0.0, 5.0, width=32)


def through(bank: ActuatorLimits, path: list[float], step_s: float = 1.0) -> np.ndarray:
    """Send a path through a bank that rests at its first value."""
    settings = loop.settings(bank, step_s)
    positions = np.full(loop.N_POSITIONS, path[0])
    return np.array([loop.move(v, positions, settings) for v in path])


@given(paths)
def test_a_bank_without_faults_changes_nothing(path: list[float]) -> None:
    np.testing.assert_array_equal(through(ActuatorLimits(), path), path)


@given(paths, widths)
def test_play_stays_within_half_its_width(path: list[float], width: float) -> None:
    gap = through(ActuatorLimits(slack_percent=width), path) - path
    assert np.all(np.abs(gap) <= width / 2 + 1e-9)


@given(paths, widths, st.integers(2, 5))
def test_play_does_not_know_how_fast_it_was_driven(
    path: list[float], width: float, times: int
) -> None:
    # Straight between its points and slower by a factor: the same at the points.
    slow = np.interp(np.arange((len(path) - 1) * times + 1) / times, np.arange(len(path)), path)
    fast = through(ActuatorLimits(slack_percent=width), path)
    np.testing.assert_allclose(
        through(ActuatorLimits(slack_percent=width), list(slow))[::times], fast, atol=1e-9
    )


@given(paths, widths)
def test_stick_slip_without_a_jump_is_play(path: list[float], width: float) -> None:
    sticking = through(ActuatorLimits(band_percent=width), path)
    np.testing.assert_allclose(
        sticking, through(ActuatorLimits(slack_percent=width), path), atol=1e-9
    )


@given(paths, widths, st.floats(0.0, 1.0))
def test_a_sticking_valve_stays_or_jumps(path: list[float], band: float, share: float) -> None:
    jump = share * band
    position = through(ActuatorLimits(band_percent=band, jump_percent=jump), path)
    moves = np.abs(np.diff(position))
    # It slips by the jump at least, or not at all.
    assert np.all((moves == 0.0) | (moves >= jump - 1e-9))
    assert np.all(np.abs(position - path) <= (band + jump) / 2 + 1e-9)


@given(paths, st.floats(0.01, 10.0), st.sampled_from([0.5, 1.0, 2.0]))
def test_a_limited_rate_is_kept(path: list[float], rate: float, step_s: float) -> None:
    position = through(ActuatorLimits(rate_percent_per_s=rate), path, step_s)
    assert np.all(np.abs(np.diff(position)) <= rate * step_s + 1e-9)
    # It ends where it is sent if it is given the time.
    settled = through(ActuatorLimits(rate_percent_per_s=rate), [*path, *[50.0] * 20_000], step_s)
    assert settled[-1] == 50.0


@given(paths, st.floats(1.0, 100.0))
def test_a_stop_is_the_smaller_of_two(path: list[float], top: float) -> None:
    np.testing.assert_array_equal(
        through(ActuatorLimits(top_percent=top), path)[1:], np.minimum(path, top)[1:]
    )


def test_a_rate_limit_knows_how_fast_it_was_driven() -> None:
    fast = through(ActuatorLimits(rate_percent_per_s=1.0), [0.0, 3.0, 6.0])
    slow = through(ActuatorLimits(rate_percent_per_s=1.0), list(np.arange(0.0, 6.1, 0.5)))
    assert fast[-1] == pytest.approx(2.0)
    assert slow[-1] == pytest.approx(6.0)
