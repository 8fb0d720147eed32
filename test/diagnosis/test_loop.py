# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""One control loop: relations that the verdict keeps, what cannot be judged, the single tests."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from streams import needs_jit

from benchmarks.refinery_loops import simulate_loop
from valveflow_ros.diagnosis.loop import detectors, plug
from valveflow_ros.diagnosis.loop.detectors import NO_STICTION, STICTION, UNDECIDED
from valveflow_ros.diagnosis.loop.judge import (
    FAULTS,
    HEALTHY,
    NOT_JUDGED,
    OSCILLATING,
    VERDICTS,
    judge_position,
    judge_response,
)
from valveflow_ros.errors import DataError

pytestmark = needs_jit
STEP_S = 10.0


def naive_plug(command, band, jump):
    """Stick until the pull exceeds (S + J)/2, slip to (S - J)/2: one row after the other."""
    place, out = command[0], []
    for c in command:
        pull = c - place
        if abs(pull) > (band + jump) / 2:
            place = c - np.sign(pull) * (band - jump) / 2
        out.append(place)
    return np.array(out)


def driven(seed, band, jump, rows=700):
    """Return a wandering command, the plug, and a first-order process behind it, with noise."""
    rng = np.random.default_rng(seed)
    t = np.arange(rows)
    command = (
        50 + 3 * np.sin(t / 11) + 2 * np.sin(t / 4.3) + 0.05 * np.cumsum(rng.normal(size=rows))
    )
    place = naive_plug(command, band, jump)
    response, out = 0.0, []
    for p in place:
        response += 0.5 * (p - response)
        out.append(1.5 * response + 0.05 * rng.normal())
    return command, place + 0.03 * rng.normal(size=rows), np.array([0.0, *out[:-1]]) + 20.0


@pytest.fixture(scope='module')
def sticking():
    command, _, response = driven(1, 2.0, 1.2)
    return command, response


# --- from the process value ------------------------------------------------------------------


@pytest.mark.parametrize(('seed', 'band', 'jump'), [(1, 1.0, 0.7), (2, 3.0, 0.0), (3, 2.0, 1.4)])
def test_a_plug_that_stays_behind_is_named_without_a_size(seed, band, jump):
    command, _, response = driven(seed, band, jump)
    found = judge_response(command, response, STEP_S)
    assert 'such as a varying supply pressure, can look the same' in found.reason
    assert (found.verdict, found.sizes) == ('stiction', {})
    assert found.reason.startswith('The valve sticks or has slack')


@pytest.mark.parametrize('seed', range(4))
def test_a_sound_valve_is_not_named(seed):
    command, _, response = driven(seed, 0.0, 0.0)
    found = judge_response(command, response, STEP_S)
    assert found.verdict in (HEALTHY, OSCILLATING)
    assert 'supply pressure' not in found.reason


def test_a_process_that_swings_with_its_set_point_is_blamed_on_neither():
    t = np.arange(700)
    rng = np.random.default_rng(4)
    aim = 20 + np.sin(t / 8)
    command = 50 + 3 * np.sin(t / 8 + 0.4) + 0.02 * rng.normal(size=700)
    response = 20 + np.sin((t - 1) / 8 + 0.4) + 0.02 * rng.normal(size=700)
    found = judge_response(command, response, STEP_S, aim)
    assert found.verdict == OSCILLATING
    assert found.period_s == pytest.approx(2 * np.pi * 8 * STEP_S, rel=0.05)
    assert 'before the loop' in found.reason
    assert 'horch' in found.detections


@settings(max_examples=6)
@given(
    gain=st.floats(0.01, 100.0), sign=st.sampled_from([-1.0, 1.0]), up=st.floats(-1e3, 1e3),
    sense=st.sampled_from([-1.0, 1.0]), over=st.floats(-100.0, 100.0), seed=st.integers(0, 20),
    stuck=st.booleans(),
)  # fmt: skip
def test_units_offsets_and_senses_change_nothing(gain, sign, up, sense, over, seed, stuck):
    loop = simulate_loop(seed, stuck)
    plain = judge_response(loop.command, loop.response, STEP_S)
    other = judge_response(sense * loop.command + over, sign * gain * loop.response + up, STEP_S)
    assert other.verdict == plain.verdict
    assert other.gain == pytest.approx(plain.gain, rel=0.05, abs=0.3, nan_ok=True)


def test_close_rows_are_averaged_behind_the_plug():
    command, _, response = driven(4, 2.0, 1.2)
    found = judge_response(np.repeat(command, 5), np.repeat(response, 5), 1.0)
    assert found.verdict == judge_response(command, response, STEP_S).verdict == 'stiction'


@pytest.mark.parametrize('step_s', [0.01, 1.0])
def test_a_record_of_too_few_seconds_is_not_judged(sticking, step_s):
    found = judge_response(*(a[:400] for a in sticking), step_s)
    assert found.verdict == NOT_JUDGED
    assert '500 s are needed' in found.reason


