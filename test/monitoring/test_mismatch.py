# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from streams import START_NS, blocks_of, cuts, examples, needs_jit, steps_and_ramps

from valveflow_ros.curve.regional_model import RegionalModel
from valveflow_ros.monitoring import mismatch as k
from valveflow_ros.monitoring.mismatch import FLOOR, LEAST_BLOCKS, NAMES, NOTHING, Mismatch
from valveflow_ros.monitoring.prediction import PredictionBlock
from valveflow_ros.parameters import PARAMETERS
from valveflow_ros.records import NS_PER_S

STEP_S = 20.0
DAY = round(86400.0 / STEP_S)
LIMIT = float(PARAMETERS['mismatch_limit'].default)
MODEL = RegionalModel(
    np.array([1000.0, 1500.0, 2000.0]), np.array([150.0, 250.0]), np.array([250.0, 300.0]),
    np.empty(0), np.array([120.0]), np.zeros(1),
)  # fmt: skip


class Stream:
    """Rows of a plant that holds and moves, and a residual that is noise."""

    def __init__(self, seed, days, gaps=0.0):
        rng = np.random.default_rng(seed)
        n = round(days * DAY)
        self.u = steps_and_ramps(rng, n, 1020.0, 1980.0, hold=(20, 100), rate=15.0)
        self.time_s = np.arange(n) * STEP_S
        self.temperature = 540.0 + 2.0 * self.noise(rng, n, 0.98)
        self.static = MODEL.static(self.u)
        self.dynamic = np.empty(n)
        answer, a = self.static[0], math.exp(-STEP_S / 120.0)
        for t in range(n):
            answer = a * answer + (1.0 - a) * self.static[t]
            self.dynamic[t] = answer
        self.residual = 2.0 * self.noise(rng, n, 0.8)
        leaps = np.where(rng.random(n) < gaps, rng.integers(1, 2000, n), 0)
        self.time_ns = START_NS + (np.arange(n) + np.cumsum(leaps)) * round(STEP_S * NS_PER_S)
        self.residual[rng.random(n) < 20.0 * gaps] = math.nan
        self.temperature[rng.random(n) < 20.0 * gaps] = math.nan

    @staticmethod
    def noise(rng, n, correlation):
        white = rng.normal(0.0, math.sqrt(1.0 - correlation**2), n)
        out, value = np.empty(n), 0.0
        for t in range(n):
            value = correlation * value + white[t]
            out[t] = value
        return out

    def part(self, start, end):
        cut, nan = slice(start, end), np.full(end - start, math.nan)
        block = PredictionBlock(
            self.time_ns[cut], self.u[cut], nan, self.static[cut], self.dynamic[cut],
            self.residual[cut], nan, nan, nan, np.zeros(end - start, np.uint8), math.nan, '',
        )  # fmt: skip
        return block, self.temperature[cut]


def watched(stream, places=()):
    made = Mismatch(STEP_S)
    for start, end in blocks_of(len(stream.u), places):
        made.feed(*stream.part(start, end), MODEL)
    return made


