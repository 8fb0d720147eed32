# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Slow wear: followed by the reference, told per month, and beyond its budget a shift."""

from __future__ import annotations

import numpy as np
import pytest
from curves import curve

from valveflow_ros.curve.characteristic import FittedData, RegionDynamics
from valveflow_ros.monitoring.reference import MONTH_NS, ReferenceCurve
from valveflow_ros.parameters import Settings
from valveflow_ros.records import NS_PER_S, SegmentKind, SpecialSegment

DAY_NS = 86_400 * NS_PER_S
START_NS = 20_000 * DAY_NS
KNOTS, SLOPES = np.array([1000.0, 1500.0, 2200.0]), np.array([0.2, 0.1])
SETTINGS = Settings({'wear_budget': 3.0})


def power_of(u):
    return np.interp(u, KNOTS, 150.0 + np.array([0.0, 100.0, 170.0]))


def months_of_wear(mw_per_month, months, every_days=4):
    """Run a reference over curves and segments of windows of ten days; return it and what came."""
    reference, rng = ReferenceCurve(SETTINGS), np.random.default_rng(1)
    begun = []
    for day in range(10, round(30 * months), every_days):
        now_ns = START_NS + day * DAY_NS
        worn = mw_per_month * (day - 5.0) / 30.0
        found = curve(
            KNOTS, SLOPES, start=150.0 + worn, stderr=2e-4, samples=1000, model_id=f'day {day}',
            source=FittedData(now_ns - 10 * DAY_NS, now_ns, 1, 1, 1000, 540.0, 1.0, False),
            dynamics=(RegionDynamics(100.0, 400.0, 60.0, 5.0, 1.0, 1.0),),
        )  # fmt: skip
        segments = []
        for k, at in enumerate(np.sort(rng.uniform(day - 10.0, day, 80))):
            u, start_ns = rng.uniform(1050.0, 2150.0), START_NS + round(at * DAY_NS)
            mw = float(power_of(u)) + mw_per_month * at / 30.0 + rng.normal(0.0, 0.5)
            segments.append(SpecialSegment(
                k + 1, SegmentKind.STEADY, start_ns, start_ns + 400 * NS_PER_S, 400, u, u, 0.0,
                1.0, mw, mw, 1.0, 540.0,
            ))  # fmt: skip
        reference.judge(found, segments, now_ns, SETTINGS)
        if reference.follow(None, False, now_ns):
            begun.append(now_ns)
        healthy = reference.renewed(found, now_ns, SETTINGS)
        if healthy is not None:
            reference.renew(healthy, segments, now_ns)
    return reference, begun


@pytest.mark.parametrize('mw_per_month', [1.0, -1.0, 0.5])
def test_a_year_of_wear_is_followed_without_an_alarm_and_told(mw_per_month):
    reference, begun = months_of_wear(mw_per_month, 12)
    assert begun == []
    wear = reference.wear
    assert wear.mw_per_month == pytest.approx(mw_per_month, rel=0.2)
    # What is behind is the mean of a window, which is some days old.
    assert wear.total_mw == pytest.approx(11.5 * mw_per_month, rel=0.2)
    assert wear.since_ns - START_NS < MONTH_NS


def test_wear_beyond_its_budget_raises_the_alarm_on_a_shift():
    reference, begun = months_of_wear(-6.0, 6)
    assert begun
    assert reference.alarm.active


def test_a_restored_reference_goes_on_where_it_was():
    reference, _ = months_of_wear(1.0, 3)
    again = ReferenceCurve(SETTINGS)
    again.restore(reference.snapshot())
    assert again.wear == reference.wear
    assert again.curve.model_id == reference.curve.model_id
