# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Samples from changes: which value counts when, what is bad, and stamps that never go back."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from opcua_server import mapping, write_mapping

from valveflow_ros.opcua.mapping import read_mapping_file
from valveflow_ros.opcua.sampler import Change, Sampler
from valveflow_ros.records import NS_PER_S, Quality

S, T0 = NS_PER_S, 1_700_000_000 * NS_PER_S
GOOD, UNCERTAIN, BAD = (int(q) for q in Quality)


@pytest.fixture(scope='module')
def unit(tmp_path_factory):
    folder = tmp_path_factory.mktemp('mapping')
    return read_mapping_file(write_mapping(folder, mapping(1, period=1.0))).units[0]


@pytest.fixture
def sampler(unit):
    made = Sampler(unit, T0)
    made.take([Change(s, T0, T0, 10.0 + s, GOOD) for s in range(4)], T0)
    return made


def power(samples):
    return [(x.time_ns - T0) / S for x in samples], [x.values[3] for x in samples]


def test_a_value_counts_from_its_own_time(sampler):
    sampler.take([Change(3, T0 + S, T0 + S, 1.0, GOOD)], T0 + S)
    sampler.take([Change(3, T0 + S + 1, T0 + 2 * S, 2.0, GOOD)], T0 + 2 * S)
    assert power(sampler.due(T0 + 2 * S)) == ([1.0, 2.0], [1.0, 2.0])


def test_an_unchanged_value_holds_while_the_server_confirms_it(sampler):
    sampler.take([], T0 + 3 * S)
    samples = sampler.due(T0 + 3 * S)
    assert power(samples) == ([1.0, 2.0, 3.0], [13.0] * 3)
    assert {code for x in samples for code in x.quality[:4]} == {GOOD}
    # A signal that is not mapped is left alone.
    assert samples[0].quality[4] is None


def test_without_confirmation_a_sample_waits_and_is_bad_then(sampler):
    assert sampler.due(T0 + 2 * S) == []
    (sample,) = sampler.due(T0 + 3 * S)
    assert math.isnan(sample.values[3])
    assert sample.quality[:4] == [BAD] * 4
    assert sampler.unconfirmed == 1
    # The server goes on: only what was sent is bad.
    sampler.take([], T0 + 3 * S)
    assert power(sampler.due(T0 + 3 * S)) == ([2.0, 3.0], [13.0, 13.0])


def test_after_an_outage_nothing_counts_before_it_was_read(sampler):
    sampler.lose()
    sampler.restore([], T0 + 2 * S + 1)
    # The value itself is old: who knows what it was meanwhile.
    sampler.take([Change(3, T0, T0 + 2 * S, 9.0, GOOD)], T0 + 3 * S)
    samples = sampler.due(T0 + 3 * S)
    assert [x.quality[3] for x in samples] == [BAD, BAD, GOOD]
    assert [x.quality[0] for x in samples] == [BAD] * 3
    assert samples[-1].values[3] == 9.0


def test_history_fills_the_samples_that_still_wait(sampler):
    sampler.lose()
    history = [Change(3, T0 + k * S, 0, float(k), GOOD) for k in range(3)]
    sampler.restore(history, T0 + 2 * S + 1)
    sampler.take([Change(3, T0 + 2 * S, T0 + 3 * S, 2.0, GOOD)], T0 + 3 * S)
    assert power(sampler.due(T0 + 3 * S)) == ([1.0, 2.0, 3.0], [1.0, 2.0, 2.0])
    assert sampler.counts[3].went_back == 0


def test_odd_stamps_are_counted_and_a_future_one_is_uncertain(sampler):
    """Odd values: `test_odd_values_are_counted_and_have_their_quality` of the link."""
    odd = ((T0 + 3600 * S, 'future', UNCERTAIN), (T0 - S, 'went_back', GOOD),
           (0, 'without_time', GOOD))  # fmt: skip
    for k, (source_ns, name, quality) in enumerate(odd, 1):
        sampler.take([Change(3, source_ns, T0 + k * S, 5.0, GOOD)], T0 + k * S)
        (sample,) = sampler.due(T0 + k * S)
        assert getattr(sampler.counts[3], name) == 1
        assert (sample.values[3], sample.quality[3]) == (5.0, quality)


def test_a_machine_that_slept_does_not_send_a_day_at_once(sampler):
    samples = sampler.due(T0 + 86400 * S)
    assert 590 < len(samples) <= 601


@given(
    st.lists(
        st.one_of(
            st.tuples(st.just('take'), st.integers(0, 3), st.integers(-5000, 9000)),
            st.tuples(st.sampled_from(['lose', 'restore', 'due']), st.just(0), st.just(0)),
            st.tuples(st.just('wait'), st.just(0), st.integers(0, 4000)),
        ),
        max_size=40,
    )
)  # fmt: skip
def test_stamps_are_the_grid_and_never_go_back(unit, acts):
    sampler, now_ns, stamps = Sampler(unit, T0), T0, []
    for act, signal, ms in acts:
        if act == 'take':
            source_ns = max(1, now_ns + ms * 1_000_000)
            sampler.take([Change(signal, source_ns, now_ns, 1.0, GOOD)], now_ns)
        elif act == 'wait':
            now_ns += ms * 1_000_000
        elif act == 'due':
            stamps += [x.time_ns for x in sampler.due(now_ns)]
        elif act == 'lose':
            sampler.lose()
        else:
            sampler.restore([], now_ns)
    stamps += [x.time_ns for x in sampler.due(now_ns + 10 * S)]
    assert stamps == list(range(T0 + S, T0 + S + S * len(stamps), S))
    assert all(t <= now_ns + 10 * S for t in stamps)
