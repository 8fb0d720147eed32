"""Words and units that several parts of the report share."""

from __future__ import annotations

import math
from fractions import Fraction

from valveflow_ros.curve.characteristic import HeldCause
from valveflow_ros.report.numbers import plain

_DATED = ('t0_days',)  # parameters that are moments


def exponent(value: float) -> str:
    """Write the pressure exponent as people know it: 9/8, or a decimal number."""
    near = Fraction(value).limit_denominator(16)
    if near.denominator > 1 and abs(float(near) - value) < 1e-9:
        return f'{near.numerator}/{near.denominator}'
    return plain(value, 4)


def input_unit(value: float) -> str:
    """Return the unit of u as HTML; m stands for an exponent that is not known."""
    return f'% MPa<sup>{exponent(value) if math.isfinite(value) else "m"}</sup>'


def input_unit_plain(value: float) -> str:
    """Return the unit of u as plain text: '% MPa^(9/8)'; of an exponent not known, '% MPa^m'."""
    if not math.isfinite(value):
        return '% MPa^m'
    power = exponent(value)
    return f'% MPa^({power})' if '/' in power else f'% MPa^{power}'


def input_title(value: float) -> str:
    """Return the title of an axis of u as HTML."""
    return f'integrated input u = V p<sup>{exponent(value)}</sup> ({input_unit(value)})'


def input_axis(value: float) -> dict[str, str]:
    """Return the title of an axis of u, and a short one for narrow pictures, as HTML."""
    return {'text': input_title(value), 'short': f'u ({input_unit(value)})'}


# Causes whose change is counted from the mean of the record, see `diagnosis.causes`.
_FROM_THE_MEAN = frozenset((
    'curve_step', 'gain_drift', 'gain_step', 'input_drift', 'input_step', 'intervals',
    'output_offset_drift',
))  # fmt: skip


def held_words(held: tuple[HeldCause, ...]) -> str:
    """Say which causes were taken out of the rows; nothing where none were."""
    if not held:
        return ''
    names = ', '.join(_held(h) for h in held)
    if any(h.name in _FROM_THE_MEAN for h in held):
        curve = (
            'What changes with time is counted from its mean over the record it was found in: the '
            'curve is that of this mean, neither that of before nor that of after. '
        )
    else:
        curve = f'The curve is that of the unit without {"it" if len(held) == 1 else "them"}. '
    return (
        f'Held, and taken out of opening and power before anything else: {names}. {curve}'
        + ' '.join(h.sentence for h in held)
    )


def _held(h: HeldCause) -> str:
    # When a cause began stands as a date in its sentence; a number of days says nothing.
    values = ', '.join(f'{n} = {value:.4g}' for n, value in h.values if n not in _DATED)
    return f'{h.name} ({values})' if values else h.name
