# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The inverse of the flow characteristic as a table for the turbine controller."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np

from valveflow_ros.curve.characteristic import (
    Characteristic,
    OpeningsSeen,
    Piece,
    curve_error,
    piece_of,
)
from valveflow_ros.errors import DataError, InputError
from valveflow_ros.records import FloatArray


def spread(x: FloatArray, y: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Add points to a broken line until it has ``count``; all corners are kept.

    The widest interval of x is divided first. Intervals of zero width are not divided.

    Parameters
    ----------
    x, y : float64 (n,)
        Corners; x is not decreasing.
    """
    width = np.diff(x)
    parts = np.ones(len(width), dtype=np.int64)
    for _ in range(max(0, count - len(x))):
        k = int(np.argmax(width / parts))
        if width[k] <= 0.0:
            break
        parts[k] += 1
    at = [np.linspace(x[k], x[k + 1], parts[k], endpoint=False) for k in range(len(width))]
    new_x = np.concatenate([*at, x[-1:]])
    share = [np.arange(n) / n for n in parts.tolist()]
    new_y = np.concatenate(
        [y[k] + (y[k + 1] - y[k]) * share[k] for k in range(len(width))] + [y[-1:]]
    )
    return new_x, new_y


def thin(x: FloatArray, y: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Keep ``count`` corners, including both ends, such that the largest error in x is minimal.

    The error in x is the difference of the line through the kept corners from an omitted
    corner at the same y. The choice is exact (dynamic programming).
    """
    n = len(x)
    cost = np.full((n, n), np.inf)
    for a in range(n):
        for b in range(a + 1, n):
            cost[a, b] = _error(x, y, a, b)
    best = np.full((count, n), np.inf)
    came = np.zeros((count, n), dtype=np.int64)
    best[0, 0] = 0.0
    for used in range(1, count):
        for b in range(1, n):
            worst = np.maximum(best[used - 1, :b], cost[:b, b])
            came[used, b] = int(np.argmin(worst))
            best[used, b] = worst[came[used, b]]
    used, b = int(np.argmin(best[:, n - 1])), n - 1
    kept = [b]
    while used > 0:
        b = int(came[used, b])
        kept.append(b)
        used -= 1
    index = np.array(kept[::-1])
    return x[index], y[index]


def _error(x: FloatArray, y: FloatArray, a: int, b: int) -> float:
    """Return the largest error in x at the corners between two kept ones."""
    if b == a + 1:
        return 0.0
    if y[b] == y[a]:
        return float(np.inf)
    line = x[a] + (x[b] - x[a]) * (y[a + 1 : b] - y[a]) / (y[b] - y[a])
    return float(np.max(np.abs(line - x[a + 1 : b])))


# Width of a band of the pressure, relative to the median; share of the rows left out on each
# side of the openings of a band; fewer rows are no operation.
_BAND, _OUTSIDE, _LEAST_ROWS = 0.05, 0.005, 10
_JOINED_MW = 1e-6  # smaller differences of two pieces' ends are rounding, not jumps
_CHECKED = 20_001  # number of powers at which the inverse is tested
_STEEP = 5.0  # default gain limit, as a multiple of the smallest gain


@dataclass(frozen=True, slots=True)
class Compensation:
    """The table from demanded power to integrated input, of n points."""

    power_mw: FloatArray  # (n,), increasing
    u: FloatArray  # (n,), not decreasing
    u_stderr: FloatArray  # (n,)
    gain: FloatArray  # (n,) units of u per MW to the next point; the last one is repeated
    within: np.ndarray  # bool (n,): the gain from this row to the next is within its limit
    curve: Characteristic  # the part of the curve that was inverted
    gains: FloatArray  # (J,) units of u per MW of each of its pieces
    gain_limit: float
    largest_step: float  # largest ratio of the gains of two neighbouring pieces, 1 or more
    useful_mw: tuple[float, float]  # widest range over which the gain stays within its limit
    identity_mw: float  # largest `|F(F^-1(x)) - x|` over the whole range, without jumps
    table_mw: float  # largest error of interpolation in the rounded table, in MW and in u
    table_u: float
    jumps: tuple[tuple[float, float, float], ...]  # u, and the powers below and above
    first_piece: int  # number of the first of these pieces in the whole curve, from 1
    notes: tuple[str, ...]


def compensate(
    curve: Characteristic, points: int = 16, gain_limit: float | None = None,
    u_from: float = -math.inf, u_to: float = math.inf, places: int = 4,
) -> Compensation:  # fmt: skip
    """Invert a curve.

    Raises `DataError` if the curve does not always rise; the message names the piece and gives
    advice. Raises `InputError` if ``points`` or the range is invalid for a table.

    Parameters
    ----------
    points : int
        Length of the table, 2 or more. With J + 1 or more points the table contains all knots
        and linear interpolation is exact; with fewer, those knots are kept that minimise
        the largest error in power.
    gain_limit : float, optional
        Gain in units of u per MW above which the table is not useful; by default five times the
        smallest gain of the curve.
    u_from, u_to : float
        The range of u; the rest of the curve is left out.
    places : int
        Decimals of power and u in the table; the reported errors include the rounding.

    Raises
    ------
    DataError
        The curve does not always rise; the message names the piece and gives advice.
    InputError
        ``points`` or the range is invalid for a table.
    """
    if points < 2:
        raise InputError(f'A table needs 2 points or more, not {points}.')
    cut, first = _cut(curve, u_from, u_to)
    _rises(cut, first)
    x, u = _corners(cut)
    exact = len(x)
    x, u = spread(x, u, points) if points >= exact else thin(x, u, points)
    gain = np.diff(u) / np.maximum(np.diff(x), 1e-300)
    gain = np.where(np.diff(x) > 0.0, gain, math.inf)
    gain = np.append(gain, gain[-1])
    x, u = np.round(x, places), np.round(u, places)
    gains = np.array([1.0 / p.slope for p in cut.pieces])
    limit = _STEEP * float(gains.min()) if gain_limit is None else gain_limit
    table_mw, table_u = _table_errors(cut, x, u)
    made = Compensation(
        power_mw=x, u=u, u_stderr=_u_error(cut, u), gain=gain,
        within=gain <= limit * (1.0 + 1e-9), curve=cut, gains=gains, gain_limit=limit,
        largest_step=_largest_step(gains), useful_mw=_useful(cut, gains, limit),
        identity_mw=_identity(cut), table_mw=table_mw, table_u=table_u, jumps=_jumps(cut),
        first_piece=first, notes=(),
    )  # fmt: skip
    return replace(made, notes=_notes(made, points, exact))


def _cut(curve: Characteristic, u_from: float, u_to: float) -> tuple[Characteristic, int]:
    """Return the curve between two u, and the number of its first piece."""
    knots = curve.breakpoints
    low, high = max(u_from, float(knots[0])), min(u_to, float(knots[-1]))
    if not low < high:
        raise InputError(
            f'The curve is known for u from {knots[0]:.1f} to {knots[-1]:.1f}; '
            f'nothing of it lies between {u_from:g} and {u_to:g}.'
        )
    kept = [
        (k, replace(p, u_from=max(p.u_from, low), u_to=min(p.u_to, high)))
        for k, p in enumerate(curve.pieces)
        if p.u_from < high and p.u_to > low
    ]
    inner = tuple(curve.breakpoint_intervals[k] for k, _ in kept[:-1])
    part = replace(curve, pieces=tuple(p for _, p in kept), breakpoint_intervals=inner)
    return part, kept[0][0] + 1


def _end(piece: Piece, u: float) -> float:
    return piece.slope * u + piece.intercept


def _rises(curve: Characteristic, first: int) -> None:
    """Raise `DataError` if a curve has no inverse."""
    what = (
        'Identify from data in which the unit moves more there, or leave that part out with '
        '--u-from and --u-to.'
    )
    for number, piece in enumerate(curve.pieces, first):
        if piece.slope <= 0.0:
            does = 'falls' if piece.slope < 0.0 else 'is level'
            raise DataError(
                f'The curve has no inverse: piece {number} (u {piece.u_from:.1f} to '
                f'{piece.u_to:.1f}) {does} ({piece.slope:.4g} MW per unit of u), so one power '
                f'belongs to several openings. {what}'
            )
    for number, (a, b) in enumerate(itertools.pairwise(curve.pieces), first):
        drop = _end(a, a.u_to) - _end(b, b.u_from)
        if drop > _JOINED_MW:
            raise DataError(
                f'The curve has no inverse: at u = {a.u_to:.1f}, between pieces {number} and '
                f'{number + 1}, it falls by {drop:.3g} MW. {what}'
            )


def _jumps(curve: Characteristic) -> tuple[tuple[float, float, float], ...]:
    ends = [
        (a.u_to, _end(a, a.u_to), _end(b, b.u_from)) for a, b in itertools.pairwise(curve.pieces)
    ]
    return tuple((u, low, high) for u, low, high in ends if high - low > _JOINED_MW)


def _corners(curve: Characteristic) -> tuple[FloatArray, FloatArray]:
    """Return power and u of the corners; a jump has two."""
    x: list[float] = []
    u: list[float] = []
    for piece in curve.pieces:
        low = _end(piece, piece.u_from)
        if not (x and abs(low - x[-1]) <= _JOINED_MW):
            x.append(low)
            u.append(piece.u_from)
        x.append(_end(piece, piece.u_to))
        u.append(piece.u_to)
    return np.array(x), np.array(u)


def corner_count(curve: Characteristic) -> int:
    """Return the number of points with which a table of this curve is exact."""
    return len(_corners(curve)[0])


def _identity(curve: Characteristic) -> float:
    """Return the largest difference of F(F^-1(x)) from x, outside jumps."""
    x, _ = _corners(curve)
    powers = np.unique(np.concatenate([np.linspace(x[0], x[-1], _CHECKED), x]))
    inside = np.zeros(len(powers), dtype=bool)
    for _, low, high in _jumps(curve):
        inside |= (powers >= low) & (powers <= high)
    powers = powers[~inside]
    back = curve.model.static(curve.inverse(powers))
    # A power at an end may exceed the range of the curve by a rounding error.
    back = np.where(np.isnan(back) & ((powers == x[0]) | (powers == x[-1])), powers, back)
    return float(np.max(np.abs(back - powers), initial=0.0))


def _table_errors(curve: Characteristic, x: FloatArray, u: FloatArray) -> tuple[float, float]:
    """Return the largest error of interpolating in the table, in MW and in u.

    All three lines are straight between the corners, so the errors at the corners suffice.
    """
    corners_x, corners_u = _corners(curve)
    rises = np.append(True, np.diff(u) > 0.0)
    power_at = np.interp(corners_u, u[rises], x[rises])
    jumping = np.zeros(len(corners_u), dtype=bool)
    for place, _, _ in _jumps(curve):
        jumping |= corners_u == place
    at_table = np.abs(curve.model.static(np.clip(u, corners_u[0], corners_u[-1])) - x)
    for _, low, high in _jumps(curve):
        at_table[(x >= low - 1e-3) & (x <= high + 1e-3)] = 0.0
    off_mw = np.abs(power_at - corners_x)[~jumping]
    off_u = np.abs(np.interp(corners_x, x, u) - corners_u)
    return float(max(off_mw.max(initial=0.0), at_table.max(initial=0.0))), float(off_u.max())


def _u_error(curve: Characteristic, u: FloatArray) -> FloatArray:
    """Return the standard error of F^-1: that of F divided by the slope; at a knot the larger."""
    slopes = np.array([p.slope for p in curve.pieces])
    span = float(curve.breakpoints[-1] - curve.breakpoints[0])
    error = np.zeros(len(u))
    for side in (-1e-9, 1e-9):
        at = np.clip(u + side * span, curve.breakpoints[0], curve.breakpoints[-1])
        error = np.fmax(error, curve_error(curve, at) / slopes[piece_of(curve, at)])
    known = all(math.isfinite(p.slope_stderr) for p in curve.pieces)
    return error if known else np.where(error > 0.0, error, math.nan)


def _largest_step(gains: FloatArray) -> float:
    if len(gains) < 2:
        return 1.0
    ratio = gains[1:] / gains[:-1]
    return float(np.maximum(ratio, 1.0 / ratio).max())


def _useful(curve: Characteristic, gains: FloatArray, limit: float) -> tuple[float, float]:
    """Return the widest range of power in which no piece has a gain above the limit."""
    best, begun = (math.nan, math.nan), None
    for piece, gain in zip(curve.pieces, gains, strict=True):
        if gain > limit:
            begun = None
            continue
        begun = _end(piece, piece.u_from) if begun is None else begun
        high = _end(piece, piece.u_to)
        if not high - begun <= best[1] - best[0]:
            best = (begun, high)
    return best


def _notes(made: Compensation, points: int, exact: int) -> tuple[str, ...]:
    notes = [
        f'Below {made.power_mw[0]:.2f} MW and above {made.power_mw[-1]:.2f} MW nothing is known '
        'of the valve: the controller must hold u at the end of the table there.'
    ]
    pairs = zip(made.curve.pieces, made.gains, strict=True)
    for number, (piece, gain) in enumerate(pairs, made.first_piece):
        if gain > made.gain_limit:
            notes.append(
                f'Piece {number} (u {piece.u_from:.0f} to {piece.u_to:.0f}, '
                f'{_end(piece, piece.u_from):.1f} to {_end(piece, piece.u_to):.1f} MW) hardly '
                f'answers: 1 MW takes {gain:.3g} units of u (limit {made.gain_limit:.3g}), so '
                'noise of the demand would drive the valve to and fro; do not use the table there.'
            )
    for u, low, high in made.jumps:
        notes.append(
            f'At u = {u:.1f} the curve jumps from {low:.2f} to {high:.2f} MW: demands between '
            'the two get the same u and are not met exactly.'
        )
    if points < exact:
        notes.append(
            f'{exact} points would make the table exact; with {points} interpolation is off by '
            f'up to {made.table_mw:.3g} MW.'
        )
    return tuple(notes)


def openings_seen(opening: FloatArray, pressure: FloatArray) -> tuple[OpeningsSeen, ...]:
    """Return the openings at which a unit ran, by bands of the pressure.

    Parameters
    ----------
    opening, pressure : float64 (n,)
        %, MPa; rows with NaN are ignored.
    """
    known = np.isfinite(opening) & np.isfinite(pressure)
    v, p = opening[known], pressure[known]
    if len(p) < _LEAST_ROWS:
        return ()
    low, high = np.quantile(p, (_OUTSIDE, 1.0 - _OUTSIDE)).tolist()
    count = max(1, math.ceil((high - low) / max(_BAND * abs(float(np.median(p))), 1e-9)))
    edges = np.linspace(low, high, count + 1)
    band = np.searchsorted(edges[1:-1], p, side='right')
    band[(p < low) | (p > high)] = -1
    found = []
    for k in range(count):
        here = v[band == k]
        if len(here) >= _LEAST_ROWS:
            least, most = np.quantile(here, (_OUTSIDE, 1.0 - _OUTSIDE)).tolist()
            ends = float(edges[k]), float(edges[k + 1])
            found.append(OpeningsSeen(*ends, least, most, len(here)))
    return tuple(found)


def seen_at(curve: Characteristic, pressure_mpa: float) -> tuple[float, float] | None:
    """Return the range of openings seen at a pressure; None if the unit did not run at it.

    The pressure may lie outside the bands of the curve by half the width of one.
    """

    def away(band: OpeningsSeen) -> float:
        low, high = band.pressure_from_mpa, band.pressure_to_mpa
        return max(low - pressure_mpa, pressure_mpa - high, 0.0)

    nearest = min(curve.openings_seen, key=away, default=None)
    if nearest is None:
        return None
    most = 0.5 * max(_BAND * pressure_mpa, nearest.pressure_to_mpa - nearest.pressure_from_mpa)
    if away(nearest) > most:
        return None
    return nearest.opening_from_percent, nearest.opening_to_percent
