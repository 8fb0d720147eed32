# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from naive_stream import NaiveAligner
from streams import START_NS, blocks_of, cuts, examples, needs_jit

from valveflow_ros.parameters import Settings
from valveflow_ros.records import (
    N_SIGNALS,
    NS_PER_S,
    SIGNALS,
    Readings,
    SampleTable,
    table_to_readings,
)
from valveflow_ros.signals.align import REASONS, Aligner
from valveflow_ros.state import from_bytes, to_bytes

GOOD = [50.0, 10.0, 540.0, 200.0, 50.0]
WRONG = [float('nan'), float('inf'), -float('inf'), 1e9, -1e9]
TOPICS = [info.topic for info in SIGNALS]


def rows_of(aligned):
    """Return rows as lists, so that NaN equals NaN."""
    t = aligned.table
    return [
        (int(t.time_ns[k]), [v.hex() for v in t.values[k].tolist()], t.quality[k].tolist())
        for k in range(len(t))
    ]


def naive_rows(rows):
    return [(time, [float(v).hex() for v in values], q) for time, values, q in rows]


def counts_of(naive):
    return {t: {r: naive.counts[t].get(r, 0) for r in REASONS} for t in TOPICS}


def run(settings, rows):
    """Feed everything at once and finish."""
    aligner = Aligner(settings)
    parts = [aligner.feed(Readings.of(rows)), aligner.finish()]
    return SampleTable.concatenate([p.table for p in parts]), aligner


def steady_stream(n, offset_s=(0.0, 0.0, 0.0, 0.0), period_s=1.0, signals=range(4)):
    """Return n rounds of readings; each signal has its own offset in the period."""
    rows = []
    for k in range(n):
        for s in signals:
            time = START_NS + round((k * period_s + offset_s[s]) * NS_PER_S)
            rows.append((time, s, GOOD[s] + 0.01 * k, 0))
    return sorted(rows, key=lambda r: r[0])


STEPS_MS = [0, 0, 1, 40, 137, 250, 333, 500, 900, -1, -300]  # after the reading before
SENT = [0, 0, 1, 1, 2, 2, 3, 3, 4]
LEAPS_S = [0.0, 0.0, 0.7, 3.0, 12.0, -0.5, -4.0, 61.0, 4000.0, -61.0, -9000.0, 3e5, -3e5]
era = st.tuples(st.sampled_from(LEAPS_S), st.integers(1, 60), st.integers(0, 2**32 - 1))


def readings_of(eras):
    """Return readings whose clock leaps from era to era."""
    rows, now = [], START_NS
    for leap_s, n, seed in eras:
        rng = np.random.default_rng(seed)
        now += round(leap_s * NS_PER_S)
        for _ in range(n):
            now += int(rng.choice(STEPS_MS)) * 1_000_000
            signal = int(rng.choice(SENT))
            value = GOOD[signal] + 0.001 * len(rows)
            if rng.random() < 0.05:
                value = float(rng.choice(WRONG))
            rows.append((now, signal, value, int(rng.choice([0, 0, 0, 0, 1, 2]))))
    return rows


rules = st.fixed_dictionaries(
    {
        'sample_period': st.sampled_from([0.1, 1.0, 2.5]),
        'hold_limit': st.sampled_from([2.5, 3.0, 10.0]),
        'lateness': st.sampled_from([0.0, 0.5, 2.0, 7.0]),
        'clock_jump': st.sampled_from([1.0, 10.0, 60.0]),
    }
)


@examples(100)
@given(st.lists(era, min_size=1, max_size=6), rules, st.data())
def test_every_block_gives_what_the_slow_truth_gives(eras, values, data):
    settings = Settings(values)
    rows = readings_of(eras)
    fast, slow = Aligner(settings), NaiveAligner(settings)
    told = resets = 0
    for start, end in blocks_of(len(rows), data.draw(cuts(len(rows)))):
        aligned = fast.feed(Readings.of(rows[start:end]))
        slow.feed(rows[start:end])
        assert rows_of(aligned) == naive_rows(slow.rows[told:])
        assert [told + int(k) for k in aligned.resets] == slow.resets[resets:]
        assert fast.counts() == counts_of(slow)
        told, resets = len(slow.rows), len(slow.resets)
        if data.draw(st.booleans()):
            saved, fast = from_bytes(to_bytes(fast.snapshot())), Aligner(settings)
            fast.restore(saved)
    aligned = fast.finish()
    slow.finish()
    assert rows_of(aligned) == naive_rows(slow.rows[told:])
    assert fast.counts() == counts_of(slow)


