# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Errors and tests of predictions on special segments (Table III of the paper)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from scipy.special import stdtr, stdtrit

from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.errors import DataError, TooFewSamplesError
from valveflow_ros.fit.problem import Samples
from valveflow_ros.fit.refine import least_rows
from valveflow_ros.fit.whitening import inflation
from valveflow_ros.parameters import Settings
from valveflow_ros.records import BoolArray, ByteArray, FloatArray, IntArray, SegmentKind
from valveflow_ros.segments.window import WindowContents
from valveflow_ros.signals.static_form import PAPER_EXPONENT, StaticForm

_LONGEST_S = 300.0
_LEAST_ROWS = 10  # minimum number of rows of a segment
LEARN_SHARE = 0.7
_LEAST_OF_PART = 0.1  # fraction of the required settled rows, in each part


# Tests for a zero mean difference. The paper's test assumes independent samples in a segment (its
# reference [38]). At 1 Hz the noise of the power is correlated over a minute or more, so that test
# overestimates the evidence by a factor of ten or a hundred. In addition there are tests with the
# effective number of samples.


@dataclass(frozen=True, slots=True)
class PairedTest:
    """A t test of a mean difference against zero.

    The p-value is two-sided; the degrees of freedom are one less than the ``effective`` number of
    independent values.
    """

    mean: float
    stderr: float
    t: float
    p_value: float
    effective: float

    def interval(self, level: float = 0.05) -> tuple[float, float]:
        """Return the confidence interval of the mean at 1 - ``level``; NaN if unknown."""
        if not (math.isfinite(self.stderr) and self.effective > 1.0):
            return math.nan, math.nan
        reach = float(stdtrit(self.effective - 1.0, 1.0 - 0.5 * level)) * self.stderr
        return self.mean - reach, self.mean + reach

    def zero_is_rejected(self, level: float = 0.05) -> bool:
        """Return True if a zero mean is rejected; False if the test is impossible."""
        return self.p_value < level


def _test(mean: float, stderr: float, effective: float) -> PairedTest:
    """Return the t test of a mean with its standard error; NaN if it is impossible."""
    if not (math.isfinite(mean) and math.isfinite(stderr) and effective > 1.0):
        return PairedTest(mean, math.nan, math.nan, math.nan, effective)
    if stderr == 0.0:
        t = math.copysign(math.inf, mean) if mean else 0.0
        return PairedTest(mean, 0.0, t, 0.0 if mean else 1.0, effective)
    t = mean / stderr
    return PairedTest(mean, stderr, t, float(2.0 * stdtr(effective - 1.0, -abs(t))), effective)


def over_samples(difference: FloatArray, widening: float = 1.0) -> PairedTest:
    """Test the samples of a segment; by default all are independent, as in the paper.

    ``widening`` is the ratio of the variance of a long mean to that of independent samples: the
    effective number of samples is n / widening. The result is NaN if it is below two.
    """
    n = len(difference)
    effective = n / max(widening, 1.0)
    mean, stderr = float(difference.mean()) if n else math.nan, math.nan
    if n >= 2 and effective >= 2.0:
        stderr = float(difference.std(ddof=1)) / math.sqrt(effective)
    return _test(mean, stderr, effective)


def over_blocks(blocks: FloatArray) -> PairedTest:
    """Test means of blocks, allowing for correlation from block to block.

    There is one value per block (for example a segment), in chronological order. The variance is
    that of Newey and West with Bartlett weights over ``4 (k / 100)^(2/9)`` lags, but at least the
    ordinary variance.
    """
    k = len(blocks)
    if k < 2:
        return _test(float(blocks.mean()) if k else math.nan, math.nan, float(k))
    e = blocks - blocks.mean()
    own = float(e @ e) / k
    lags = min(k - 1, math.floor(4.0 * (k / 100.0) ** (2.0 / 9.0)))
    long_run = own
    for lag in range(1, lags + 1):
        long_run += 2.0 * (1.0 - lag / (lags + 1.0)) * float(e[lag:] @ e[:-lag]) / k
    long_run = max(own, long_run)
    effective = k * own / long_run if long_run > 0.0 else float(k)
    return _test(float(blocks.mean()), math.sqrt(long_run / (k - 1)), effective)


