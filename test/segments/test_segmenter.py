# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from naive_stream import NaiveSegmenter
from streams import (
    blocks_of,
    cuts,
    examples,
    frozen,
    grid_ns,
    lagged,
    needs_jit,
    simulated,
    steps_and_ramps,
)

from valveflow_ros.parameters import Settings
from valveflow_ros.records import NS_PER_S, SegmentKind, Signal
from valveflow_ros.segments.kernel import TRANSIENT
from valveflow_ros.segments.segmenter import Segmenter

# Seconds instead of minutes, so that a few hundred rows hold many segments.
QUICK = {
    'block': 1.0,
    'time_constant': 2.0,
    'delay': 1.0,
    'steady_min': 6.0,
    'slope_min': 6.0,
    'longest_segment': 60.0,
    'input_noise': 1.0,
    'power_noise': 0.3,
}
SETTLE = 11


@dataclasses.dataclass
class Stream:
    time_ns: np.ndarray
    u: np.ndarray
    power: np.ndarray
    temperature: np.ndarray

    def __len__(self):
        return len(self.u)

    def part(self, start, end):
        return [a[start:end] for a in (self.time_ns, self.u, self.power, self.temperature)]


def given_by_the_segmenter(segment):
    """Return a segment's values but for those that the window adds."""
    added = {'opening_start_percent', 'opening_end_percent', 'pressure_start_mpa',
             'pressure_end_mpa', 'exponent'}  # fmt: skip
    return [v for k, v in dataclasses.asdict(segment).items() if k not in added]


def plant(seed, n, noise=0.5, hold=(30, 90)):
    """Holds and ramps with a little noise; power follows with the lag of `QUICK`."""
    rng = np.random.default_rng(seed)
    u = steps_and_ramps(rng, n, hold=hold)
    x = lagged(0.1 * u + 20.0, 2.0, 1.0)
    return Stream(
        grid_ns(n),
        u + noise * rng.normal(0.0, 1.0, n),
        x + 0.3 * noise * rng.normal(0.0, 1.0, n),
        540.0 + rng.normal(0.0, 0.2, n),
    )


KINDS = ['nan_u', 'nan_power', 'inf', 'nan_temperature', 'leap', 'back']
harm = st.lists(
    st.tuples(st.sampled_from(KINDS), st.integers(0, 599), st.integers(1, 40)), max_size=6
)


def harmed(stream, harms):
    s = Stream(*(a.copy() for a in stream.part(0, len(stream))))
    for what, at, length in harms:
        if at >= len(s):
            continue
        end = min(at + length, len(s))
        if what == 'nan_u':
            s.u[at:end] = np.nan
        elif what == 'nan_power':
            s.power[at:end] = np.nan
        elif what == 'inf':
            s.u[at] = np.inf
            s.power[end - 1] = -np.inf
        elif what == 'nan_temperature':
            s.temperature[at:end] = np.nan
        elif what == 'leap':
            s.time_ns[at:] += length * NS_PER_S
        else:
            s.time_ns[at:] -= length * NS_PER_S
    return s


def whole(settings, stream):
    segmenter = Segmenter(settings)
    out = segmenter.feed(*stream.part(0, len(stream)))
    return out, segmenter


def spans(found):
    return [(f.first_row, f.end_row, int(f.segment.kind)) for _, f in found]


@examples(40)
@given(
    st.integers(0, 2**32 - 1), st.integers(1, 600), harm, st.sampled_from([1.0, 3.0]),
    st.booleans(), st.data(),
)  # fmt: skip
def test_every_block_gives_what_the_slow_truth_gives(seed, n, harms, block, given_noise, data):
    values = {**QUICK, 'block': block}
    if not given_noise:
        values |= {'input_noise': 0.0, 'power_noise': 0.0}
    settings = Settings(values)
    stream = harmed(plant(seed, n), harms)
    fast, slow = Segmenter(settings), NaiveSegmenter(settings)
    told = 0
    for start, end in blocks_of(n, data.draw(cuts(n))):
        out = fast.feed(*stream.part(start, end))
        slow.feed(*stream.part(start, end))
        assert out.rows == end - start
        assert out.kinds.tolist() == slow.kinds[start:end]
        fresh = slow.segments[told:]
        assert [f.segment.number for _, f in out.found] == [
            told + 1 + k for k in range(len(fresh))
        ]
        for (_, f), truth in zip(out.found, fresh, strict=True):
            assert (f.first_row, f.end_row, f.segment.kind) == (
                truth['first_row'], truth['end_row'], truth['kind'],
            )  # fmt: skip
            assert f.segment.samples == f.end_row - f.first_row
            assert f.segment.start_ns == stream.time_ns[f.first_row]
            assert f.segment.end_ns == stream.time_ns[f.end_row - 1]
            for name in ('u_start', 'u_end', 'u_rms', 'u_rate_per_s', 'power_start_mw',
                         'power_end_mw', 'power_rms_mw'):  # fmt: skip
                assert getattr(f.segment, name) == pytest.approx(truth[name], rel=1e-7, abs=1e-7)
            warm = stream.temperature[f.first_row : f.end_row]
            assert f.segment.temperature_mean_degc == pytest.approx(
                truth['temperature_mean_degc'],
                abs=1e-7 if np.isfinite(warm).all() else 0.5,
                nan_ok=True,
            )
        told = len(slow.segments)
        if given_noise or len(slow.stretches):
            noise = fast.noise()
            assert (noise.input, noise.power_mw) == pytest.approx(slow.noise(), rel=1e-9)
            assert given_noise or noise.learnt == (len(slow.stretches) >= 4)


