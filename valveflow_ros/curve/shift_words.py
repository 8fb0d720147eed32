"""The judgement of a shift in words an operator understands."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal

import numpy as np

from valveflow_ros.records import NS_PER_S, FloatArray

if TYPE_CHECKING:
    from valveflow_ros.curve.shift import PieceShift, Shift

_SURE = 0.9999


def shift_sentence(shift: Shift, knots: FloatArray) -> str:
    """Say which piece moved, by how much, since when and how surely; or that none did.

    Parameters
    ----------
    shift : Shift
    knots : float64 (J + 1,)
        Of the reference; less of it than all may have been compared.
    """
    return _judgement(shift) + _compared(shift, float(knots[0]), float(knots[-1]))


def _compared(shift: Shift, first: float, last: float) -> str:
    """Say what was compared if it is not the whole reference."""
    known = [p for p in shift.pieces if math.isfinite(p.u_from)]
    low, high = min(p.u_from for p in known), max(p.u_to for p in known)
    if low <= first and high >= last:
        return ''
    return f' Compared is u {low:.0f} to {high:.0f} of its u {first:.0f} to {last:.0f}.'


def _judgement(shift: Shift) -> str:
    known = [p for p in shift.pieces if math.isfinite(p.middle_mw)]
    reference = f'the reference of {day(shift.reference_ns)}'
    worst = shift.largest
    if worst is None:
        smallest = [p.smallest_mw for p in known if math.isfinite(p.smallest_mw)]
        if not smallest:
            return f'No shift against {reference} is seen, but no error of the curves is known.'
        low, high = min(smallest), max(smallest)
        span = f'{low:.1f}' if f'{low:.1f}' == f'{high:.1f}' else f'{low:.1f} to {high:.1f}'
        return (
            f'The curve agrees with {reference}; a shift of {span} MW, by piece, '
            'would have been seen.'
        )
    number = shift.pieces.index(worst) + 1
    side = 'more' if worst.shift_mw > 0.0 else 'less'
    others = [k + 1 for k, p in enumerate(shift.pieces) if p.moved and k + 1 != number]
    return (
        f'Piece {number} (u {worst.u_from:.0f} to {worst.u_to:.0f}) gives '
        f'{abs(worst.shift_mw):.1f} MW ({abs(worst.percent):.1f} %) {side} than {reference}, '
        f'{_since(shift)}, confidence {_confidence(worst)}.{_others(shift, others)}'
    )


def day(time_ns: int) -> str:
    """Write a date; a time that is not known says so."""
    return _at(time_ns, 'D') if time_ns > 0 else 'unknown date'


def minute(time_ns: int) -> str:
    """Write a date with hours and minutes, UTC."""
    return _at(time_ns, 'm').replace('T', ' ') + ' UTC'


def _at(time_ns: int, unit: Literal['D', 'm']) -> str:
    return str(np.datetime64(time_ns // NS_PER_S, 's').astype(f'datetime64[{unit}]'))


def _since(shift: Shift) -> str:
    if shift.since_ns > 0:
        return (
            f'since about {minute(shift.since_ns)} (between {minute(shift.since_low_ns)} and '
            f'{minute(shift.since_high_ns)})'
        )
    if shift.reference_ns >= shift.first_ns > 0:
        return 'since when cannot be told (the reference was made from the same days)'
    if shift.first_ns > 0:
        return f'with no change seen since {minute(shift.first_ns)}, so from before that'
    return 'since when is not known'


def _confidence(piece: PieceShift) -> str:
    if piece.confidence > _SURE:
        return f'above {100.0 * _SURE:.2f} %'
    return f'{100.0 * piece.confidence:.2f} %'


def _others(shift: Shift, numbers: list[int]) -> str:
    if not numbers:
        return ''
    told = ', '.join(f'piece {k} by {shift.pieces[k - 1].shift_mw:+.1f} MW' for k in numbers)
    return f' {told[0].upper()}{told[1:]} too.'
