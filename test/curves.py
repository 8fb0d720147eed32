# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Characteristics and regional models made by hand or drawn: everything in them is known."""

import math

import numpy as np
from hypothesis import strategies as st
from streams import steps_and_ramps

from valveflow_ros.curve.characteristic import (
    Characteristic,
    Choice,
    FittedData,
    Piece,
    RegionDynamics,
    ResidualStatistics,
)
from valveflow_ros.curve.regional_model import RegionalModel

NAN = math.nan


def curve(knots, slopes, jumps=None, start=0.0, stderr=0.01, samples=100, **more):
    """Return a characteristic through ``start`` at the first knot, with jumps at inner knots."""
    pieces, value = [], start
    for k, slope in enumerate(slopes):
        if k and jumps is not None:
            value += jumps[k - 1]
        pieces.append(
            Piece(float(knots[k]), float(knots[k + 1]), float(slope),
                  float(value - slope * knots[k]), stderr, 1.0, samples + k)
        )  # fmt: skip
        value += slope * (knots[k + 1] - knots[k])
    many = range(1, len(slopes) + 1)
    fields = {
        'pressure_exponent': 1.125,
        'pieces': tuple(pieces),
        'breakpoint_intervals': tuple((p.u_from - 5.0, NAN) for p in pieces[1:]),
        'choice': Choice('paper', {j: 3.0 / j for j in many}, dict.fromkeys(many, 0.5), 'why'),
        'source': FittedData(10, 20, 3, 4, 500, 539.5, 2.5, False),
        'residuals': ResidualStatistics(2.5, 0.4, 300.0, 0.7, 0.3),
        'partition_pieces': tuple(pieces),
        'notes': ('one', 'two'),
    }
    return Characteristic(**{**fields, **more})


DYNAMICS = (
    RegionDynamics(0.0, 240.0, 10.0, 3.0, 0.5, NAN),
    RegionDynamics(240.0, 300.0, 80.0, 10.0, 2.0, 1.0),
)


@st.composite
def curves(draw, rising=True, jumps=True):
    pieces = draw(st.integers(1, 6))
    widths = draw(st.lists(st.floats(1.0, 500.0), min_size=pieces, max_size=pieces))
    knots = np.cumsum([draw(st.floats(-100.0, 1500.0)), *widths])
    low = 0.01 if rising else -0.5
    slopes = draw(st.lists(st.floats(low, 0.5), min_size=pieces, max_size=pieces))
    steps = None
    if jumps:
        steps = draw(st.lists(st.one_of(st.just(0.0), st.floats(-60.0, 60.0)),
                              min_size=pieces - 1, max_size=pieces - 1))  # fmt: skip
    return curve(knots, slopes, steps, draw(st.floats(-50.0, 200.0)))


@st.composite
def models(draw, most_pieces=4, most_regions=3, kinks=True):
    pieces = draw(st.integers(1, most_pieces))
    widths = draw(st.lists(st.floats(50.0, 400.0), min_size=pieces, max_size=pieces))
    knots = 1000.0 + np.cumsum([0.0, *widths])
    slopes = np.array(draw(st.lists(st.floats(0.02, 0.3), min_size=pieces, max_size=pieces)))
    right = 100.0 + np.cumsum(slopes * np.diff(knots))
    left = np.concatenate([[100.0], right[:-1]])
    left[1:] += draw(st.lists(st.floats(-5.0, 5.0), min_size=pieces - 1, max_size=pieces - 1))
    # The answer has a kink in the delay at each whole step.
    whole = st.integers(0, 11)
    delay = (
        st.floats(0.0, 12.0) if kinks else st.builds(sum, st.tuples(whole, st.floats(0.1, 0.9)))
    )
    regions = draw(st.integers(1, most_regions))
    span = right[-1] - 100.0
    levels = 100.0 + span * np.arange(1, regions) / regions
    return RegionalModel(
        knots=knots, left=left, right=right, levels=levels,
        time_constants=np.array(
            draw(st.lists(st.floats(1.0, 90.0), min_size=regions, max_size=regions))
        ),
        delays=np.array(
            draw(st.lists(delay, min_size=regions, max_size=regions)), dtype=np.float64
        ),
    )  # fmt: skip


def inputs(model, seed, n=300, noise=3.0):
    rng = np.random.default_rng(seed)
    low, high = model.knots[0] - 50.0, model.knots[-1] + 50.0
    return steps_and_ramps(rng, n, low, high, hold=(20, 60)) + noise * rng.normal(0.0, 1.0, n)


def gaps(seed, n):
    """Return which rows are usable: long stretches and a few gaps."""
    rng = np.random.default_rng(seed)
    usable = np.ones(n, dtype=np.uint8)
    for _ in range(rng.integers(0, 4)):
        at = int(rng.integers(0, n))
        usable[at : at + int(rng.integers(1, 20))] = 0
    return usable
