"""Characteristics made by hand: everything in them is known."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import strategies as st

from valveflow_ros.curve.characteristic import (
    Characteristic,
    Choice,
    Piece,
    RegionDynamics,
    ResidualStatistics,
    Source,
)

NAN = math.nan


def curve(knots, slopes, jumps=None, start=0.0, **more):
    """Return a characteristic through ``start`` at the first knot, with jumps at inner knots."""
    pieces, value = [], start
    for k, slope in enumerate(slopes):
        if k and jumps is not None:
            value += jumps[k - 1]
        pieces.append(
            Piece(float(knots[k]), float(knots[k + 1]), float(slope),
                  float(value - slope * knots[k]), 0.01, 1.0, 100 + k)
        )  # fmt: skip
        value += slope * (knots[k + 1] - knots[k])
    many = range(1, len(slopes) + 1)
    fields = {
        'pressure_exponent': 1.125,
        'pieces': tuple(pieces),
        'breakpoint_intervals': tuple((p.u_from - 5.0, NAN) for p in pieces[1:]),
        'choice': Choice('paper', {j: 3.0 / j for j in many}, dict.fromkeys(many, 0.5), 'why'),
        'source': Source(10, 20, 3, 4, 500, 539.5, 2.5, False),
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