class Naive:
    """What the statistics are meant to be, with lists of minutes and of blocks."""

    def __init__(self, stream):
        self.blocks = {}  # number of the block: list of (residual, features)
        self.warm, self.play, self.past = [], math.nan, [math.nan] * 4
        minutes = {}
        for t, time_ns in enumerate(stream.time_ns.tolist()):
            minutes.setdefault(time_ns // k.MINUTE_NS, []).append(t)
        numbers = sorted(minutes)
        for number in numbers[:-1]:
            if number - 1 not in minutes:
                self.past = [math.nan] * 4
            good = [t for t in minutes[number] if math.isfinite(stream.residual[t])]
            if len(good) < 2:
                self.past = [math.nan] * 4
                continue
            mean = {name: float(np.mean(getattr(stream, name)[good]))
                    for name in ('residual', 'u', 'static', 'dynamic')}  # fmt: skip
            known = [stream.temperature[t] for t in good if math.isfinite(stream.temperature[t])]
            block = number * k.MINUTE_NS // k.BLOCK_NS
            self.blocks.setdefault(block, []).append(
                (mean['residual'], self.features(number, mean, known))
            )
        self.last = numbers[-1] * k.MINUTE_NS // k.BLOCK_NS

    def features(self, number, mean, known):
        u, x = mean['u'], mean['static']
        slope = 0.2 if u < 1499.0 else 0.1 if u > 1501.0 else math.nan
        if math.isnan(slope):
            near = MODEL.static(np.array([u - 1.0, u + 1.0]))
            slope = float(near[1] - near[0]) / 2.0
        z = [0.0] * len(NAMES)
        load, swing = x / 300.0, u * slope / 300.0
        if known:
            t = float(np.mean(known))
            z[3] = (t - np.mean(self.warm[-4320:])) * load if self.warm else 0.0
            self.warm.append(t)
        hour = (number + 0.5) % 1440.0 / 60.0
        self.play = u if math.isnan(self.play) else self.play
        self.play = min(max(self.play, 0.995 * u), 1.005 * u)
        z[0], z[1], z[2] = 1.0, load, swing
        z[4], z[5] = (f(2.0 * math.pi * hour / 24.0) * load for f in (math.cos, math.sin))
        z[6] = (u - self.play) / (0.005 * u) * swing
        z[7 if u < 1500.0 else 8] = x - mean['dynamic']
        self.past = [x, *self.past[:3]]
        for j in range(3):
            move = self.past[j] - self.past[j + 1]
            z[9 + j] = 0.0 if math.isnan(move) else move
        for j in range(12):
            z[12 + j] = max(0.0, 1.0 - abs(u - (1000.0 + j * 1000.0 / 11.0)) / (1000.0 / 11.0))
        return z

    def scores(self):
        done = list(range(min(self.blocks), self.last))
        weight = {b: math.exp(-(self.last - b) / 36.0) for b in [*done, self.last]}
        # The size of the residual is known up to the last minute.
        total = sum(weight[b] * r * r for b in weight for r, _ in self.blocks.get(b, []))
        count = sum(weight[b] for b in weight for _ in self.blocks.get(b, []))
        noise = math.sqrt(total / max(count, 1.0))
        return np.array([self.score(j, done, weight, noise) for j in range(len(NAMES))])

    def score(self, j, done, weight, noise):
        rows = {b: [(r, z[j]) for r, z in self.blocks.get(b, [])] for b in done}
        s = {b: sum(r * z for r, z in rows[b]) for b in done}
        q = {b: sum(z * z for _, z in rows[b]) for b in done}
        n = sum(weight[b] * sum(z != 0.0 for _, z in rows[b]) for b in done)
        all_q = sum(weight[b] * q[b] for b in done)
        if all_q == 0.0:
            return 0.0
        theta = sum(weight[b] * s[b] for b in done) / all_q
        rest = {b: s[b] - theta * q[b] for b in done}
        # The neighbour's weight is the younger block's: both were forgotten together since.
        own = sum((weight[b] * rest[b]) ** 2 for b in done)
        cross = sum(weight[b] ** 2 * rest[b] * rest[b - 1] for b in done if b - 1 in rest)
        variance = max(own, own + 2.0 * cross) / all_q**2
        spread = math.sqrt(variance + FLOOR**2 * noise**2 * max(n, 1.0) / all_q)
        blocks = all_q**2 / sum((weight[b] * q[b]) ** 2 for b in done)
        if blocks < LEAST_BLOCKS:
            return 0.0
        t, n = theta / spread, max(blocks - 1.0, 1.0)
        wallace = (8.0 * n + 1.0) / (8.0 * n + 3.0) * math.sqrt(n * math.log1p(t * t / n))
        return math.copysign(wallace, t)


@needs_jit
@pytest.mark.parametrize(('seed', 'gaps'), [(0, 0.0), (1, 0.0005), (2, 0.003)])
def test_scores_are_those_of_the_naive_statistics(seed, gaps):
    stream = Stream(seed, 1.7, gaps)
    found, truth = watched(stream).scores(), Naive(stream).scores()
    assert np.any(truth != 0.0)
    np.testing.assert_allclose(found, truth, rtol=1e-6, atol=1e-6)


@needs_jit
@examples(15)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.003]), st.data())
def test_any_cutting_gives_the_same_scores_bit_for_bit(seed, gaps, data):
    stream = Stream(seed, 1.5, gaps)
    places = data.draw(cuts(len(stream.u), most=30))
    assert watched(stream, places).scores().tobytes() == watched(stream).scores().tobytes()