def widening_of(residual: FloatArray, spans: IntArray, step_s: float) -> float:
    """Return the factor by which correlation in time increases the variance of a mean.

    The spans (k, 2) are the first and end rows of the stretches to use, which are no neighbours.
    They are pooled with a common mean: with its own mean each would seem less correlated than it
    is. A misfit that changes from stretch to stretch is therefore taken as correlation, which is
    conservative.
    """
    if not len(spans):
        return 1.0
    parts = [residual[a:b] for a, b in spans[:, :2].tolist()]
    mean = float(np.concatenate(parts).mean())
    series = np.concatenate([np.append(part - mean, 0.0) for part in parts])
    weight = np.concatenate(
        [np.append(np.ones(len(part), dtype=np.uint8), np.uint8(0)) for part in parts]
    )
    half = float(np.median(spans[:, 1] - spans[:, 0])) / 2.0
    return inflation(series, weight, max(1, int(min(_LONGEST_S / step_s, half))))


@dataclass(frozen=True, slots=True)
class OtherData:
    """Data that no method has used for fitting."""

    samples: Samples
    time_ns: IntArray  # (n,)
    spans: IntArray  # (k, 3) special segments as first row, end row and kind
    opening_percent: FloatArray | None = None  # (n,)
    exponent: float = PAPER_EXPONENT  # m of the u = V p^m of the samples

    def on_axis(self, form: StaticForm) -> OtherData:
        """Return the data with the u and the p^e of a curve of this form.

        Raises
        ------
        DataError
            The form needs another u, and the openings are unknown.
        """
        s, opening = self.samples, self.opening_percent
        if form == StaticForm(exponent=self.exponent):
            return self
        if opening is None:
            raise DataError(
                f'The curve and the rows are over different inputs, {form.words} and V p^'
                f'{self.exponent:g}, and the rows come without openings.'
            )
        u, scale = form.of_integrated_input(s.u, opening, self.exponent)
        usable = s.usable * np.isfinite(u).astype(np.uint8)
        return replace(self, samples=replace(
            s, u=np.where(usable > 0, u, 0.0), usable=usable,
            scale=None if scale is None else np.where(usable > 0, scale, 1.0),
        ))  # fmt: skip


@dataclass(frozen=True, slots=True)
class Trial:
    """Measured data for the test."""

    time_ns: IntArray  # (n,)
    u: FloatArray  # (n,)
    power_mw: FloatArray  # (n,)
    # (n,) rows used for the test of every prediction: measured, inside the identified range of u,
    # and far enough after a gap.
    good: BoolArray
    spans: IntArray  # (k, 3) special segments as first row, end row and kind
    step_s: float


@dataclass(frozen=True, slots=True)
class Score:
    """The error, measured minus predicted, of one prediction on one segment."""

    mse_mw2: float  # not finite if the prediction is not
    samples: PairedTest  # with independent samples, as in the paper
    effective: PairedTest  # with the effective number of samples


@dataclass(frozen=True, slots=True)
class JudgedSegment:
    """One special segment of the other data."""

    number: int  # from 1, in chronological order
    kind: SegmentKind
    start_ns: int
    end_ns: int
    rows: IntArray  # indices of the rows that were used
    power_mw: float  # mean of the measured power
    scores: Mapping[str, Score]  # by prediction


@dataclass(frozen=True, slots=True)
class Judgement:
    """The test of all segments."""

    segments: tuple[JudgedSegment, ...]
    widening: float  # number of samples equivalent to one independent sample
    outside: int  # omitted samples of special segments: outside the curve, or too near a gap

    @property
    def samples(self) -> int:
        """Return the number of samples used."""
        return sum(len(s.rows) for s in self.segments)

    def kinds(self, kind: SegmentKind | None) -> tuple[JudgedSegment, ...]:
        """Return the segments of one kind, or all."""
        return tuple(s for s in self.segments if kind is None or s.kind == kind)

    def mse(self, name: str, kind: SegmentKind | None = None) -> float:
        """Return the mean squared error over all samples used, MW^2; NaN without any."""
        chosen = self.kinds(kind)
        total = sum(len(s.rows) for s in chosen)
        errors = (s.scores[name].mse_mw2 * len(s.rows) for s in chosen)
        return sum(errors) / total if total else float('nan')

    def bias(self, name: str) -> PairedTest:
        """Test the mean of measured minus predicted over segments, weighted by samples."""
        return _weighted([(len(s.rows), s.scores[name].samples.mean) for s in self.segments])

    def gain(self, name: str, other: str, kind: SegmentKind | None = None) -> PairedTest:
        """Test the squared error of ``other`` minus that of ``name``; positive favours ``name``.

        Segments in which one of them is not finite are left out.
        """
        pairs = [
            (len(s.rows), s.scores[other].mse_mw2 - s.scores[name].mse_mw2)
            for s in self.kinds(kind)
        ]
        return _weighted([(n, d) for n, d in pairs if np.isfinite(d)])

    def failed(self, name: str, kind: SegmentKind | None = None) -> int:
        """Return the number of segments in which the prediction is not finite."""
        return sum(not np.isfinite(s.scores[name].mse_mw2) for s in self.kinds(kind))

    def passed(self, name: str, *, as_paper: bool) -> tuple[int, int]:
        """Return the number of segments in which zero is not rejected, and the number tested."""
        tests = [
            s.scores[name].samples if as_paper else s.scores[name].effective for s in self.segments
        ]
        done = [t for t in tests if np.isfinite(t.p_value)]
        return sum(not t.zero_is_rejected() for t in done), len(done)


