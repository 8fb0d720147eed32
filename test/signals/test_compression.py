# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Logs that a historian compressed: detection, holding, and what must not be taken for one."""

import numpy as np
import pytest
from scipy.signal import lfilter

from valveflow_ros.plant.historian import Historian
from valveflow_ros.records import (
    SIGNALS,
    Quality,
    Readings,
    SampleTable,
    Signal,
    table_to_readings,
)
from valveflow_ros.signals.compression import find_compression, held_readings

START_NS = 1_700_000_000_000_000_000
NS = 1_000_000_000
SIZE = {0: 8.0, 1: 2.0, 2: 4.0, 3: 60.0}
LEVEL = {0: 60.0, 1: 14.0, 2: 540.0, 3: 250.0}
DECIMALS = {0: 2, 1: 3, 2: 1, 3: 2}


def signals(seed: int, seconds: int = 100_000) -> dict[str, np.ndarray]:
    """Four signals once a second that wander over their range, with noise and resolution."""
    rng = np.random.default_rng(seed)
    t = np.arange(seconds)
    # Loads that are held for an hour or so, with ramps of ten minutes between them.
    ends = np.cumsum(rng.uniform(2000.0, 6000.0, seconds // 2000))
    knots = np.column_stack([ends, ends + 600.0]).ravel()
    load = np.interp(t, knots, np.repeat(rng.uniform(-1.0, 1.0, len(ends) + 1), 2)[1:-1])
    out = {}
    for info in SIGNALS[:4]:
        s = int(info.signal)
        wander = lfilter([1.0], [1.0, -0.99], rng.normal(0.0, 0.14, seconds))
        x = LEVEL[s] + SIZE[s] * (load + 0.06 * wander + rng.normal(0.0, 0.005, seconds))
        out[info.column] = np.round(x, DECIMALS[s])
    return out


def recorded(seed: int, historian: Historian, **other: np.ndarray) -> Readings:
    """What a historian keeps of `signals`, without the empty cells."""
    columns = signals(seed) | other
    time_ns, kept = historian.record(START_NS, columns, np.random.default_rng(seed))
    table = SampleTable.from_columns(time_ns, {i.signal: kept[i.column] for i in SIGNALS[:4]})
    readings = table_to_readings(table)
    there = np.isfinite(readings.value)
    return Readings(
        readings.time_ns[there], readings.signal[there], readings.value[there],
        readings.quality[there],
    )  # fmt: skip


@pytest.mark.parametrize('seed', [1, 11])
@pytest.mark.parametrize(
    ('kept', 'longest_s'),
    [('compressed', 600), ('compressed:band_percent=0.3,longest_s=900,dropouts_per_day=6', 900)],
)
def test_a_compressed_log_is_told_with_its_bands(seed: int, kept: str, longest_s: float) -> None:
    """Band and longest interval are those of the historian; rows are finer than its scans."""
    historian = Historian.parse(kept)
    found = find_compression(recorded(seed, historian))
    assert found is not None
    assert found.own_times
    band = historian.band_percent / 100.0
    for signal, span in ((Signal.VALVE_OPENING, 100.0), (Signal.GENERATED_POWER, 400.0)):
        if signal in found.updates:
            assert found.updates[signal].dead_band == pytest.approx(band * span, rel=0.1)
    assert 0.9 * longest_s <= found.longest_s <= 1.05 * longest_s
    assert 1.0 <= found.step_s <= 30.0
    assert 'compressed by exception' in found.sentence


def test_rows_that_repeat_the_values_are_told_too() -> None:
    """A compressed log that was exported at even times has the bands of its source."""
    found = find_compression(recorded(4, Historian.parse('compressed:resample_s=10')))
    assert found is not None
    assert (found.own_times, found.step_s) == (False, 10.0)


@pytest.mark.parametrize('seed', [1, 11])
@pytest.mark.parametrize('kept', ['1s', '1s:dropouts_per_day=20', 'minute'])
def test_an_ordinary_log_is_not_taken_for_one(seed: int, kept: str) -> None:
    """Every second, or means of a minute, with gaps or without."""
    assert find_compression(recorded(seed, Historian.parse(kept))) is None


@pytest.mark.parametrize('seed', [1, 11])
def test_rows_missing_at_random_are_no_compression(seed: int) -> None:
    """Irregular gaps alone do not tell: small changes are there."""
    whole = recorded(seed, Historian('1s'))
    rng = np.random.default_rng(seed)
    kept = rng.random(len(whole)) < 0.1
    part = Readings(
        whole.time_ns[kept], whole.signal[kept], whole.value[kept], whole.quality[kept]
    )
    assert find_compression(part) is None


def test_a_coarse_record_is_no_compression() -> None:
    """A record in steps changes by one step at irregular times; its rows are regular."""
    coarse = {name: np.round(2.0 * x) / 2.0 for name, x in signals(1).items()}
    assert find_compression(recorded(1, Historian('1s'), **coarse)) is None


def test_a_clock_that_goes_back_is_no_compression() -> None:
    one = recorded(1, Historian('compressed'))
    two = Readings(
        np.concatenate([one.time_ns, one.time_ns]), np.concatenate([one.signal, one.signal]),
        np.concatenate([one.value, one.value]), np.concatenate([one.quality, one.quality]),
    )  # fmt: skip
    assert find_compression(two) is None


@pytest.mark.parametrize('n', [0, 1, 70])
def test_few_or_equal_times_are_no_compression(n: int) -> None:
    rows = [(START_NS, s, float(k), 0) for k in range(n) for s in range(4)]
    assert find_compression(Readings.of(rows)) is None


def test_held_values_are_the_slow_truth() -> None:
    """Each row holds the last value before it that is not too old, and never one called bad."""
    readings = recorded(5, Historian('compressed', dropouts_per_day=10.0))
    quality = readings.quality.copy()
    quality[2000:2010] = Quality.BAD
    readings = Readings(readings.time_ns, readings.signal, readings.value, quality)
    found = find_compression(readings)
    assert found is not None
    held = held_readings(readings, found)
    assert np.all(np.diff(held.time_ns) >= 0)
    got = {
        (int(t), int(s)): v for t, s, v in zip(held.time_ns, held.signal, held.value, strict=True)
    }
    rng, step_ns = np.random.default_rng(5), round(found.step_s * NS)
    rows = rng.integers(-(-readings.time_ns[0] // step_ns), readings.time_ns[-1] // step_ns, 200)
    for row in (int(r) * step_ns for r in rows):
        for s in range(4):
            last = None
            for k in np.flatnonzero(readings.signal == s):
                if readings.time_ns[k] <= row:
                    last = k
            stands = (
                last is not None
                and row - readings.time_ns[last] <= 1.1 * found.longest_s * NS
                and quality[last] < Quality.BAD
            )
            assert ((row, s) in got) == stands
            if stands:
                assert got[row, s] == readings.value[last]


def test_empty_cells_mean_no_new_value() -> None:
    readings = recorded(6, Historian('compressed'))
    rows = np.unique(readings.time_ns)
    table = np.full((len(rows), 4), np.nan)
    table[np.searchsorted(rows, readings.time_ns), readings.signal] = readings.value
    wide = table_to_readings(
        SampleTable.from_columns(rows, {Signal(s): table[:, s] for s in range(4)})
    )
    found, again = find_compression(readings), find_compression(wide)
    assert found is not None
    assert found == again
    one, two = held_readings(readings, found), held_readings(wide, found)
    for name in ('time_ns', 'signal', 'value'):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