@needs_jit
@pytest.mark.parametrize('seed', range(2))
def test_correlated_noise_is_silence(seed):
    stream, made = Stream(seed, 10.0), Mismatch(STEP_S)
    loudest = 0.0
    for start in range(0, len(stream.u), DAY // 12):
        made.feed(*stream.part(start, start + DAY // 12), MODEL)
        loudest = max(loudest, abs(made.judge().score))
    assert 0.0 < loudest < LIMIT


def direction(stream):
    """The last move's, as a play of two percent would have it."""
    out, middle = np.empty(len(stream.u)), stream.u[0]
    for t, u in enumerate(stream.u):
        middle = min(max(middle, 0.99 * u), 1.01 * u)
        out[t] = np.sign(u - middle)
    return out


FAULTS = {
    'offset': (lambda s: 2.0 + 0.0 * s.u, ('offset', 'gain', 'input'), 'more'),
    'gain': (lambda s: -0.008 * s.static, ('gain', 'offset'), 'less'),
    'temperature': (lambda s: -0.0015 * (s.temperature - 540.0) * s.static, ('temperature',),
                    'temperature'),
    'day': (lambda s: 0.005 * np.cos(2 * math.pi * (s.time_s + START_NS / 1e9 - 3600.0) / 86400.0)
            * s.static, ('time of day (cosine)',), 'time of day'),
    'direction': (lambda s: -1.2 * direction(s), ('direction',), 'opening and closing'),
    'slower': (lambda s: -0.3 * (s.static - s.dynamic) * (s.u < 1500.0), ('lag at low load',),
               'at low load the power follows the valve more slowly'),
    'bump': (lambda s: 3.0 * np.maximum(0.0, 1.0 - np.abs(s.u - 1364.0) / 90.0), ('bin 4 of u',),
             'at about u = 1364'),
}  # fmt: skip


@needs_jit
@pytest.mark.parametrize('kind', FAULTS)
def test_each_kind_of_misfit_is_found_and_hinted_at(kind):
    fault, names, words = FAULTS[kind]
    stream = Stream(11, 6.0)
    stream.residual = stream.residual + fault(stream)
    found = watched(stream).judge()
    assert abs(found.score) > LIMIT
    assert found.name in names
    assert words in found.hint


@needs_jit
def test_a_misfit_that_has_gone_is_forgotten():
    stream = Stream(12, 20.0)
    stream.residual[: 4 * DAY] += 3.0
    made = Mismatch(STEP_S)
    made.feed(*stream.part(0, 4 * DAY), MODEL)
    assert made.judge().score > LIMIT
    made.feed(*stream.part(4 * DAY, 20 * DAY), MODEL)
    assert abs(made.judge().score) < 0.7 * LIMIT


@needs_jit
def test_what_cannot_be_judged_is_silence():
    stream = Stream(13, 0.3)
    assert Mismatch(STEP_S).judge() == NOTHING
    assert watched(stream).judge() == NOTHING
    stream.residual[:] = math.nan
    assert watched(stream).judge() == NOTHING
    # Extreme numbers leave no NaN behind.
    stream = Stream(14, 2.0)
    stream.residual[::7] = 1e150
    stream.u[::5], stream.static[::5] = 0.0, 0.0
    assert np.isfinite(watched(stream).scores()).all()
    stream.residual[:] = 0.0
    assert (watched(stream).scores() == 0.0).all()
