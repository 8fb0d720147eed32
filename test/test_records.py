# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from streams import START_NS, examples, grid_ns

from valveflow_ros.records import (
    N_SIGNALS,
    Quality,
    Readings,
    SampleTable,
    Signal,
    table_to_readings,
)

value = st.one_of(
    st.floats(-1e3, 1e3), st.sampled_from([float('nan'), float('inf'), -float('inf')])
)


@st.composite
def tables(draw):
    """A table, and the columns and qualities that it is made from, which it may not touch."""
    n = draw(st.integers(0, 12))
    columns, quality = {}, {}
    for signal in draw(st.sets(st.sampled_from(list(Signal)))):
        kind = draw(st.sampled_from([np.float64, np.float32]))
        columns[signal] = np.array(draw(st.lists(value, min_size=n, max_size=n)), dtype=kind)
        columns[signal].setflags(write=False)
        if draw(st.booleans()):
            codes = st.lists(st.integers(0, 2), min_size=n, max_size=n)
            quality[signal] = np.array(draw(codes), dtype=np.uint8)
            quality[signal].setflags(write=False)
    return SampleTable.from_columns(grid_ns(n), columns, quality), columns, quality


@examples(80)
@given(tables())
def test_a_value_is_bad_exactly_where_it_is_nan(made):
    table, columns, quality = made
    assert table.values.shape == table.quality.shape == (len(table), N_SIGNALS)
    assert table.values.dtype == np.float64
    assert np.array_equal(table.quality == Quality.BAD, np.isnan(table.values))
    assert not np.isinf(table.values).any()
    for signal in Signal:
        column = columns.get(signal, np.full(len(table), np.nan))
        codes = quality.get(signal, np.zeros(len(table)))
        good = np.isfinite(column) & (codes < 2)
        assert np.array_equal(table.column(signal)[good], column[good])
        assert np.array_equal(table.quality[good, signal], codes[good])
        assert np.isnan(table.column(signal)[~good]).all()


@examples(60)
@given(tables(), st.integers(0, 12), st.integers(0, 12))
def test_parts_joined_are_the_whole(made, a, b):
    table, _, _ = made
    a, b = sorted((min(a, len(table)), min(b, len(table))))
    parts = [table.part(0, a), table.part(a, b), table.part(b, len(table))]
    joined = SampleTable.concatenate(parts)
    assert np.array_equal(joined.time_ns, table.time_ns)
    assert np.array_equal(joined.values, table.values, equal_nan=True)
    assert np.array_equal(joined.quality, table.quality)
    assert np.shares_memory(parts[0].values, table.values) or a == 0
    assert len(SampleTable.concatenate([])) == 0


@examples(80)
@given(tables())
def test_readings_tell_every_row_and_leave_out_only_absent_optional_values(made):
    table, _, _ = made
    readings = table_to_readings(table)
    expected = [
        (table.time_ns[k], s, table.values[k, s], table.quality[k, s])
        for k in range(len(table))
        for s in (Signal.VALVE_COMMAND, 0, 1, 2, 3)
        if s != Signal.VALVE_COMMAND or np.isfinite(table.values[k, s])
    ]
    got = zip(readings.time_ns, readings.signal, readings.value, readings.quality, strict=True)
    for (t, s, v, q), (et, es, ev, eq) in zip(got, expected, strict=True):
        assert (t, s, q) == (et, es, eq)
        assert v == ev or (np.isnan(v) and np.isnan(ev) and q == Quality.BAD)


def test_readings_from_rows_and_their_parts():
    readings = Readings.of([(START_NS + k, k % 4, float(k), k % 3) for k in range(10)])
    arrays = readings.time_ns, readings.signal, readings.value, readings.quality
    assert [a.dtype.str for a in arrays] == ['<i8', '|i1', '<f8', '|u1']
    part = readings.part(3, 7)
    assert part.value.tolist() == [3.0, 4.0, 5.0, 6.0]
    assert np.shares_memory(part.value, readings.value)
    assert (len(readings), len(Readings.of([]))) == (10, 0)
