# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What judges the project's speed, judged by what must hold of any judge; all programs load."""

import importlib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.regression import LEAST_PAIRS, LIMIT, judge, table

seconds = st.floats(0.01, 100.0)
pairs = st.lists(st.tuples(seconds, seconds), min_size=LEAST_PAIRS, max_size=15)
# Each pair at the machine's pace of the moment, with its own jitter of up to 10 %.
uneven = st.lists(st.tuples(seconds, st.floats(0.9, 1.1)), min_size=LEAST_PAIRS, max_size=15)


@given(uneven)
def test_equal_trees_pass_and_forty_percent_do_not_at_any_pace(times) -> None:
    same = [(pace, jitter * pace) for pace, jitter in times]
    slow = [(base, 1.4 * here) for base, here in same]
    found = judge({'same': same, 'slow': slow})
    assert [v.slower for v in found] == [False, True]
    marked = [line.split()[0] for line in table(found).splitlines() if 'SLOWER' in line]
    assert marked == ['slow']


@given(pairs, st.floats(0.01, 100.0))
def test_a_faster_machine_changes_no_verdict_and_trees_changed_round_turn_it(times, pace) -> None:
    odd = times[: len(times) - 1 + len(times) % 2] if len(times) > LEAST_PAIRS else times
    one, other, turned = judge({
        'one': odd, 'other': [(pace * base, pace * here) for base, here in odd],
        'turned': [(here, base) for base, here in odd],
    })  # fmt: skip
    assert other.ratio == pytest.approx(one.ratio)
    assert turned.ratio == pytest.approx(1.0 / one.ratio)
    assert one.low <= one.ratio <= one.high


def test_three_disturbed_pairs_of_seven_change_nothing_and_four_do_nor_does_the_limit() -> None:
    for many, of, slower in ((3, 9.0, False), (4, 9.0, True), (7, LIMIT, False)):
        (found,) = judge({'work': [(1.0, of)] * many + [(1.0, 1.0)] * (7 - many)})
        assert found.slower == slower


@pytest.mark.parametrize(
    'times', [[(1.0, 1.0)] * 6, [(0.0, 1.0)] * 7, [(1.0, float('nan'))] * 7, []]
)
def test_nothing_is_judged_by_too_little(times) -> None:
    with pytest.raises(ValueError, match='work: '):
        judge({'work': times})


def test_every_program_finds_what_it_imports() -> None:
    root = Path(__file__).resolve().parents[2]
    paths = sorted((root / 'benchmarks').rglob('*.py'))
    assert len(paths) > 40
    for path in paths:
        if path.stem not in ('__init__', '__main__'):
            importlib.import_module('.'.join(path.relative_to(root).with_suffix('').parts))