def test_gaps_of_a_few_rows_are_bridged_and_long_ones_part_the_record(sticking):
    command, response = (a.copy() for a in sticking)
    command[::90], response[40:690:120] = np.nan, np.inf
    assert judge_response(command, response, STEP_S).rows == 699  # the first row is missing
    assert judge_response(command, response, STEP_S).verdict == 'stiction'
    command, response = (a.copy() for a in sticking)
    command[80:90] = np.nan
    found = judge_response(command, response, STEP_S)
    assert found == judge_response(command[90:], response[90:], STEP_S)


def test_a_long_record_is_judged_in_parts():
    command, _, response = driven(5, 2.0, 1.2, rows=2500)
    found = judge_response(command, response, STEP_S)
    assert found.verdict == 'stiction'
    assert found.rows == 2500
    assert '3 of the 3 parts' in found.reason


@pytest.mark.parametrize(
    ('change', 'words'),
    [
        (lambda c, y: (c[:199], y[:199]), 'There are 199 rows'),
        (lambda c, y: (c * np.nan, y), 'There are 0 rows'),
        (lambda c, y: (c * 0 + 50, y), 'The command hardly moves'),
        (lambda c, y: (c, y * 0), 'The process value does not move'),
        (
            lambda c, y: (c, np.where(np.arange(len(y)) < 500, 1.0, y)),
            'The process value has the same',
        ),
        (lambda c, y: (np.minimum(c, 51.0), y), 'The command rests at its end'),
        (lambda c, y: (np.linspace(0, 9, len(c)) + 0.01 * np.sin(c), y), 'The '),
        (lambda c, y: (c, np.random.default_rng(0).normal(size=len(y))), 'The process value does'),
    ],
)
def test_what_cannot_be_judged_says_why(sticking, change, words):
    found = judge_response(*change(*sticking), STEP_S)
    assert found.verdict == NOT_JUDGED
    assert found.reason.startswith(words)
    assert found.reason.endswith('.')
    assert found.sizes == {}


def test_few_swings_are_not_called_sound():
    t = np.arange(400)
    rng = np.random.default_rng(2)
    command = 50 + 4 * np.sin(t / 80) + 0.02 * rng.normal(size=400)
    response = np.concatenate(([50.0], command[:-1])) + 0.05 * rng.normal(size=400)
    found = judge_response(command, response, STEP_S)
    assert found.verdict == NOT_JUDGED
    assert re.search(
        r'had \d reversals? of 20 % [\w ]+; 5 are needed \(3 full swings\)', found.reason
    )


@pytest.mark.parametrize('judge', [judge_response, judge_position])
@pytest.mark.parametrize(
    ('command', 'other', 'step_s', 'words'),
    [
        (np.zeros(5), np.zeros(4), 10.0, 'one length'),
        (np.zeros((5, 2)), np.zeros((5, 2)), 10.0, 'one length'),
        (np.zeros(5), np.zeros(5), 0.0, 'must be positive'),
        (np.zeros(5), np.zeros(5), float('nan'), 'must be positive'),
    ],
)
def test_wrong_input_is_a_sentence(judge, command, other, step_s, words):
    with pytest.raises(DataError, match=words):
        judge(command, other, step_s)


# --- from the position -----------------------------------------------------------------------


@pytest.mark.parametrize(('rows', 'sense'), [(300, 1.0), (700, -1.0)])
@pytest.mark.parametrize(
    ('band', 'jump', 'name', 'sizes'),
    [
        (0.0, 0.0, HEALTHY, {}),
        (2.0, 0.0, 'backlash', {'w_percent': 2.0}),
        (2.0, 1.8, 'stiction', {'s_percent': 2.0, 'j_percent': 1.8}),
    ],
)
def test_a_position_tells_fault_and_sizes(rows, sense, band, jump, name, sizes):
    command, position, _ = driven(3, band, jump, rows)
    found = judge_position(command, sense * position + (100 if sense < 0 else 0), STEP_S)
    assert found.verdict == name
    assert set(found.sizes) == set(sizes)
    for key, truth in sizes.items():
        size = found.sizes[key]
        assert size['value'] == pytest.approx(truth, abs=0.15)
        assert size['low'] <= size['value'] <= size['high']
        assert size['unit'] == '%'


def test_a_position_as_a_fraction_is_the_same_valve():
    command, position, _ = driven(3, 2.0, 0.0)
    whole = judge_position(command, position, STEP_S)
    part = judge_position(command, position / 100.0, STEP_S)
    assert part.verdict == whole.verdict == 'backlash'
    assert part.sizes['w_percent']['value'] == pytest.approx(whole.sizes['w_percent']['value'])


def test_a_valve_at_its_stop_is_not_called_loose():
    command, _, _ = driven(3, 0.0, 0.0)
    noise = 0.03 * np.random.default_rng(1).normal(size=700)
    found = judge_position(command, np.minimum(command, 51.0) + noise, STEP_S)
    assert found.verdict == NOT_JUDGED
    assert 'does not open beyond 51' in found.reason


