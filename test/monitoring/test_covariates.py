# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Covariates in the monitor: held in step with the rows, kept in the window and in its state."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from streams import (
    QUICK_MONITOR,
    START_NS,
    blocks_of,
    cuts,
    examples,
    plant_table,
    table_harms,
    taken_up,
)

from valveflow_ros.errors import DataError, ParameterError
from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.monitoring.offline import CLOCK_BACK, feed_rows
from valveflow_ros.parameters import Settings
from valveflow_ros.records import N_SIGNALS, NS_PER_S, Readings, table_to_readings
from valveflow_ros.signals.align import Aligner, gathered
from valveflow_ros.signals.covariates import Arriving, entries_of, entry, held
from valveflow_ros.state import from_bytes, to_bytes

SETTINGS = Settings(QUICK_MONITOR)
N = 700
VACUUM, AMBIENT = entry('vacuum', 'PT7', 'kPa'), entry('ambient', 'a:b', '')
TWO = (VACUUM, AMBIENT)


def with_two(table, seed=0):
    """Return the table with two covariates, some of their values missing."""
    rng = np.random.default_rng(seed)
    values = rng.normal(0.0, 1.0, (len(table), 2))
    values[rng.random(len(table)) < 0.2, 1] = np.nan
    return replace(table, covariates=values)


def again(monitor, covariates):
    return taken_up(monitor, Monitor(monitor.settings, covariates=covariates))


def seen(monitor):
    """Return the covariates that a diagnosis of the window gets."""
    return monitor._window.contents(covariates=True).covariates


