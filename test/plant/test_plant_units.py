# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Units and runs: which are refused, which are plausible."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from valveflow_ros.errors import InputError
from valveflow_ros.plant.simulator import simulate, simulate_parts
from valveflow_ros.plant.unit import Curve, Noise, Programme, Region, UnitDescription, random_unit

END = Region(np.inf, 10.0, 3.0)
REFUSED = [
    *(
        (lambda a=arguments: simulate(**{'days': 0.1, 'seed': 1, **a}), words)
        for arguments, words in (
            ({'days': 0.0}, 'more than 0'),
            ({'days': np.nan}, 'more than 0'),
            ({'days': 401.0}, 'at most 400'),
            ({'seed': -1}, 'seed must be 0 or more, not -1'),
            ({'start_ns': -1}, 'between the years'),
            ({'start_ns': 2**63 - 2}, 'between the years'),
        )
    ),
    *(
        (lambda s=part_s: simulate_parts(0.1, 1, part_s=s), 'one sample period')
        for part_s in (0.0, -1.0, np.nan)
    ),
    *(
        (lambda r=regions: UnitDescription(regions=r), 'follow each other')
        for regions in (
            (), (Region(240.0, 10.0, 3.0),), (END, END),
            (Region(240.0, 10.0, 3.0), Region(230.0, 5.0, 3.0), END),
        )
    ),
    *(
        (lambda c=change: Programme(**c), 'This programme cannot be simulated: ')
        for change in (
            {'load_mean_mw': 100.0}, {'full_load_from_mw': 300.0}, {'full_load_share': 1.1},
            {'load_spread_mw': -1.0}, {'hold_min_s': -1.0}, {'ramp_low_mw_per_min': 0.0},
            {'ramp_low_mw_per_min': 7.0}, {'pressure_low_mpa': np.nan}, {'pressure_span_mw': 0.0},
            {'jitter_s': 0.0}, {'temperature_pressure_correlation': 1.1},
            {'pulse_low_percent': 5.0}, {'feedback_slope_mw': 0.0},
        )
    ),
    *(
        (lambda c=change: Noise(**c), 'This noise cannot be simulated: ')
        for change in ({'slow_time_s': 0.0}, {'white_mw': -1.0}, {'load_dependence': np.nan})
    ),
    *(
        (lambda p=pair: Region(np.inf, *p), 'time constant above 0')
        for pair in ((0.0, 1.0), (np.inf, 1.0), (1.0, -1.0), (1.0, np.nan))
    ),
]  # fmt: skip


@pytest.mark.parametrize(('make', 'words'), REFUSED)
def test_what_cannot_be_simulated_is_refused(make, words) -> None:
    with pytest.raises(InputError, match=words):
        make()


def test_a_curve_through_points_passes_through_them() -> None:
    u, x = np.array([1.0, 4.0, 9.0]), np.array([2.0, 8.0, 9.0])
    curve = Curve.through(u, x)
    np.testing.assert_allclose(curve(u), x)
    np.testing.assert_allclose(curve.inverse_table()[0], x)
    with pytest.raises(InputError, match='must increase'):
        Curve.through(u, x[::-1])


@pytest.mark.parametrize('number', range(24))
def test_other_units_are_plausible(number: int) -> None:
    unit = random_unit(np.random.default_rng(number))
    curve, plan = unit.curve, unit.programme
    assert 2 <= len(curve.slopes) <= 6
    assert 1 <= len(unit.regions) <= 3
    ratio = curve.slopes[1:] / curve.slopes[:-1]
    assert np.all((ratio < 0.7501) | (ratio > 1.3499))
    jumps = np.diff(curve.slopes) * curve.knots[1:-1] + np.diff(curve.intercepts)
    np.testing.assert_allclose(jumps, 0.0, atol=1e-9)
    log = simulate(0.5, number, unit)
    inside = (log.true_u > curve.knots[0]) & (log.true_u < curve.knots[-1])
    assert inside.mean() > 0.99
    assert np.mean(log.table.values[:, 4] >= 100.0) < 0.05
    assert abs(np.mean(log.true_power_mw - log.load_mw)) < 0.03 * plan.load_high_mw
    assert log.table.values[:, 4].min() > 40.0


def test_other_units_differ_in_every_respect() -> None:
    units = [random_unit(np.random.default_rng(k)) for k in range(60)]
    assert {len(u.curve.slopes) for u in units} == {2, 3, 4, 5, 6}
    assert {len(u.regions) for u in units} == {1, 2, 3}
    assert {u.sample_period_s for u in units} == {1.0, 2.0}
    assert {u.programme.feedback for u in units} == {False, True}
    assert any(np.any(np.diff(u.curve.slopes) > 0.0) for u in units)


def test_every_unit_description_is_used() -> None:
    # A field nobody reads would make two units the same.
    usual = simulate(0.02, 20)
    for field in dataclasses.fields(Noise):
        changed = dataclasses.replace(Noise(), **{field.name: 2.0 * getattr(Noise(), field.name)})
        if field.name in ('wander_mw', 'load_dependence'):
            changed = dataclasses.replace(Noise(), **{field.name: 0.5})
        if field.name == 'wander_time_s':
            changed = Noise(wander_mw=1.0, wander_time_s=100.0)
        log = simulate(0.02, 20, UnitDescription(noise=changed))
        assert not np.array_equal(log.table.values, usual.table.values), field.name
