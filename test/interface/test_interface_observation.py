# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A finished log as the engine sees it, also where its clock goes back."""

import numpy as np
import pytest
from streams import needs_jit

from valveflow_ros.errors import DataError
from valveflow_ros.interface.observation import cut_in_two, observe
from valveflow_ros.parameters import Settings
from valveflow_ros.records import NS_PER_S, Readings, SampleTable, Signal, table_to_readings
from valveflow_ros.signals.align import align_whole

pytestmark = needs_jit


def stairs(hours):
    """Return readings of a valve that rests twenty minutes at each of many openings."""
    t = np.arange(0, int(hours * 3600))
    opening = 40.0 + 5.0 * ((t // 1200) % 9)
    columns = {
        Signal.VALVE_OPENING: opening,
        Signal.MAIN_STEAM_PRESSURE: np.full(len(t), 12.0),
        Signal.MAIN_STEAM_TEMPERATURE: np.full(len(t), 540.0),
        Signal.GENERATED_POWER: 4.0 * opening,
    }
    time_ns = 1_700_000_000 * NS_PER_S + t.astype(np.int64) * NS_PER_S
    return table_to_readings(SampleTable.from_columns(time_ns, columns))


def test_only_what_follows_the_last_step_back_of_the_clock_counts():
    first = stairs(3)
    second = stairs(2)
    joined = Readings(*(
        np.concatenate([getattr(first, name), getattr(second, name)])
        for name in ('time_ns', 'signal', 'value', 'quality')
    ))  # fmt: skip
    watched = observe(joined, Settings({'refit_period': 0.0}))
    alone = observe(second, Settings({'refit_period': 0.0}))
    assert watched.clock_resets == 1
    assert (np.diff(watched.table.time_ns) > 0).all()
    assert len(alone.table) - 30 < len(watched.table) <= len(alone.table)
    assert watched.segments
    assert all(s.end_ns <= watched.table.time_ns[-1] for s in watched.segments)
    inside = {s.start_ns for s in watched.segments}
    assert len(inside) == len(watched.segments), 'no segment of the forgotten rows'


def test_stamps_of_1970_for_a_minute_cost_that_minute():
    true = stairs(2)
    slip = slice(len(true) // 2, len(true) // 2 + 300)
    time_ns = true.time_ns.copy()
    time_ns[slip] -= true.time_ns[0]
    settings = Settings({'refit_period': 0.0})
    wrong = Readings(time_ns, true.signal, true.value, true.quality)
    watched, whole = observe(wrong, settings), observe(true, settings)
    assert watched.clock_resets == 1
    lost = set(whole.table.time_ns.tolist()) - set(watched.table.time_ns.tolist())
    assert 0 < len(lost) <= 80
    assert min(lost) >= true.time_ns[slip][0]
    # What was aligned is found again by its place, as a diagnosis on top of a model needs it.
    rows, resets, _ = align_whole(wrong, settings)
    assert len(resets) == 1
    assert rows.take(watched.rows).time_ns.tolist() == watched.table.time_ns.tolist()


def test_a_log_without_any_reading_is_refused():
    with pytest.raises(DataError, match='The log has no valve_opening; name yours with --column'):
        observe(Readings.of([]), Settings())


def test_the_cut_lies_at_the_border_of_a_block(log):
    first, second = cut_in_two(log, 10.0)
    times = log.readings.time_ns
    assert len(first.readings) + len(second.readings) == len(log.readings)
    assert first.readings.time_ns.max() < second.readings.time_ns.min()
    assert (second.readings.time_ns.min() - times.min()) % 10_000_000_000 == 0
    share = len(first.readings) / len(log.readings)
    assert share == pytest.approx(2.0 / 3.0, abs=0.01)