@examples(60)
@given(st.lists(era, min_size=1, max_size=4), rules, st.integers(-1000, 1000))
def test_time_shifted_by_whole_periods_gives_the_same_rows_later(eras, values, periods):
    settings = Settings(values)
    shift = periods * round(settings.real('sample_period') * NS_PER_S)
    rows = readings_of(eras)
    here, _ = run(settings, rows)
    there, _ = run(settings, [(r[0] + shift, *r[1:]) for r in rows])
    assert np.array_equal(here.time_ns + shift, there.time_ns)
    assert np.array_equal(here.values, there.values, equal_nan=True)


STRANGE = [-(2**63), -(2**63) + 1, -1, 0, 1, 2**62, 2**63 - 1]
# Stamps, at which places, and for which signals.
AT = START_NS + 20 * NS_PER_S
WILD = [
    ((AT + 86_400 * NS_PER_S, 50, [0]), (AT - 86_400 * NS_PER_S, 90, [0]), (2 * AT, 120, [0])),
    # The values of one wrong instant do not confirm each other.
    ((AT + 5000 * NS_PER_S, 80, range(4)),),
    ((AT + 5000 * NS_PER_S, 80, range(4)), (AT + 5001 * NS_PER_S, 80, range(4))),
    *(((stamp, 60, [0]),) for stamp in STRANGE),
]


@pytest.mark.parametrize('wild', WILD)
def test_wrong_stamps_are_counted_and_change_no_row(wild):
    rows, odd = steady_stream(40), []
    for stamp, place, signals in wild:
        odd += [(place, (stamp, s, GOOD[s], 0)) for s in signals]
    told = list(rows)
    for place, reading in reversed(odd):
        told.insert(place, reading)
    table, aligner = run(Settings(), told)
    expected, _ = run(Settings(), rows)
    assert np.array_equal(table.values, expected.values, equal_nan=True)
    assert sum(c['time_outlier'] for c in aligner.counts().values()) == len(odd)


@examples(30)
@given(st.integers(1, 30), st.integers(0, 2**32 - 1))
def test_a_table_on_the_grid_comes_back_as_it_was(n, seed):
    rng = np.random.default_rng(seed)
    values = np.array(GOOD) + rng.normal(0.0, 0.1, (n, N_SIGNALS))
    table = SampleTable(
        START_NS + np.arange(n) * NS_PER_S, values, np.zeros((n, N_SIGNALS), dtype=np.uint8)
    )
    aligner = Aligner(Settings())
    parts = [aligner.feed(table_to_readings(table)).table, aligner.finish().table]
    back = SampleTable.concatenate(parts)
    assert back.time_ns.tolist() == table.time_ns.tolist()
    assert np.array_equal(back.values, table.values)


# --- hostile --------------------------------------------------------------------------------


@pytest.mark.parametrize('first', STRANGE)
def test_a_strange_first_stamp_neither_hangs_nor_lasts(first):
    """A first stamp has nobody to be compared with; twenty good ones must win."""
    rows = [(first, s, GOOD[s], 0) for s in range(4)] + steady_stream(30)
    table, aligner = run(Settings(), rows)
    assert len(table) < 100
    good = table.time_ns >= START_NS
    assert (good & (table.time_ns < START_NS + 60 * NS_PER_S)).sum() >= 20
    for s, topic in enumerate(TOPICS):
        counts = aligner.counts()[topic]
        assert sum(counts.values()) - counts['late'] == sum(r[1] == s for r in rows)


@needs_jit
def test_more_rows_than_one_call_has_room_for():
    rows = Readings.of(
        [(START_NS + k * NS_PER_S, s, GOOD[s], 0) for k in range(0, 70_000, 5) for s in range(4)]
    )
    table = Aligner(Settings({'sample_period': 1.0})).feed(rows).table
    assert len(table) == 69_996
    assert np.all(np.diff(table.time_ns) == NS_PER_S)
