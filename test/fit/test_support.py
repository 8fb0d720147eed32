# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Which pieces rest on data of their own."""

import dataclasses
import re

import numpy as np
import pytest
from curves import curve
from hypothesis import given
from hypothesis import strategies as st
from streams import examples, grid_ns

from valveflow_ros.curve.characteristic import Piece
from valveflow_ros.fit.result import support_of, with_support
from valveflow_ros.records import SegmentKind
from valveflow_ros.segments.window import WindowContents

NOISE = 0.5
STEADY, SLOPE = int(SegmentKind.STEADY), int(SegmentKind.SLOPE)


def contents(*segments, rows=200):
    """Return a window of segments (u at the start, u at the end, kind), a gap between them."""
    u, spans = [], []
    for begin, end, kind in segments:
        spans.append((len(u), len(u) + rows, kind))
        u += [*np.linspace(begin, end, rows), np.nan]
    nothing = np.zeros(len(u))
    return WindowContents(
        grid_ns(len(u)), np.array(u), nothing, nothing,
        np.array(spans, dtype=np.int64).reshape(-1, 3),
    )  # fmt: skip


def piece(low=1000.0, high=1400.0):
    return Piece(low, high, 0.2, 50.0, 0.001, 1.0, 0)


def judged(*segments, at=None):
    return support_of(at or piece(), contents(*segments), NOISE)


@pytest.mark.parametrize(
    ('segments', 'identifiable'),
    [
        ([], False),
        ([(1200.0, 1200.0, STEADY)], False),
        ([(1200.0, 1200.0, STEADY), (1203.0, 1203.0, STEADY)], False),  # within the noise
        ([(1200.0, 1200.0, STEADY), (1250.0, 1250.0, STEADY)], True),
        ([(1100.0, 1300.0, SLOPE)], True),
        ([(1398.0, 2000.0, SLOPE)], False),  # all but its beginning lies elsewhere
        ([(1500.0, 1500.0, STEADY), (1600.0, 1600.0, STEADY)], False),
        ([(1200.0, 1200.0, STEADY), (1100.0, 1300.0, SLOPE)], True),
    ],
)
def test_two_levels_or_one_ramp_determine_a_line(segments, identifiable):
    assert judged(*segments).identifiable is identifiable


def test_segments_levels_and_samples_are_counted():
    found = judged(
        (1200.0, 1200.0, STEADY), (1201.0, 1201.0, STEADY), (1300.0, 1300.0, STEADY),
        (1350.0, 1450.0, SLOPE), (1600.0, 1600.0, STEADY),
    )  # fmt: skip
    assert (found.steady, found.slope_response) == (3, 1)
    assert found.levels == (1200.0, 1300.0)
    assert found.samples == 3 * 200 + 100


@examples(30)
@given(
    st.lists(
        st.tuples(st.floats(900.0, 1900.0), st.floats(-150.0, 150.0), st.booleans()), max_size=8
    ),
    st.floats(1001.0, 1799.0),
)
def test_pieces_share_all_samples_and_more_data_never_hurt(segments, knot):
    rows = [(u, u + (move if ramp else 0.0), SLOPE if ramp else STEADY)
            for u, move, ramp in segments]  # fmt: skip
    window = contents(*rows)
    left = support_of(piece(700.0, knot), window, NOISE, last=False)
    right = support_of(piece(knot, 2100.0), window, NOISE)
    assert left.samples + right.samples == 200 * len(rows)
    for found, p in ((left, piece(700.0, knot)), (right, piece(knot, 2100.0))):
        assert found.steady + found.slope_response <= len(rows)
        assert found.steady >= len(found.levels)
        if not found.samples:
            assert not found.identifiable
        more = contents(*rows, (p.u_from + 1.0, p.u_to - 1.0, SLOPE))
        assert support_of(p, more, NOISE).identifiable


def test_a_piece_without_data_of_its_own_is_marked_and_says_what_would_help():
    found = curve([1000.0, 1400.0, 1800.0, 2200.0], [0.2, 0.1, 0.05])
    window = contents((1100.0, 1300.0, SLOPE), (1500.0, 1500.0, STEADY))
    told = with_support(found, window, NOISE)
    assert [s.identifiable for s in told.support] == [True, False, False]
    assert told.support[2].samples == 0
    second, third = told.notes[-2:]
    assert second.startswith('Piece 2 (80 to 120 MW) has steady data at one load only, ')
    assert 'operation at about ' in second
    assert re.match(r'Piece 3 \(\d+ to \d+ MW\) has no data in special segments, ', third)
    assert re.search(r'operation at about \d+ MW and one at \d+ MW would', third)
    touched = contents((1000.0, 1408.0, SLOPE))
    (*_, said) = with_support(curve([1000.0, 1400.0, 1800.0], [0.2, 0.1]), touched, NOISE).notes
    assert re.search(r'has no special segment of its own, only \d+ samples? at the ends', said), (
        said
    )
    everywhere = contents(*[(u, u + 90.0, SLOPE) for u in range(1000, 2200, 100)])
    assert with_support(found, everywhere, NOISE).notes == found.notes


@pytest.mark.parametrize(
    ('stderr', 'words'),
    [
        (0.002, 'its slope follows from the pieces beside it'),
        (0.02, 'so its slope is uncertain'),
        (np.nan, 'so its slope is uncertain'),
    ],
)
def test_a_slope_with_a_small_error_is_not_told_as_uncertain(stderr, words):
    whole = curve([1000.0, 1400.0, 1800.0], [0.2, 0.1])
    pieces = tuple(dataclasses.replace(p, slope_stderr=stderr) for p in whole.pieces)
    window = contents((1200.0, 1200.0, STEADY), (1500.0, 1700.0, SLOPE))
    told = with_support(dataclasses.replace(whole, pieces=pieces), window, NOISE).notes
    (said,) = (note for note in told if note.startswith('Piece 1 '))
    assert 'has steady data at one load only' in said
    assert words in said
