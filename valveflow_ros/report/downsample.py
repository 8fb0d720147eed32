"""Fewer points for the eye; the numbers of the report never come from here."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from valveflow_ros.records import FloatArray, IntArray, SpecialSegment


@dataclass(frozen=True, slots=True)
class Envelope:
    """A signal as its lowest and highest value in each of many equal stretches of time.

    Attributes
    ----------
    start_ns, step_ns : int
        Time of the first point and from one point to the next.
    values : float64 (2 k,)
        Two points a stretch, in the order in which they occur; NaN where nothing was measured.
    """

    start_ns: int
    step_ns: float
    values: FloatArray


def envelope(time_ns: IntArray, values: FloatArray, stretches: int, period_ns: int) -> Envelope:
    """Reduce a signal to at most ``2 * stretches`` points that keep every peak.

    A short signal comes back with each of its values on its own grid place.
    """
    if not len(time_ns):
        return Envelope(0, 1.0, np.empty(0))
    span = int(time_ns[-1] - time_ns[0]) + period_ns
    k = max(1, min(stretches, span // (2 * period_ns)))
    width = span / k
    place = np.minimum(((time_ns - time_ns[0]) / width).astype(np.int64), k - 1)
    good = np.isfinite(values)
    place, value = place[good], values[good]
    out = np.full((k, 2), np.nan)
    if len(value):
        first = np.flatnonzero(np.diff(place, prepend=-1))
        where = place[first]
        low = np.minimum.reduceat(value, first)
        high = np.maximum.reduceat(value, first)
        rising = value[first] <= value[np.append(first[1:], len(value)) - 1]
        out[where, 0] = np.where(rising, low, high)
        out[where, 1] = np.where(rising, high, low)
    return Envelope(int(time_ns[0]), width / 2.0, out.ravel())


@dataclass(frozen=True, slots=True)
class Density:
    """How many samples fall into each cell of a grid.

    Attributes
    ----------
    x_from, x_step, y_from, y_step : float
        Centre of the first cell and distance of cells.
    counts : int64 (rows, columns)
    """

    x_from: float
    x_step: float
    y_from: float
    y_step: float
    counts: IntArray


def density(x: FloatArray, y: FloatArray, columns: int, rows: int) -> Density:
    """Count points in a grid that spans them."""
    x_low, x_high = _span(x)
    y_low, y_high = _span(y)
    counts, _, _ = np.histogram2d(
        y, x, bins=(rows, columns), range=((y_low, y_high), (x_low, x_high))
    )
    x_step, y_step = (x_high - x_low) / columns, (y_high - y_low) / rows
    return Density(
        x_low + 0.5 * x_step, x_step, y_low + 0.5 * y_step, y_step, counts.astype(np.int64)
    )


def _span(values: FloatArray) -> tuple[float, float]:
    """Return the ends of the values, a little apart even where all are equal."""
    if not len(values):
        return 0.0, 1.0
    low, high = float(values.min()), float(values.max())
    pad = max(1e-9, 1e-6 * abs(low)) if high <= low else 0.0
    return low - pad, high + pad


def thin(number: int, most: int) -> IntArray:
    """Return at most ``most`` of ``number`` places, evenly spread, both ends kept."""
    if number <= most:
        return np.arange(number, dtype=np.int64)
    return np.unique(np.linspace(0, number - 1, most).round().astype(np.int64))


def segment_rows(time_ns: IntArray, segments: list[SpecialSegment]) -> IntArray:
    """Return (first row, end row) of each segment within ``time_ns``, shape (k, 2)."""
    starts = np.array([s.start_ns for s in segments], dtype=np.int64)
    ends = np.array([s.end_ns for s in segments], dtype=np.int64)
    return np.column_stack(
        [
            np.searchsorted(time_ns, starts, side='left'),
            np.searchsorted(time_ns, ends, side='right'),
        ]
    ).astype(np.int64)


def segment_path(
    time_ns: IntArray, values: FloatArray, rows: IntArray, points: int
) -> tuple[FloatArray, FloatArray]:
    """Return times in ms and block means along segments, NaN between two segments.

    Parameters
    ----------
    rows : int64 (k, 2)
        First and end row of each segment.
    points : int
        About how many points all segments together may have.
    """
    total = int((rows[:, 1] - rows[:, 0]).sum()) if len(rows) else 0
    block = max(1, -(-total // max(1, points)))
    times, means = [], []
    for first, end in rows.tolist():
        edges = np.arange(first, end, block)
        if not len(edges):
            continue
        sizes = np.diff(np.append(edges, end))
        means += [np.add.reduceat(values[first:end], edges - first) / sizes, np.array([np.nan])]
        middle = np.minimum(edges + sizes // 2, end - 1)
        times += [time_ns[middle] / 1e6, np.array([np.nan])]
    if not times:
        return np.empty(0), np.empty(0)
    return np.concatenate(times), np.concatenate(means)