def slowly_held(time_ns, values, row_ns):
    """The slow truth of `held`, for one row."""
    known = [k for k, t in enumerate(time_ns) if t <= row_ns]
    if not known:
        return np.nan
    last = known[-1]
    steps = [time_ns[k] - time_ns[k - 1] for k in range(last - 2, last + 1)] if last > 2 else [0]
    longest = max(300 * NS_PER_S, int(2.5 * sorted(steps)[len(steps) // 2]))
    return values[last] if row_ns - time_ns[last] <= longest else np.nan


@examples(60)
@given(
    st.lists(st.integers(0, 2000), max_size=12),
    st.lists(st.integers(-500, 20_000), min_size=1, max_size=20),
)
def test_a_value_holds_until_the_next_one_but_not_for_ever(steps, rows):
    time_ns = np.cumsum(np.array(steps, dtype=np.int64)) * NS_PER_S
    rows_ns = np.array(rows, dtype=np.int64) * NS_PER_S
    values = np.arange(len(steps), dtype=np.float64)
    expected = [slowly_held(time_ns.tolist(), values, row) for row in rows_ns.tolist()]
    np.testing.assert_array_equal(held(time_ns, values, rows_ns), expected)


class SlowAligner:
    """The slow truth: the signals by an `Aligner` of their own, one reading after the other."""

    def __init__(self):
        self.aligner = Aligner(SETTINGS)
        self.known = [[], []]

    def feed(self, readings):
        """Return the covariates of the rows that the readings close."""
        found = []
        for k in range(len(readings)):
            one = readings.part(k, k + 1)
            number = int(one.signal[0]) - N_SIGNALS
            if number >= 0:
                if np.isfinite(one.value[0]):
                    earlier = [x for x in self.known[number] if x[0] < one.time_ns[0]]
                    self.known[number] = [*earlier, (int(one.time_ns[0]), float(one.value[0]))]
                continue
            for row_ns in self.aligner.feed(one).table.time_ns.tolist():
                columns = [list(zip(*x, strict=True)) or [(), ()] for x in self.known]
                found.append([slowly_held(*column, row_ns) for column in columns])
        return found


def arriving(seed, harms=()):
    """Return readings of a plant and of two covariates, some late, wrong or not finite."""
    rng = np.random.default_rng(seed)
    signals = table_to_readings(plant_table(seed, 300, harms))
    n = 150
    times = START_NS + rng.integers(-20, 400, n) * NS_PER_S // 2
    values = np.where(rng.random(n) < 0.1, np.inf, rng.normal(0.0, 1.0, n))
    places = np.sort(rng.integers(0, len(signals) + 1, n))
    columns = (
        (signals.time_ns, times), (signals.signal, N_SIGNALS + rng.integers(0, 2, n)),
        (signals.value, values), (signals.quality, np.zeros(n)),
    )  # fmt: skip
    return Readings(*(np.insert(a, places, b) for a, b in columns)), signals


@examples(15)
@given(st.integers(0, 2**32 - 1), table_harms(300), cuts(1650), st.integers(0, 1650))
def test_a_value_belongs_to_the_rows_closed_after_it_came_however_the_stream_is_cut(
    seed, harms, places, stop
):
    readings, signals = arriving(seed, harms)
    aligner, blocks = Aligner(SETTINGS, TWO), []
    for start, end in blocks_of(1650, sorted([*places, stop])):
        blocks.append(aligner.feed(readings.part(start, end)))
        if end == stop:
            aligner = taken_up(aligner, Aligner(SETTINGS, TWO))
    found = gathered(blocks)
    plain = Aligner(SETTINGS).feed(signals)
    np.testing.assert_array_equal(found.table.values, plain.table.values)
    np.testing.assert_array_equal(found.table.time_ns, plain.table.time_ns)
    np.testing.assert_array_equal(found.resets, plain.resets)
    expected = np.array(SlowAligner().feed(readings)).reshape(-1, 2)
    np.testing.assert_array_equal(found.table.covariates, expected)


def test_values_that_wait_for_rows_are_bounded_and_a_state_without_them_is_read():
    made = Arriving((VACUUM,))
    for k in range(5000):
        made.take(0, k * NS_PER_S, 1.0)
    (waiting, _) = made.snapshot()[VACUUM]
    assert len(waiting) == 1000
    assert made.at(np.array([4998, 4999]) * NS_PER_S).tolist() == [[1.0], [1.0]]
    assert len(made.snapshot()[VACUUM][0]) == 4
    aligner = Aligner(SETTINGS, TWO)
    aligner.restore(Aligner(SETTINGS).snapshot())
    assert aligner.snapshot()['covariates'] == {VACUUM: [[], []], AMBIENT: [[], []]}
    assert 'covariates' not in Aligner(SETTINGS).snapshot()


@pytest.mark.parametrize(
    ('text', 'sentence'),
    [
        ('vacuum', "entry 'vacuum' is not of the form NAME=TOPIC[:UNIT]."),
        ('a=/x a=/y', 'entry a is given twice.'),
        (' '.join(f'a{k}=/x{k}' for k in range(11)), 'has 11 entries, at most 10.'),
    ],
)
def test_a_wrong_entry_is_refused_as_the_option_refuses_it(text, sentence):
    with pytest.raises(ParameterError) as refused:
        Settings({'covariates': text})
    assert str(refused.value).startswith("Parameter 'covariates' ")
    assert str(refused.value).endswith(sentence)


@examples(10)
@given(cuts(N), st.integers(0, N))
def test_blocks_and_a_restart_change_nothing(places, stop):
    table = with_two(plant_table(1, N))
    whole = Monitor(SETTINGS, covariates=TWO)
    feed_rows(whole, table)
    monitor = Monitor(SETTINGS, covariates=TWO)
    for start, end in blocks_of(N, sorted([*places, stop])):
        feed_rows(monitor, table.part(start, end))
        if end == stop:
            monitor = again(monitor, TWO)
    assert to_bytes(monitor.snapshot()) == to_bytes(whole.snapshot())
    for k, values in enumerate(seen(monitor).values()):
        np.testing.assert_array_equal(values, table.covariates[:, k])


def test_a_clock_set_back_keeps_them_beside_their_rows():
    table = with_two(plant_table(1, N))
    early = with_two(plant_table(2, 50, start_ns=START_NS - 10**15), 1)
    monitor = Monitor(SETTINGS, covariates=TWO)
    feed_rows(monitor, table.part(0, 600))
    monitor.restart(CLOCK_BACK)
    feed_rows(monitor, early)
    monitor = again(monitor, TWO)
    feed_rows(monitor, table.part(600, N))
    np.testing.assert_array_equal(seen(monitor)[VACUUM], table.covariates[:, 0])


def test_a_state_with_other_covariates_keeps_those_with_the_same_entry():
    table = with_two(plant_table(1, N))
    monitor = Monitor(SETTINGS, covariates=TWO)
    feed_rows(monitor, table)
    other = seen(again(monitor, (entry('vacuum', 'PT8', 'kPa'), AMBIENT)))
    assert list(other) == ['vacuum=PT8:kPa', AMBIENT]
    assert np.isnan(other['vacuum=PT8:kPa']).all()
    np.testing.assert_array_equal(other[AMBIENT], table.covariates[:, 1])
    plain, bare = again(monitor, ()), Monitor(SETTINGS)
    feed_rows(bare, plant_table(1, N))
    assert seen(bare) == {}
    assert 'covariates' not in bare.snapshot()['window']
    assert to_bytes(plain.snapshot()) == to_bytes(bare.snapshot())
    assert np.isnan(seen(again(plain, TWO))[VACUUM]).all()


def test_a_change_of_the_parameter_keeps_curve_and_alarms_and_the_same_covariates():
    then = SETTINGS.changed({'covariates': 'vacuum=PT7:kPa'})
    monitor = Monitor(then, covariates=entries_of(then))
    table = plant_table(1, N)
    feed_rows(monitor, replace(table, covariates=table.values[:, :1]))
    now = then.changed({'covariates': 'ambient=t vacuum=PT7:kPa'})
    fresh = Monitor(now, covariates=entries_of(now))
    sentence, _ = fresh.carry(from_bytes(to_bytes(monitor.snapshot())), then)
    assert sentence.startswith('Since the state was saved covariates changed.')
    assert sentence.endswith('The curve and the alarms stay.')
    np.testing.assert_array_equal(seen(fresh)['vacuum=PT7:kPa'], table.values[:, 0])
    assert np.isnan(seen(fresh)['ambient=t:']).all()


@pytest.mark.parametrize('damage', [np.zeros(3), None])
def test_a_damaged_state_is_refused(damage):
    monitor = Monitor(SETTINGS, covariates=TWO)
    feed_rows(monitor, with_two(plant_table(1, N)))
    saved = monitor.snapshot()
    saved['window']['covariates'][VACUUM] = damage
    with pytest.raises((DataError, AttributeError)):
        Monitor(SETTINGS, covariates=TWO).restore(saved)
