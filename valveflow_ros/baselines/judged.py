"""Judge predictions on special segments: squared errors and tests (Table III of the paper)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from valveflow_ros.baselines.paired import (
    PairedTest,
    over_blocks,
    over_samples,
    widening_of,
    with_effective_size,
)
from valveflow_ros.errors import DataError
from valveflow_ros.fit.problem import Samples
from valveflow_ros.records import BoolArray, FloatArray, IntArray, SegmentKind

_LEAST_ROWS = 10  # of a segment that can be judged


@dataclass(frozen=True, slots=True)
class OtherData:
    """Data no method has seen.

    Attributes
    ----------
    samples : Samples
    time_ns : int64 (n,)
    spans : int64 (k, 3)
        Special segments as first row, end row and kind.
    """

    samples: Samples
    time_ns: IntArray
    spans: IntArray


@dataclass(frozen=True, slots=True)
class Trial:
    """Measured data to judge by.

    Attributes
    ----------
    time_ns : int64 (n,)
    u, power_mw : float64 (n,)
    good : bool (n,)
        Rows every prediction is judged on: measured, inside the identified range of u,
        and far enough behind a gap.
    spans : int64 (k, 3)
        Special segments as first row, end row and kind.
    step_s : float
    """

    time_ns: IntArray
    u: FloatArray
    power_mw: FloatArray
    good: BoolArray
    spans: IntArray
    step_s: float


@dataclass(frozen=True, slots=True)
class Score:
    """One prediction on one segment.

    Attributes
    ----------
    mse_mw2 : float
        Mean squared error; not finite where the prediction is not.
    samples : PairedTest
        Of measured minus predicted, each sample counting, as in the paper.
    effective : PairedTest
        The same with the effective number of samples.
    """

    mse_mw2: float
    samples: PairedTest
    effective: PairedTest


@dataclass(frozen=True, slots=True)
class JudgedSegment:
    """One special segment of the other data.

    Attributes
    ----------
    number : int
        From 1, in order of time.
    kind : SegmentKind
    start_ns, end_ns : int
    rows : int64 (m,)
        That were judged.
    power_mw : float
        Mean measured power.
    scores : mapping
        By prediction.
    """

    number: int
    kind: SegmentKind
    start_ns: int
    end_ns: int
    rows: IntArray
    power_mw: float
    scores: Mapping[str, Score]


@dataclass(frozen=True, slots=True)
class Judgement:
    """All segments.

    Attributes
    ----------
    segments : tuple of JudgedSegment
    widening : float
        Samples that are worth one independent sample.
    outside : int
        Samples of special segments not judged: beyond the curve, or too near a gap.
    """

    segments: tuple[JudgedSegment, ...]
    widening: float
    outside: int

    @property
    def samples(self) -> int:
        """Return the number of samples judged."""
        return sum(len(s.rows) for s in self.segments)

    def kinds(self, kind: SegmentKind | None) -> tuple[JudgedSegment, ...]:
        """Return the segments of one kind, or all."""
        return tuple(s for s in self.segments if kind is None or s.kind == kind)

    def mse(self, name: str, kind: SegmentKind | None = None) -> float:
        """Return the mean squared error over all samples judged, MW^2; NaN without any."""
        chosen = self.kinds(kind)
        total = sum(len(s.rows) for s in chosen)
        errors = (s.scores[name].mse_mw2 * len(s.rows) for s in chosen)
        return sum(errors) / total if total else float('nan')

    def bias(self, name: str, kind: SegmentKind | None = None) -> PairedTest:
        """Test the mean of measured minus predicted over segments, weighted by samples."""
        return _weighted([(len(s.rows), s.scores[name].samples.mean) for s in self.kinds(kind)])

    def gain(self, name: str, other: str, kind: SegmentKind | None = None) -> PairedTest:
        """Test the squared error of ``other`` less that of ``name``; positive speaks for ``name``.

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
        """Return in how many segments zero mean difference stands, and how many were tested."""
        tests = [
            s.scores[name].samples if as_paper else s.scores[name].effective for s in self.segments
        ]
        done = [t for t in tests if np.isfinite(t.p_value)]
        return sum(not t.zero_is_rejected() for t in done), len(done)


def _weighted(pairs: list[tuple[int, float]]) -> PairedTest:
    """Test values of segments so that their mean is the mean over samples."""
    if not pairs:
        return over_blocks(np.empty(0))
    weight = np.array([n for n, _ in pairs], dtype=np.float64)
    return over_blocks(weight / weight.mean() * np.array([d for _, d in pairs]))


def judge(trial: Trial, predictions: Mapping[str, FloatArray]) -> Judgement:
    """Judge predictions on the special segments of other data.

    Parameters
    ----------
    trial : Trial
    predictions : mapping of float64 (n,)
        MW, by name.

    Raises
    ------
    DataError
        No special segment has enough rows that can be judged.
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
        segments.append(
            JudgedSegment(
                number, SegmentKind(int(kind)), int(trial.time_ns[a]), int(trial.time_ns[b - 1]),
                rows, float(measured.mean()), scores,
            )
        )  # fmt: skip
    return Judgement(tuple(segments), widening, outside)


def _nothing_judged(trial: Trial) -> str:
    if not len(trial.spans):
        return 'The data to judge by hold no special segment.'
    rows = np.concatenate([np.arange(a, b) for a, b, _ in trial.spans])
    low, high = float(trial.u[rows].min()), float(trial.u[rows].max())
    return (
        f'No special segment of the data to judge by can be judged: their u lies from {low:.4g} '
        f'to {high:.4g}, beyond what the curve is known for, or they follow a gap too closely.'
    )


def _widening(trial: Trial, predictions: Mapping[str, FloatArray], spans: IntArray) -> float:
    """Take the correlation in time from the prediction that leaves the least."""
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
    residual = np.where(trial.good, trial.power_mw - best, 0.0)
    return widening_of(residual, spans, trial.step_s)


def _score(difference: FloatArray, widening: float) -> Score:
    with np.errstate(over='ignore', invalid='ignore'):
        mse = float(np.mean(difference**2))
    if not np.isfinite(mse):
        none = PairedTest(float('nan'), float('nan'), float('nan'), float('nan'), 0.0)
        return Score(mse, none, none)
    return Score(mse, over_samples(difference), with_effective_size(difference, widening))
