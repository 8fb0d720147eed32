# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Characteristics and data made by hand: everything in them is known."""

import math

import curves
import numpy as np
import pytest

from valveflow_ros.baselines.judged import OtherData
from valveflow_ros.curve.characteristic import RegionDynamics
from valveflow_ros.fit.problem import Samples
from valveflow_ros.records import NS_PER_S, SegmentKind

KNOTS = (1000.0, 1400.0, 1800.0, 2200.0)
SLOPES = (0.2, 0.1, 0.05)
FIRST_MW = 150.0
ROWS, SEGMENT = 12_000, 400


def characteristic(shift_mw=0.0, exponent=1.125, dynamics=False):
    """Return a curve of three pieces, lifted by ``shift_mw``."""
    region = RegionDynamics(100.0, 400.0, 20.0, 2.0, math.nan, math.nan)
    return curves.curve(
        KNOTS, SLOPES, start=FIRST_MW + shift_mw, stderr=0.001, samples=1000,
        pressure_exponent=exponent, dynamics=(region,) if dynamics else (),
    )  # fmt: skip


def other_data(noise_mw=1.0, seed=7, shift_mw=0.0, above=9e9, u_shift=0.0):
    """Return rests at many loads, all of them special segments, one in three called a slope.

    ``shift_mw`` is added to the power where u is beyond ``above``.
    """
    rng = np.random.default_rng(seed)
    levels = 1050.0 + 1100.0 * rng.random(ROWS // SEGMENT)
    u = np.repeat(levels, SEGMENT) + rng.normal(0.0, 0.5, ROWS)
    power = characteristic().model.static(u) + rng.normal(0.0, noise_mw, ROWS)
    power = power + shift_mw * (u > above)
    first = np.arange(0, ROWS, SEGMENT)
    kinds = np.where(np.arange(len(first)) % 3 == 2, SegmentKind.SLOPE, SegmentKind.STEADY)
    spans = np.column_stack([first + 50, first + SEGMENT, kinds]).astype(np.int64)
    samples = Samples(u + u_shift, power, np.ones(ROWS, dtype=np.uint8), 1.0, 20.0, 10)
    return OtherData(samples, np.arange(ROWS, dtype=np.int64) * NS_PER_S, spans)


@pytest.fixture(scope='session')
def curve():
    return characteristic


@pytest.fixture(scope='session')
def data():
    return other_data
