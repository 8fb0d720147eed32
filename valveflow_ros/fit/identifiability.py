"""Whether each piece rests on data of its own: the condition after Proposition 2 of the paper.

Slope and intercept of a piece are determined by the special segments inside it when these
are linearly independent: two steady states at different levels, or a slope response that
crosses different levels. Where that does not hold, the piece's numbers come from its
neighbours through the joins, or from moves between segments, and a person should know.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from valveflow_ros.curve.characteristic import Characteristic, Piece, Support
from valveflow_ros.errors import counted
from valveflow_ros.records import FloatArray, SegmentKind
from valveflow_ros.segments.window import WindowContents

NOT_REFINED = 'The curve is not refined: '  # how a note on that begins
_LEAST_ROWS = 30  # of a segment on a piece, for it to count there
_APART = 10.0  # noise sd of u between two levels that are called different


def with_support(
    c: Characteristic, contents: WindowContents, input_noise: float
) -> Characteristic:
    """Return the characteristic with the support of its pieces, and a note on each without.

    Parameters
    ----------
    c : Characteristic
    contents : WindowContents
        The rows and special segments it was fitted to.
    input_noise : float
        Noise sd of block means of u.
    """
    support = tuple(
        support_of(piece, contents, input_noise, last=k == len(c.pieces) - 1)
        for k, piece in enumerate(c.pieces)
    )
    notes = [
        _sentence(k + 1, piece, found)
        for k, (piece, found) in enumerate(zip(c.pieces, support, strict=True))
        if not found.identifiable
    ]
    return replace(c, support=support, notes=(*c.notes, *notes))


def weaknesses(c: Characteristic) -> tuple[str, ...]:
    """Return the notes that report a weakness; others only tell how a curve was made."""
    without = sum(1 for found in c.support if not found.identifiable)
    unrefined = [n for n in c.notes[: len(c.notes) - without] if n.startswith(NOT_REFINED)]
    return (*unrefined, *c.notes[len(c.notes) - without :])


def support_of(
    piece: Piece, contents: WindowContents, input_noise: float, last: bool = True
) -> Support:
    """Count the special segments inside a piece, and judge them.

    A segment counts where half a minute of rows or half of it lies inside. The upper end
    belongs to the piece only where it is the ``last``.
    """
    steady = slope = samples = 0
    levels: list[float] = []
    crossing = False
    apart = _APART * input_noise
    for first, end, kind in contents.spans.tolist():
        u = contents.u[first:end]
        below = u <= piece.u_to if last else u < piece.u_to
        inside = u[(u >= piece.u_from) & below]
        samples += len(inside)
        if len(inside) < min(_LEAST_ROWS, (end - first + 1) // 2):
            continue
        if kind == SegmentKind.STEADY:
            steady += 1
            levels.append(float(np.median(inside)))
        else:
            slope += 1
            low, high = np.quantile(inside, (0.1, 0.9))
            crossing = crossing or bool(high - low > apart)
    distinct = _distinct(levels, apart)
    return Support(
        steady=steady,
        slope_response=slope,
        samples=samples,
        levels=tuple(distinct),
        identifiable=crossing or len(distinct) >= 2,
    )


def _distinct(levels: list[float], apart: float) -> list[float]:
    """Return levels of which each lies more than ``apart`` above the one before."""
    found: list[float] = []
    for level in sorted(levels):
        if not found or level - found[-1] > apart:
            found.append(level)
    return found


def _sentence(number: int, piece: Piece, found: Support) -> str:
    """Say what a piece rests on, and what would settle it."""
    name = f'Piece {number} (u {piece.u_from:.0f} to {piece.u_to:.0f})'
    if not found.samples:
        rests = 'rests on no special sample'
    elif not found.levels and not found.slope_response:
        few = counted(found.samples, 'sample')
        rests = f'rests on no special segment, only on {few} at their ends'
    elif not found.levels:
        rests = 'rests on slope responses that hardly move in it'
    else:
        rests = f'rests on one steady level, u {found.levels[0]:.0f}'
    places = _missing(piece, np.array(found.levels))
    loads = ' and '.join(f'u {u:.0f} ({piece.slope * u + piece.intercept:.0f} MW)' for u in places)
    each = ' each' if len(places) > 1 else ''
    return (
        f'{name} {rests}: its slope comes from the neighbours and from fast moves; '
        f'an hour{each} at {loads} would settle it.'
    )


def _missing(piece: Piece, levels: FloatArray) -> list[float]:
    """Return where steady states are missing: two places, or the one farther from a level."""
    width = piece.u_to - piece.u_from
    places = [piece.u_from + share * width for share in (0.2, 0.8)]
    if not len(levels):
        return places
    return [max(places, key=lambda u: abs(u - float(levels[0])))]