def _weighted(pairs: list[tuple[int, float]]) -> PairedTest:
    """Test values of segments, weighted such that their mean is the mean over samples."""
    if not pairs:
        return over_blocks(np.empty(0))
    weight = np.array([n for n, _ in pairs], dtype=np.float64)
    return over_blocks(weight / weight.mean() * np.array([d for _, d in pairs]))


def judge(trial: Trial, predictions: Mapping[str, FloatArray]) -> Judgement:
    """Test predictions (n,) in MW on the special segments of other data.

    Raises
    ------
    DataError
        No special segment has enough usable rows.
    """
    kept = [(a, b, kind, a + np.flatnonzero(trial.good[a:b])) for a, b, kind in trial.spans]
    inside = sum(len(rows) for *_, rows in kept)
    outside = int(sum(b - a for a, b, *_ in kept)) - inside
    kept = [k for k in kept if len(k[3]) >= _LEAST_ROWS]
    if not kept:
        raise DataError(_nothing_judged(trial))
    spans = np.array([(rows[0], rows[-1] + 1) for *_, rows in kept], dtype=np.int64)
    widening = _widening(trial, predictions, spans)
    segments = []
    for number, (a, b, kind, rows) in enumerate(kept, 1):
        measured = trial.power_mw[rows]
        scores = {k: _score(measured - p[rows], widening) for k, p in predictions.items()}
        segments.append(JudgedSegment(
            number, SegmentKind(int(kind)), int(trial.time_ns[a]), int(trial.time_ns[b - 1]),
            rows, float(measured.mean()), scores,
        ))  # fmt: skip
    return Judgement(tuple(segments), widening, outside)


def _nothing_judged(trial: Trial) -> str:
    if not len(trial.spans):
        return 'The test data hold no special segment.'
    rows = np.concatenate([np.arange(a, b) for a, b, _ in trial.spans])
    low, high = float(trial.u[rows].min()), float(trial.u[rows].max())
    return (
        f'No special segment of the test data can be judged: their u lies from {low:.4g} '
        f'to {high:.4g}, beyond what the curve is known for, or they follow a gap too closely.'
    )


def _widening(trial: Trial, predictions: Mapping[str, FloatArray], spans: IntArray) -> float:
    """Return the widening of the prediction with the smallest mean squared error."""
    rows = np.concatenate([np.arange(a, b) for a, b in spans.tolist()])
    rows = rows[trial.good[rows]]
    best, least = None, np.inf
    for predicted in predictions.values():
        with np.errstate(over='ignore', invalid='ignore'):
            mse = float(np.mean((trial.power_mw[rows] - predicted[rows]) ** 2))
        if mse < least:
            best, least = predicted, mse
    if best is None:
        return 1.0
    return widening_of(np.where(trial.good, trial.power_mw - best, 0.0), spans, trial.step_s)


def _score(difference: FloatArray, widening: float) -> Score:
    with np.errstate(over='ignore', invalid='ignore'):
        mse = float(np.mean(difference**2))
    if not np.isfinite(mse):
        none = _test(math.nan, math.nan, 0.0)
        return Score(mse, none, none)
    return Score(mse, over_samples(difference), over_samples(difference, widening))