@examples(40)
@given(st.integers(0, 2**32 - 1), harm, st.data())
def test_any_cutting_gives_the_same_bits(seed, harms, data):
    settings = Settings(QUICK)
    stream = harmed(plant(seed, 600), harms)
    expected, _ = whole(settings, stream)
    segmenter = Segmenter(settings)
    kinds, found = [], []
    for start, end in blocks_of(600, data.draw(cuts(600, most=25))):
        at = start
        while True:
            out = segmenter.feed(*stream.part(at, end), most=data.draw(st.sampled_from([None, 1])))
            found += [(at + row, f) for row, f in out.found]
            kinds += out.kinds.tolist()
            at += out.rows
            if at >= end and not (out.found and out.rows == 0):
                break
    assert kinds == expected.kinds.tolist()
    assert [frozen(f) for f in found] == [frozen(f) for f in expected.found]


@examples(20)
@given(
    st.integers(0, 2**32 - 1), harm, st.sampled_from([-900.0, 64.0, 1e6]),
    st.sampled_from([-150.0, 1024.0]),
)  # fmt: skip
def test_shifting_u_or_power_moves_no_segment(seed, harms, more_u, more_power):
    stream = harmed(plant(seed, 600), harms)
    there = Stream(
        stream.time_ns, stream.u + more_u, stream.power + more_power, stream.temperature
    )
    here, _ = whole(Settings(QUICK), stream)
    shifted, _ = whole(Settings(QUICK), there)
    assert spans(here.found) == spans(shifted.found)
    assert here.kinds.tolist() == shifted.kinds.tolist()
    for (_, a), (_, b) in zip(here.found, shifted.found, strict=True):
        assert b.segment.u_start == pytest.approx(a.segment.u_start + more_u, abs=1e-6)
        assert b.segment.u_rms == pytest.approx(a.segment.u_rms, abs=1e-5)
        assert b.segment.power_end_mw == pytest.approx(
            a.segment.power_end_mw + more_power, abs=1e-6
        )


@examples(20)
@given(st.integers(0, 2**32 - 1), harm, st.sampled_from([0.25, 4.0, -1.0, -64.0]),
       st.sampled_from([0.5, -2.0]))  # fmt: skip
def test_scaling_signals_and_their_noise_together_moves_no_segment(seed, harms, u_by, power_by):
    stream = harmed(plant(seed, 600), harms)
    there = Stream(stream.time_ns, stream.u * u_by, stream.power * power_by, stream.temperature)
    scaled = {'input_noise': abs(u_by), 'power_noise': 0.3 * abs(power_by)}
    here, _ = whole(Settings(QUICK), stream)
    other, _ = whole(Settings({**QUICK, **scaled}), there)
    assert spans(here.found) == spans(other.found)
    assert here.kinds.tolist() == other.kinds.tolist()
    for (_, a), (_, b) in zip(here.found, other.found, strict=True):
        assert b.segment.u_end == u_by * a.segment.u_end
        assert b.segment.power_rms_mw == abs(power_by) * a.segment.power_rms_mw


@needs_jit
def test_steady_segments_of_the_simulated_plant_tell_its_true_curve():
    """The power without noise in them is F(u), without bias."""
    log, u = simulated(3, 1)
    table = log.table
    names = (Signal.GENERATED_POWER, Signal.MAIN_STEAM_TEMPERATURE)
    stream = Stream(table.time_ns, u, *(np.ascontiguousarray(table.column(s)) for s in names))
    found = spans(whole(Settings(), stream)[0].found)
    truth = log.unit.curve
    steady = [(a, b) for a, b, kind in found if kind == SegmentKind.STEADY]
    assert len(steady) > 60
    assert sum(b - a for a, b in steady) > 0.15 * len(log)
    error = np.array([(log.true_power_mw[a:b] - truth(log.true_u[a:b])).mean() for a, b in steady])
    assert abs(error.mean()) < 4.0 * error.std() / np.sqrt(len(error))
    assert error.std() < 0.3
    measured = np.array([(stream.power[a:b] - truth(u[a:b])).mean() for a, b in steady])
    assert abs(measured.mean()) < 4.0 * measured.std() / np.sqrt(len(measured))