def test_a_position_that_stands_is_no_sound_valve():
    command, _, _ = driven(3, 0.0, 0.0)
    dead = judge_position(command, np.full(700, 31.0), STEP_S)
    stuck = judge_position(command, 31 + 0.01 * np.random.default_rng(1).normal(size=700), STEP_S)
    assert dead.verdict == stuck.verdict == NOT_JUDGED
    assert 'does not move' in dead.reason
    assert 'hardly follows' in stuck.reason


# --- simulated loops -------------------------------------------------------------------------


def test_sound_loops_are_rarely_named_and_sticking_ones_often():
    said = {
        stuck: [
            judge_response(x.command, x.response, STEP_S).verdict
            for x in (simulate_loop(seed, stuck) for seed in range(7000, 7015))
        ]
        for stuck in (False, True)
    }
    assert {v for some in said.values() for v in some} <= set(VERDICTS)
    assert sum(v in FAULTS for v in said[False]) <= 2
    assert sum(v in FAULTS for v in said[True]) >= 6


# --- the single tests ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ('degrees', 'answer'), [(90, STICTION), (-85, STICTION), (180, NO_STICTION), (135, UNDECIDED)]
)
def test_horch_reads_the_phase(degrees, answer):
    t = np.arange(2000) / 50.0 * 2 * np.pi
    assert detectors.horch(np.sin(t), np.sin(t + np.radians(degrees))).answer == answer


def test_correlation_is_its_definition():
    rng = np.random.default_rng(5)
    u, y = rng.normal(size=40), rng.normal(size=40)
    a, b = u - u.mean(), y - y.mean()
    for lag in range(-39, 40):
        pairs = [(t, t + lag) for t in range(40) if 0 <= t + lag < 40]
        slow = sum(a[i] * b[j] for i, j in pairs) / (40 * u.std() * y.std())
        assert detectors.correlation(u, y)[39 + lag] == pytest.approx(slow, abs=1e-12)


@pytest.mark.parametrize('turn', [20.0, 37.0, 111.0])
def test_the_period_of_a_sine_is_found_and_noise_has_no_regular_one(turn):
    t = np.arange(1500)
    rng = np.random.default_rng(1)
    found = detectors.oscillation(np.sin(2 * np.pi * t / turn) + 0.3 * rng.normal(size=1500))
    assert found.period == pytest.approx(turn, rel=0.03)
    assert found.regularity > 1.0


def test_he_tells_a_triangle_from_a_sine():
    t = np.arange(1200) / 100.0
    sine, triangle = np.sin(2 * np.pi * t), 2 * np.abs(2 * (t % 1.0) - 1) - 1
    assert detectors.he(sine).answer == NO_STICTION
    assert detectors.he(triangle).answer == STICTION
    assert detectors.he(np.zeros(1200)).answer == UNDECIDED


def test_yamashita_sees_a_flow_that_stands_while_the_command_travels():
    t = np.arange(1200)
    triangle = np.abs(t % 100 - 50.0)
    square = np.where(triangle > 25, 1.0, -1.0) + 1e-6 * t
    # The normalised steps of a plain triangle are all of one size; a wave on it makes some large.
    command = triangle + 5 * np.sin(2 * np.pi * t / 100)
    assert detectors.yamashita(command, square, 100.0).answer == STICTION
    assert detectors.yamashita(command, command, 100.0).answer == NO_STICTION


def naive_past(series, spans):
    return np.array(
        [
            [np.mean([series[t - k] for k in range(a, b + 1)]) for a, b in spans]
            for t in range(plug.MEMORY, len(series))
        ]
    )


def test_the_evidence_is_that_of_plain_least_squares(sticking):
    command, response = (a[:300] for a in sticking)
    inner = plug.PlugScore(command, response)
    band, jump = 0.25, 0.15
    y = (response - response.mean()) / response.std()
    t = y[plug.MEMORY :]
    own = np.column_stack([np.ones(len(t)), naive_past(y, plug.OWN)])
    scaled = (command - command.mean()) / inner.span
    path = naive_plug(scaled, band, jump)
    x, place = naive_past(scaled, plug.COMMAND), naive_past(path, plug.PLUG)

    def left(*tables):
        table = np.column_stack(tables)
        return t - table @ np.linalg.lstsq(table, t, rcond=None)[0]

    edges = np.linspace(0, len(t), 13).astype(int)[1:-1]
    before, after = (
        np.array([float(p @ p) for p in np.split(r, edges)])
        for r in (left(own, x), left(own, x, place))
    )
    kept = np.argsort(before - after)[:-1]
    alone, direct, none = (float(r @ r) for r in (left(own, place), left(own, x), left(own)))
    travel = 0.5 * len(t) * np.log(none / alone) - 0.5 * len(y) * np.log(none / direct)
    gain = 0.5 * len(t) * 11 / 12 * np.log(before[kept].sum() / after[kept].sum())
    tried = inner.tried(band, jump, 0.0)
    assert tried.travel == pytest.approx(travel, rel=0.01)
    assert tried.gain == pytest.approx(gain + 0.2 * min(0.0, travel), rel=0.01)
