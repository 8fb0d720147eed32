# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from streams import START_NS, blocks_of, cuts, examples

from valveflow_ros.curve.characteristic import level_error_mw
from valveflow_ros.fit.residual_chart import (
    ChartDesign,
    ResidualChart,
    alarms,
    block_means,
    design_chart,
    limit_for,
    normal_limit,
    slow_wander,
)
from valveflow_ros.records import NS_PER_S

DESIGN = ChartDesign(60.0, 0.5, 1.5, (0.25, 1.0), (15.0, 5.0), 30.0)


class NaiveChart:
    """What the chart is meant to be, block by block, with lists."""

    def __init__(self, design):
        self.design = design
        self.block, self.rows, self.last = None, [], math.nan
        self.sums = [[], [], [], []]  # of (value, mean) since the sum left zero
        self.answer = (math.nan, math.nan)

    def take(self, time_ns, residual):
        block = time_ns // round(self.design.block_s * NS_PER_S)
        if block != self.block:
            self._close()
            if self.block is None or block != self.block + 1:
                self.last = math.nan
            self.block, self.rows = block, []
        if math.isfinite(residual):
            self.rows.append(residual)
        return self.answer

    def _close(self):
        if len(self.rows) < 30:
            self.last = math.nan
            return
        d = self.design
        mean = sum(self.rows) / len(self.rows)
        if math.isnan(self.last):
            e = mean * math.sqrt(1 - d.correlation**2) / d.innovation_mw
        else:
            e = (mean - d.correlation * self.last) / d.innovation_mw
        e = max(-4.0, min(4.0, e))
        best = (0.0, 0.0)
        for k, history in enumerate(self.sums):
            sign, which = (1, -1)[k % 2], k // 2
            value = (history[-1][0] if history else 0.0) + sign * e - d.slack[which]
            if value <= 0.0:
                history.clear()
                continue
            history.append((min(value, 1.25 * d.limit[which]), mean))
            share = history[-1][0] / d.limit[which]
            if share > abs(best[0]):
                best = (sign * share, sum(m for _, m in history) / len(history))
        self.answer, self.last = best, mean


def rows(seed, gaps):
    """Return times and residuals of half an hour or so, with holes and a shift."""
    rng = np.random.default_rng(seed)
    n = 2400
    time_s = np.arange(n) + np.cumsum(np.where(rng.random(n) < gaps, rng.integers(1, 200, n), 0))
    residual = rng.normal(0.0, 3.0, n) + np.where(np.arange(n) > n // 2, rng.normal(0.0, 4.0), 0.0)
    residual[rng.random(n) < 10 * gaps] = math.nan
    start = START_NS + int(rng.integers(0, 10**12))
    return start + time_s * NS_PER_S, residual


@examples(40)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.002, 0.03]), st.data())
def test_any_cutting_gives_what_the_slow_truth_gives(seed, gaps, data):
    time_ns, residual = rows(seed, gaps)
    slow, fast = NaiveChart(DESIGN), ResidualChart(DESIGN, 1.0)
    wanted = np.array([slow.take(t, r) for t, r in zip(time_ns.tolist(), residual, strict=True)])
    parts = [
        fast.feed(time_ns[a:b], residual[a:b])
        for a, b in blocks_of(len(time_ns), data.draw(cuts(len(time_ns))))
    ]
    assert np.concatenate([e for e, _ in parts]) == pytest.approx(wanted[:, 0], nan_ok=True)
    assert np.concatenate([s for _, s in parts]) == pytest.approx(wanted[:, 1], nan_ok=True)


# --- limits ---------------------------------------------------------------------------------


def naive_alarms(e, slack, limit):
    count, sums = 0, [0.0, 0.0]
    for value in e:
        sums = [max(0.0, sums[0] + value - slack), max(0.0, sums[1] - value - slack)]
        if max(sums) > limit:
            count, sums = count + 1, [0.0, 0.0]
    return count


@examples(40)
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 2.0), st.floats(0.1, 9.0))
def test_alarms_are_counted_as_by_hand(seed, slack, limit):
    e = np.random.default_rng(seed).normal(0.0, 1.5, 300)
    assert alarms(e, slack, limit) == naive_alarms(e, slack, limit)


@pytest.mark.parametrize(('slack', 'run_length'), [(0.25, 5000.0), (1.0, 500.0)])
def test_limits_keep_their_word_on_other_draws(slack, run_length):
    drawn, others = np.random.default_rng(7).normal(0.0, 1.0, (2, 600_000))
    limit = limit_for(drawn, slack, run_length)
    assert len(others) / alarms(others, slack, limit) == pytest.approx(run_length, rel=0.3)
    assert limit == pytest.approx(normal_limit(slack, run_length), rel=0.06)


def correlated(rng, n, correlation):
    w, out = rng.normal(0.0, 1.0, n), np.empty(n)
    value = w[0]
    for k in range(n):
        value = correlation * value + math.sqrt(1.0 - correlation**2) * w[k]
        out[k] = value
    return out


