# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The study of single loops: what its result says is what the interface says."""

import json
from pathlib import Path

import numpy as np
import pytest
from streams import needs_jit

import valveflow_ros as vf
from benchmarks import refinery_valves as study
from benchmarks.refinery_loops import HE, KANO, simulate_loop
from benchmarks.study import RESULTS

pytestmark = needs_jit


@pytest.mark.parametrize('model', [HE, KANO])
def test_a_loop_is_the_same_for_its_seed_and_sticks_where_it_should(model):
    loop, again = simulate_loop(7, True, model), simulate_loop(7, True, model)
    assert np.array_equal(loop.command, again.command)
    assert loop.truth in ('stiction', 'backlash')
    assert simulate_loop(7, False, model).truth == ''


def test_a_valve_counts_as_the_majority_of_its_decided_windows():
    def majority(*said):
        rows = [
            {'tag': 'tag', 'kind': 'flow', 'sticky': True, 'found': 'x',
             **dict.fromkeys(study.TESTS, one)}
            for one in said
        ]  # fmt: skip
        return study.by_valve(rows)['tag']['verdict']

    assert majority(True, None, None) is True
    assert majority(True, False) is False
    assert majority(None) is None


def test_shares_count_what_is_left_open_as_not_named():
    truth = ((True, True), (True, None), (False, True), (False, False))
    rows = [{'sticky': sticky, **dict.fromkeys(study.TESTS, said)} for sticky, said in truth]
    assert study.scores(rows)['horch'] == {
        'sticky': 2, 'sound': 2, 'found': 0.5, 'falsely_named': 0.5, 'open': 1
    }  # fmt: skip


def test_measured_windows_give_what_the_result_says(shared_data: Path):
    """The level valve that the labels call sticking is not found, which the result says too."""
    place = shared_data / 'refinery_valves'
    if not (place / 'index.csv').is_file():
        pytest.skip(f'no refinery_valves in {shared_data}')
    told = json.loads((RESULTS / 'refinery_valves.json').read_text(encoding='utf-8'))['measured']
    assert (len(told['windows']), len(told['valves'])) == (31, 17)
    for row in told['windows'][::3]:
        found = vf.judge_loop(place / row['file'])
        assert (row['file'], found.judgement.verdict) == (row['file'], row['verdict'])
        if row['gain'] is not None:
            assert found.judgement.gain == pytest.approx(row['gain'], abs=0.3)
    ours = told['per_valve']['verdict']
    assert (ours['falsely_named'], ours['found']) == (0.0, 0.5)
