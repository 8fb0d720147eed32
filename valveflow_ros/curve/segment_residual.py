"""By how much each special segment differs from a curve, from the segments' records alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from valveflow_ros.curve.change_point import scan
from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.curve.line_error import piece_of
from valveflow_ros.records import FloatArray, IntArray, SegmentKind, SpecialSegment

_MOST_WEIGHT = 900.0
_KNOWN = 0.01  # chance below which a change within the reference's data is taken for one
_POINTS = 64  # along a ramp, for the mean of a curve with knees


@dataclass(frozen=True, slots=True)
class SegmentResiduals:
    """Segments against one curve, in order of time; all arrays have shape (n,).

    Attributes
    ----------
    time_ns : int64
        Middle of the segment.
    u : float64
        Middle of the segment, % MPa^m.
    residual_mw : float64
        Mean power less what the curve gives.
    samples : int64
    """

    time_ns: IntArray
    u: FloatArray
    residual_mw: FloatArray
    samples: IntArray

    def __len__(self) -> int:
        """Return the number of segments."""
        return len(self.time_ns)

    @property
    def weights(self) -> FloatArray:
        """Return inverse variances up to a factor, shape (n,).

        A longer segment averages its own noise away, but not the slow disturbances that
        long and short ones share.
        """
        return np.minimum(self.samples.astype(np.float64), _MOST_WEIGHT)

    def inside(self, low: float, high: float) -> SegmentResiduals:
        """Return the segments whose middle lies in ``[low, high)``."""
        return self.part((self.u >= low) & (self.u < high))

    def count_until(self, time_ns: int) -> int:
        """Return the number of segments up to a time."""
        return int(np.searchsorted(self.time_ns, time_ns, side='right'))

    def part(self, keep: np.ndarray) -> SegmentResiduals:
        """Return the segments chosen by a mask or an index."""
        return SegmentResiduals(
            self.time_ns[keep], self.u[keep], self.residual_mw[keep], self.samples[keep]
        )


def segment_residuals(
    curve: Characteristic, segments: Sequence[SpecialSegment]
) -> SegmentResiduals:
    """Return the mean residual of each segment inside the curve's range.

    On a ramp the power lags by ``K_f eta_1 (T + tau)``, the term eq. (14) of the paper
    drops: it is taken off with the dynamics of the curve. A curve without dynamics judges
    steady-state segments only.
    """
    known = bool(curve.dynamics)
    knots = curve.breakpoints
    kept = [
        s for s in segments
        if min(s.u_start, s.u_end) >= knots[0] and max(s.u_start, s.u_end) <= knots[-1]
        and (known or s.kind == SegmentKind.STEADY)
    ]  # fmt: skip
    kept.sort(key=lambda s: s.end_ns)
    middle = np.array([0.5 * (s.u_start + s.u_end) for s in kept])
    measured = np.array([0.5 * (s.power_start_mw + s.power_end_mw) for s in kept])
    return SegmentResiduals(
        np.array([(s.start_ns + s.end_ns) // 2 for s in kept], dtype=np.int64),
        middle,
        measured - _expected(curve, kept, middle),
        np.array([s.samples for s in kept], dtype=np.int64),
    )


def _expected(
    curve: Characteristic, segments: Sequence[SpecialSegment], middle: FloatArray
) -> FloatArray:
    """Return the mean power the curve gives along each segment."""
    if not segments:
        return np.empty(0)
    model = curve.model
    share = (np.arange(_POINTS) + 0.5) / _POINTS
    ends = np.array([[s.u_start, s.u_end] for s in segments])
    u = ends[:, :1] + (ends[:, 1:] - ends[:, :1]) * share
    flow = model.static(u).mean(axis=1)
    if not curve.dynamics:
        return np.asarray(flow)
    region = np.searchsorted(model.levels, flow)
    behind_s = (model.time_constants + model.delays)[region]
    rate = np.array([s.u_rate_per_s if s.kind == SegmentKind.SLOPE else 0.0 for s in segments])
    return np.asarray(flow - model.slopes()[piece_of(curve, middle)] * rate * behind_s)


def after_known_changes(series: SegmentResiduals, known_ns: int) -> SegmentResiduals:
    """Return the segments from the last change on that lies before a time.

    Parameters
    ----------
    series : SegmentResiduals
    known_ns : int
        End of the reference's data: what changed before it is in the reference, and is no
        shift away from it.
    """
    known = series.part(np.arange(series.count_until(known_ns)))
    found = scan(known.residual_mw, known.weights)
    if found is None or found.p_value > _KNOWN:
        return series
    return series.part(np.arange(found.place, len(series)))