@pytest.mark.parametrize('correlation', [0.0, 0.5, 0.9])
def test_the_design_learns_correlation_and_noise(correlation):
    r = 2.0 * correlated(np.random.default_rng(3), 20_000, correlation)
    d = design_chart(r, np.ones(len(r), np.uint8), 60.0, block_s=60.0, run_length_days=1.0,
                     floor_mw=0.0, curve_error_mw=0.0)  # fmt: skip
    assert d.correlation == pytest.approx(correlation, abs=0.03)
    assert d.innovation_mw == pytest.approx(2.0 * math.sqrt(1.0 - correlation**2), rel=0.05)
    assert d.limit[0] >= normal_limit(0.25, 2.0 * 1440.0) - 1e-9


def test_a_wandering_residual_gets_wider_limits_and_a_doubtful_curve_more_slack():
    rng = np.random.default_rng(4)
    clean = correlated(rng, 15_000, 0.5)
    wander = clean + 0.6 * correlated(rng, 15_000, 0.995)
    weight = np.ones(15_000, np.uint8)
    common = {'block_s': 60.0, 'run_length_days': 5.0, 'floor_mw': 0.0}
    a = design_chart(clean, weight, 60.0, curve_error_mw=0.0, **common)
    b = design_chart(wander, weight, 60.0, curve_error_mw=0.0, **common)
    assert b.limit[0] > 1.5 * a.limit[0]
    c = design_chart(clean, weight, 60.0, curve_error_mw=0.5, **common)
    assert c.slack[0] > a.slack[0] + 0.1


def test_limits_are_twice_as_wide_at_first_and_hardly_wider_after_weeks():
    r = correlated(np.random.default_rng(6), 30 * 1440, 0.5)

    def limits(days):
        part = r[: round(days * 1440)]
        weight = np.ones(len(part), np.uint8)
        common = {'block_s': 60.0, 'run_length_days': 30.0, 'floor_mw': 0.0}
        return design_chart(part, weight, 60.0, curve_error_mw=0.0, **common).limit

    least = normal_limit(0.25, 2.0 * 1.4 * 30.0 * 1440.0)
    assert limits(0.2)[0] >= 2.0 * least - 1e-9
    assert limits(0.8)[0] >= 1.5 * least - 1e-9
    assert limits(0.2)[0] > 1.6 * limits(30.0)[0]
    assert limits(30.0)[0] < 1.3 * least


def test_hardly_any_clean_rows_still_give_limits():
    for n in (0, 1, 2, 5):
        d = design_chart(np.ones(n), np.ones(n, np.uint8), 60.0, block_s=60.0,
                         run_length_days=30.0, floor_mw=1.0, curve_error_mw=0.0)  # fmt: skip
        assert min(d.limit) > 3.0
        assert d.innovation_mw > 0.0


def test_block_means_leave_thin_blocks_out():
    residual = np.arange(12.0)
    weight = np.array([1, 1, 1, 1, 0, 0, 1, 1, 0, 0, 0, 1], dtype=np.uint8)
    assert block_means(residual, weight, 4) == pytest.approx([1.5, 6.5, math.nan], nan_ok=True)
    assert block_means(residual[:3], weight[:3], 4).shape == (0,)


@examples(30)
@given(
    st.floats(0.01, 5.0), st.sampled_from([0.0, 0.5, 0.9]), st.sampled_from([0.0, 0.5, 1.0, 5.0]),
    st.sampled_from([0.0, 0.3]), st.sampled_from([1.0, -1.0]),
)  # fmt: skip
def test_whatever_the_noise_a_large_shift_is_found_within_an_hour(
    sd, correlation, floor, error, sign
):
    """On a quiet unit, too, where the floor is many standard deviations wide."""
    r = sd * correlated(np.random.default_rng(5), 3000, correlation)
    design = design_chart(r, np.ones(len(r), np.uint8), 60.0, block_s=60.0, run_length_days=1.0,
                          floor_mw=floor, curve_error_mw=error)  # fmt: skip
    assert max(design.slack) <= 3.0
    shift = sign * (5.0 * floor + 20.0 * sd + 5.0 * error)
    time_ns = START_NS + np.arange(240) * 60 * NS_PER_S
    record = r[:240] + np.where(np.arange(240) >= 120, shift, 0.0)
    evidence, _ = ResidualChart(design, 60.0).feed(time_ns, record)
    assert np.nanmax(sign * evidence[120:180]) > 1.0


