"""Words and units that several parts of the report share."""

from __future__ import annotations

from fractions import Fraction

from valveflow_ros.report.numbers import plain


def exponent(value: float) -> str:
    """Write the pressure exponent as people know it: 9/8, or a decimal number."""
    near = Fraction(value).limit_denominator(16)
    if near.denominator > 1 and abs(float(near) - value) < 1e-9:
        return f'{near.numerator}/{near.denominator}'
    return plain(value, 4)


def input_unit(value: float) -> str:
    """Return the unit of u as HTML."""
    return f'% MPa<sup>{exponent(value)}</sup>'


def input_title(value: float) -> str:
    """Return the title of an axis of u as HTML."""
    return f'integrated input u = V p<sup>{exponent(value)}</sup> ({input_unit(value)})'
