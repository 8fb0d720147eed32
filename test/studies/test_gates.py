"""What judges the project's speed and its tests, judged by what must hold of any judge."""

from __future__ import annotations

import ast
from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.mutation.__main__ import ROOT, TESTS, files_for
from benchmarks.mutation.equivalents import TABLE
from benchmarks.mutation.sites import mutants, mutated
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


# --- mistakes made on purpose ---------------------------------------------------------------


@pytest.mark.parametrize('module', ['state', 'logs/mcap/chunk_file'])
def test_every_mistake_is_another_program_and_there_is_one(module: str) -> None:
    source = (ROOT / f'valveflow_ros/{module}.py').read_text('utf-8')
    found = list(mutants(module, source))
    texts = Counter(mutated(source, mutant.index) for mutant in found)
    assert set(texts.values()) == {1}
    assert ast.unparse(ast.parse(source)) + '\n' not in texts


@pytest.mark.parametrize('module', TESTS)
def test_every_mistake_has_a_name_of_its_own_and_tests_that_look_for_it(module: str) -> None:
    found = mutants(module, (ROOT / module).read_text('utf-8'))
    names = Counter((m.function, m.before, m.after, m.nth) for m in found)
    assert set(names.values()) == {1}
    assert files_for(module) == list(TESTS[module])


def test_every_equivalent_mistake_can_be_made_and_has_a_reason() -> None:
    """Who changes a line judges its mistakes anew."""
    possible = {
        (
            m.module.removeprefix('valveflow_ros/').removesuffix('.py'),
            m.function,
            m.before,
            m.after,
        )
        for module in TESTS
        for m in mutants(module, (ROOT / module).read_text('utf-8'))
    }
    for known in TABLE:
        assert len(known.reason.split()) >= 5
        assert (known.module, known.function, known.before, known.after) in possible, known