@pytest.mark.parametrize('extra', [-1, 0, 1])
@pytest.mark.parametrize('how', ['leap', 'nan'])
def test_a_gap_right_where_the_longest_segment_is_cut_is_still_a_gap(extra, how):
    """The cut leaves nothing open; a gap at that very row must begin a transient all the same."""
    n, cut = 300, SETTLE + 60 + extra
    rng = np.random.default_rng(0)
    stream = Stream(grid_ns(n), 1500.0 + rng.normal(0.0, 0.5, n), 200.0 + rng.normal(0.0, 0.1, n),
                    np.full(n, 540.0))  # fmt: skip
    if how == 'leap':
        stream.time_ns[cut:] += 600 * NS_PER_S
        first = cut
    else:
        stream.u[cut] = np.nan
        first = cut + 1
    out, _ = whole(Settings(QUICK), stream)
    assert (out.kinds[first : first + SETTLE - 1] == TRANSIENT).all()
    assert not [s for s in spans(out.found) if first <= s[0] < first + SETTLE]
    assert [s for s in spans(out.found) if s[0] >= first + SETTLE]


# --- hostile --------------------------------------------------------------------------------


@pytest.mark.parametrize(('u', 'noise'), [(-1e6, 0.3), (0.0, 0.0)])
def test_a_valve_that_never_moves_is_steady_with_no_slope(u, noise):
    n = 8000
    power = noise * (600.0 + np.random.default_rng(0).normal(0.0, 1.0, n))
    out, _ = whole(Settings(), Stream(grid_ns(n), np.full(n, u), power, np.full(n, 540.0)))
    assert out.found
    for _, f in out.found:
        assert f.segment.kind == SegmentKind.STEADY
        assert f.segment.u_start == f.segment.u_end == u
        assert f.segment.u_rms == 0.0
        assert all(math.isfinite(v) for v in given_by_the_segmenter(f.segment))


@needs_jit
def test_moves_are_found_when_the_valve_stood_still_most_of_the_time():
    """A historian that stores changes only has stretches without any noise; they teach nothing."""
    rng = np.random.default_rng(4)
    n = 30_000
    u = np.full(n, 1300.0)
    u[20_000:22_000] += np.arange(2000) * 0.3 + np.round(rng.normal(0.0, 2.0, 2000))
    u[22_000:] = 1300.0 + 600.0 + np.round(rng.normal(0.0, 2.0, 8000))
    power = lagged(0.2 * u, 10.0, 3.0) + 0.5 * rng.normal(0.0, 1.0, n)
    out, _ = whole(Settings(), Stream(grid_ns(n), u, power, np.full(n, 540.0)))
    later = [s for s in spans(out.found) if s[0] >= 20_000]
    assert any(kind == SegmentKind.SLOPE for *_, kind in later)
    assert any(kind == SegmentKind.STEADY for *_, kind in later)


def test_every_setting_at_its_corner_still_runs():
    """No corner of the ranges may write beyond the arrays (see NUMBA_BOUNDSCHECK)."""
    stream = plant(0, 400)
    for values in (
        {'block': 1.0, 'longest_segment': 60.0, 'steady_min': 0.0, 'slope_min': 0.0,
         'time_constant': 0.1, 'delay': 0.0},
        {'block': 10.0, 'longest_segment': 60.0, 'steady_min': 60.0, 'slope_min': 60.0},
        {'break_limit': 1.0, 'steady_limit': 0.1, 'slope_limit': 1.0, 'block': 1.0,
         'time_constant': 0.1, 'delay': 0.0, 'input_noise': 1e-3, 'power_noise': 1e-3},
        {'break_limit': 50.0, 'steady_limit': 50.0, 'slope_limit': 1000.0, 'block': 1.0,
         'input_noise': 1e6, 'power_noise': 1e6},
        {'time_constant': 3600.0, 'delay': 600.0},
    ):  # fmt: skip
        out, _ = whole(Settings(values), stream)
        assert out.rows == 400
        assert all(0 <= f.first_row < f.end_row <= 400 for _, f in out.found)