def samples_of(contents: WindowContents, settings: Settings) -> Samples:
    """Return the rows of a window.

    A row without opening, pressure or power is not usable; a jump in time is a
    gap even without rows in it.
    """
    usable = (np.isfinite(contents.u) & np.isfinite(contents.power_mw)).astype(np.uint8)
    step_s = settings.real('sample_period')
    usable[1:][np.diff(contents.time_ns) > 1.5e9 * step_s] = 0
    return Samples(
        u=np.where(usable > 0, contents.u, 0.0),
        power_mw=np.where(usable > 0, contents.power_mw, 0.0), usable=usable, step_s=step_s,
        settle_s=settings.settle_s, group=max(1, round(settings.real('block') / step_s)),
    )  # fmt: skip


def other_data(contents: WindowContents, settings: Settings) -> OtherData:
    """Return the rows of a window with its special segments, for a test."""
    opening = contents.opening_percent
    return OtherData(
        samples_of(contents, settings), contents.time_ns, contents.spans,
        opening if len(opening) else None, settings.real('pressure_exponent'),
    )  # fmt: skip


class Runnable(Protocol):
    """A model that can be simulated with measured inputs."""

    def run(self, samples: Samples) -> tuple[FloatArray, ByteArray]:
        """Return the simulated power in MW and a mask of settled rows."""


def part_of(samples: Samples, start: int, end: int) -> Samples:
    """Return the rows ``[start, end)``."""
    cut = slice(start, end)
    return replace(
        samples, u=samples.u[cut], power_mw=samples.power_mw[cut], usable=samples.usable[cut]
    )


def cut_samples(samples: Samples) -> tuple[Samples, Samples]:
    """Return the part for fitting and the later part for model selection.

    Raises
    ------
    TooFewSamplesError
        Too few usable rows, or too few that are far enough after a gap: in total, or in one of
        the two parts.
    """
    usable = int(samples.usable.sum())
    least = least_rows(samples.step_s)
    if usable < least:
        raise TooFewSamplesError('Rows with opening, pressure and power', usable, least)
    _settled_enough(samples, least)
    cut = round(LEARN_SHARE * samples.means) * samples.group
    learn, judge = part_of(samples, 0, cut), part_of(samples, cut, len(samples.u))
    for part in (learn, judge):
        _settled_enough(part, round(_LEAST_OF_PART * least))
    return learn, judge


def _settled_enough(samples: Samples, least: int) -> None:
    # Averaged as in the searches: a mean is used only if all its rows are usable.
    coarse = samples.coarser()
    factor = round(coarse.step_s / samples.step_s)
    settled = settled_rows(coarse)[: coarse.means * coarse.group]
    means = settled.reshape(coarse.means, coarse.group).all(axis=1)
    have = int(means.sum()) * coarse.group * factor
    if have < least:
        raise TooFewSamplesError(
            'Rows that follow each other for longer than the transient', have, least
        )


def settled_rows(samples: Samples) -> BoolArray:
    """Return a mask of usable rows with a longer distance from a gap than the transient."""
    place = np.arange(1, len(samples.u) + 1)
    last = np.maximum.accumulate(np.where(samples.usable > 0, 0, place))
    return np.asarray(place - last > round(samples.settle_s / samples.step_s))


def run_mse(model: Runnable, samples: Samples) -> float:
    """Return the mean squared error in MW^2 of a free simulation; infinite if it diverges."""
    answer, settled = model.run(samples)
    keep = settled > 0
    if not keep.any():
        return float('inf')
    error = samples.power_mw[keep] - answer[keep]
    with np.errstate(over='ignore', invalid='ignore'):
        value = float(np.mean(error**2))
    return value if np.isfinite(value) else float('inf')


def dynamic(characteristic: Characteristic, samples: Samples) -> FloatArray:
    """Return the power simulated with curve and regional dynamics, MW, shape (n,)."""
    s, model = samples, characteristic.model
    scale = 1.0 if s.scale is None else s.scale
    return model.respond(s.u, s.usable, s.step_s, s.settle_s, scale)[0]


def trial_of(other: OtherData, characteristic: Characteristic) -> Trial:
    """Return the measured data with the rows that can be used for the test.

    These are the same for every method: inside the u range of the proposed curve, and far
    enough after a gap for the slowest allowed dynamics.
    """
    samples = other.samples
    low, high = characteristic.model.knots[[0, -1]]
    good = (samples.usable > 0) & (samples.u >= low) & (samples.u <= high)
    good &= settled_rows(samples)
    return Trial(other.time_ns, samples.u, samples.power_mw, good, other.spans, samples.step_s)
