# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What judges the project's speed, judged by what must hold of any judge."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.regression.judge import LEAST_PAIRS, LIMIT, judge, table

seconds = st.floats(0.01, 100.0)
pairs = st.lists(st.tuples(seconds, seconds), min_size=LEAST_PAIRS, max_size=15)
# Each pair at the machine's pace of the moment, with its own jitter of up to 10 %.
uneven = st.lists(st.tuples(seconds, st.floats(0.9, 1.1)), min_size=LEAST_PAIRS, max_size=15)


# --- speed ----------------------------------------------------------------------------------


@given(uneven)
def test_equal_trees_pass_and_forty_percent_do_not_at_any_pace(
    times: list[tuple[float, float]],
) -> None:
    same, slow = judge(
        {
            'same': [(pace, jitter * pace) for pace, jitter in times],
            'slow': [(pace, 1.4 * jitter * pace) for pace, jitter in times],
        }
    )
    assert (same.slower, slow.slower) == (False, True)


@given(pairs, st.floats(0.01, 100.0))
def test_a_faster_machine_changes_no_verdict(
    times: list[tuple[float, float]], pace: float
) -> None:
    (one,) = judge({'work': times})
    (other,) = judge({'work': [(pace * base, pace * here) for base, here in times]})
    assert other.ratio == pytest.approx(one.ratio)
    assert one.low <= one.ratio <= one.high


@given(st.lists(st.tuples(seconds, seconds), min_size=LEAST_PAIRS, max_size=15))
def test_the_trees_changed_round_turn_the_ratio_round(times: list[tuple[float, float]]) -> None:
    odd = times[: len(times) - 1 + len(times) % 2]
    if len(odd) < LEAST_PAIRS:
        odd = times[:LEAST_PAIRS]
    (one,) = judge({'work': odd})
    (other,) = judge({'work': [(here, base) for base, here in odd]})
    assert other.ratio == pytest.approx(1.0 / one.ratio)


def test_three_disturbed_pairs_of_seven_change_nothing_and_four_do() -> None:
    quiet, disturbed = (1.0, 1.0), (1.0, 9.0)
    for many, slower in ((3, False), (4, True)):
        (found,) = judge({'work': [disturbed] * many + [quiet] * (7 - many)})
        assert found.slower == slower


def test_the_limit_itself_passes_and_the_table_names_what_does_not() -> None:
    found = judge({'at it': [(1.0, LIMIT)] * 7, 'over it': [(1.0, LIMIT + 0.01)] * 7})
    assert [v.slower for v in found] == [False, True]
    marked = [line.split()[0] for line in table(found).splitlines() if 'SLOWER' in line]
    assert marked == ['over']


@pytest.mark.parametrize(
    'times', [[(1.0, 1.0)] * 6, [(0.0, 1.0)] * 7, [(1.0, float('nan'))] * 7, []]
)
def test_nothing_is_judged_by_too_little(times: list[tuple[float, float]]) -> None:
    with pytest.raises(ValueError, match='work: '):
        judge({'work': times})
