# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a historian keeps: means, exceptions, dropouts."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from valveflow_ros.plant.historian import SPANS, Historian, exceptions

START_NS = 1_700_006_400_000_000_000
NAMES = ('valve_opening_percent', 'main_steam_pressure_mpa', 'generated_power_mw')


def signals():
    """Return walks of the size of plant signals."""
    rng = np.random.default_rng(2)
    sizes = dict(zip(NAMES, (0.1, 0.02, 0.4), strict=True))
    return {
        name: 100.0 + size * np.cumsum(rng.standard_normal(7300)) for name, size in sizes.items()
    }


def record(historian):
    """Record the walks."""
    return historian.record(START_NS, signals(), np.random.default_rng(1))


def naive_exceptions(column, scan, phase, band, longest):
    """Keep what a scan finds outside the band, or when the next scan would be too late."""
    kept = [False] * len(column)
    last = None
    for t in range(len(column)):
        if t < phase or (t - phase) % scan:
            continue
        if column[t] != column[t]:
            last = None
            continue
        if (
            last is None
            or column[t] > last[1] + band
            or column[t] < last[1] - band
            or t + scan > last[0] + longest
        ):
            kept[t] = True
            last = (t, column[t])
    return kept


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.one_of(st.integers(-20, 20), st.just(None)), max_size=80),
    st.integers(1, 7), st.integers(0, 6), st.integers(0, 5), st.integers(7, 30),
)  # fmt: skip
def test_the_fast_compression_is_the_slow_one(column, scan, phase, band, longest):
    values = np.array([np.nan if v is None else float(v) for v in column], dtype=np.float64)
    kept = exceptions(values, scan, min(phase, scan - 1), float(band), longest)
    slow = naive_exceptions(values.tolist(), scan, min(phase, scan - 1), float(band), longest)
    assert kept.tolist() == slow


def test_every_second_is_kept_as_it_is():
    time_ns, columns = record(Historian())
    np.testing.assert_array_equal(np.diff(time_ns), 1_000_000_000)
    for name, column in signals().items():
        np.testing.assert_array_equal(columns[name], column)


def test_a_minute_is_the_plain_mean_stamped_at_its_end():
    time_ns, columns = record(Historian('minute'))
    assert len(time_ns) == 121, 'a minute that is not full has no mean'
    for name, column in signals().items():
        for k in range(121):
            mean = sum(column[60 * k : 60 * k + 60].tolist()) / 60.0
            assert columns[name][k] == pytest.approx(mean, rel=1e-12)
            assert time_ns[k] == START_NS + (k + 1) * 60_000_000_000


@pytest.mark.parametrize('band', [0.1, 2.0])
def test_a_scanned_value_lies_within_the_band_of_the_last_one_kept(band):
    historian = Historian('compressed', band_percent=band)
    time_ns, columns = record(historian)
    seconds = (time_ns - START_NS) // 1_000_000_000
    for name, column in signals().items():
        here = np.isfinite(columns[name])
        places, values = seconds[here], columns[name][here]
        np.testing.assert_array_equal(values, column[places])
        gaps = np.diff(places)
        scan = int(np.gcd.reduce(gaps))
        assert scan >= 5
        assert gaps.max() <= 600
        limit = band / 100.0 * SPANS.get(name, 100.0)
        for t in range(int(places[0]), column.size, scan):
            last = values[np.searchsorted(places, t, side='right') - 1]
            assert abs(column[t] - last) <= limit
        # And nothing is kept without a reason.
        steps = np.abs(np.diff(values))
        assert np.all((steps > limit) | (gaps > 600 - scan))
    assert len(time_ns) < 7300 / 2


def test_a_wider_band_keeps_less():
    found = [record(Historian('compressed', band_percent=b))[1] for b in (0.1, 0.5, 2.0)]
    sizes = [np.isfinite(columns[NAMES[2]]).sum() for columns in found]
    assert sizes[0] > sizes[1] > sizes[2] >= 7300 // 600
    assert np.all(np.any([np.isfinite(c) for c in found[1].values()], axis=0)), 'no empty row'


@pytest.mark.parametrize('step', [5, 60])
def test_resampled_rows_hold_the_last_value_kept(step):
    own_ns, own = record(Historian('compressed'))
    time_ns, columns = record(Historian('compressed', resample_s=float(step)))
    np.testing.assert_array_equal(np.diff(time_ns), step * 1_000_000_000)
    for name in NAMES:
        here = np.isfinite(own[name])
        places = np.searchsorted(own_ns[here], time_ns, side='right') - 1
        np.testing.assert_array_equal(columns[name], own[name][here][places])


def test_dropouts_take_values_away_and_change_none():
    lossy = {'dropouts_per_day': 60.0, 'dropout_minutes': 3.0}
    _, columns = record(Historian(**lossy))
    _, minutes = record(Historian('minute', **lossy))
    _, whole_minutes = record(Historian('minute'))
    for name, column in signals().items():
        gone = np.isnan(columns[name])
        assert 0.0 < gone.mean() < 0.5
        np.testing.assert_array_equal(columns[name][~gone], column[~gone])
        blocks = gone[: 121 * 60].reshape(121, 60)
        np.testing.assert_array_equal(np.isnan(minutes[name]), blocks.all(axis=1))
        full = ~blocks.any(axis=1)
        np.testing.assert_array_equal(minutes[name][full], whole_minutes[name][full])
    missing = [np.isnan(columns[name]) for name in NAMES]
    assert not np.array_equal(missing[0], missing[1]), 'each signal drops out by itself'