@examples(30)
@given(st.integers(0, 2**32 - 1), st.integers(0, 2400))
def test_a_chart_that_follows_another_of_its_design_is_the_same_chart(seed, cut):
    time_ns, residual = rows(seed, 0.002)
    whole = ResidualChart(DESIGN, 1.0).feed(time_ns, residual)
    first, second = ResidualChart(DESIGN, 1.0), ResidualChart(DESIGN, 1.0)
    head = first.feed(time_ns[:cut], residual[:cut])
    second.follow(first)
    tail = second.feed(time_ns[cut:], residual[cut:])
    for k in range(2):
        joined = np.concatenate([head[k], tail[k]])
        assert np.array_equal(joined, whole[k], equal_nan=True)


def test_a_chart_that_follows_one_of_other_limits_keeps_the_shares():
    time_ns, residual = rows(3, 0.0)
    first = ResidualChart(DESIGN, 1.0)
    evidence, _ = first.feed(time_ns, residual + 1.0)
    other = replace(DESIGN, limit=(30.0, 20.0))
    second = ResidualChart(other, 1.0)
    second.follow(first)
    later, _ = second.feed(time_ns[-1:] + NS_PER_S, residual[-1:])
    assert later[0] == pytest.approx(evidence[-1])
    slow = ResidualChart(replace(DESIGN, block_s=120.0), 1.0)
    slow.follow(first)
    assert np.isnan(slow.feed(time_ns[-1:] + NS_PER_S, residual[-1:])[0]).all()


MINUTE_S = 60.0
DAY_ROWS = 1440


def weather(seed, sd, days=10, hold_days=1.0):
    """Draw noise of 1 MW upon a level that forgets in about a day, minute by minute."""
    rng = np.random.default_rng(seed)
    rows = days * DAY_ROWS
    keep = math.exp(-1.0 / (hold_days * DAY_ROWS))
    level = np.empty(rows)
    level[0] = sd * rng.standard_normal()
    step = sd * math.sqrt(1.0 - keep * keep) * rng.standard_normal(rows)
    for t in range(1, rows):
        level[t] = keep * level[t - 1] + step[t]
    return level + rng.standard_normal(rows)


def wander_of(residual, floor=1.0):
    return slow_wander(residual, np.ones(len(residual), dtype=np.uint8), MINUTE_S, floor)


@pytest.mark.parametrize('sd', [1.0, 3.0])
def test_the_wander_of_days_is_told_from_a_window_of_them(sd):
    found = [wander_of(weather(seed, sd)) for seed in range(20)]
    assert 0.7 * sd < np.median(found) < 1.6 * sd
    assert 0.4 * sd < min(found) <= max(found) < 2.5 * sd


@pytest.mark.parametrize('seed', range(3))
def test_a_fault_in_the_window_is_no_weather(seed):
    residual = weather(seed, 0.5)
    usual = wander_of(residual)
    row = np.arange(len(residual))
    for fault in (-10.0 * (row > 7.5 * DAY_ROWS), 20.0 * ((row > 5000) & (row < 5720))):
        assert usual <= wander_of(residual + fault) < usual + 0.7


@given(st.floats(0.01, 100.0))
def test_the_wander_is_in_the_unit_of_the_residual(factor):
    residual = weather(1, 1.0, days=2)
    assert wander_of(factor * residual, factor) == pytest.approx(factor * wander_of(residual))


def test_before_six_hours_half_of_what_need_not_be_found_is_taken_for_it():
    assert wander_of(np.zeros(100), 2.0) == wander_of(np.zeros(300), 2.0) > 0.0
    assert wander_of(np.zeros(100), 0.0) == 0.0
    assert wander_of(np.zeros(10 * DAY_ROWS), 2.0) < 0.5 * wander_of(np.zeros(100), 2.0)


def test_a_mean_of_more_days_is_nearer_to_that_of_many():
    day_ns = 86_400 * NS_PER_S
    errors = [level_error_mw(1.5, 0, days * day_ns) for days in (0, 1, 4, 10, 100)]
    assert errors[0] == 1.5
    assert errors == sorted(errors, reverse=True)
    # Of independent spells of two days.
    assert errors[-1] == pytest.approx(1.5 * math.sqrt(2.0 / 100.0), rel=0.02)
    assert level_error_mw(math.nan, 0, day_ns) == 0.0


def test_what_weather_does_raises_no_alarm_and_twice_of_what_may_pass_does():
    residual = weather(5, 1.0)
    weight = np.ones(len(residual), dtype=np.uint8)
    wander = wander_of(residual)
    design = design_chart(
        residual, weight, MINUTE_S, block_s=60.0, run_length_days=30.0, floor_mw=1.0,
        curve_error_mw=0.1, wander_mw=wander,
    )  # fmt: skip
    time_ns = START_NS + np.arange(len(residual), dtype=np.int64) * 60 * NS_PER_S
    passes = 4.0 * wander
    for shift, raised in ((0.0, False), (0.5 * passes, False), (2.0 * passes, True)):
        chart = ResidualChart(design, MINUTE_S)
        evidence, _ = chart.feed(time_ns, weather(6, 1.0) + shift)
        assert bool(np.nanmax(evidence) > 1.0) == raised
