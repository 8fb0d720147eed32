"""Numbers that a person types behind an option: read, or refused in words."""

from __future__ import annotations

import math
from argparse import ArgumentTypeError
from collections.abc import Callable


def number(
    wanted: str, low: float, high: float, example: str, *, above: bool = False
) -> Callable[[str], float]:
    """Return a reader of numbers for ``type=`` of an option.

    Parameters
    ----------
    wanted : str
        What is meant, with its unit: 'a number of days'.
    low, high : float
        The range; if it has no ends, any number that is finite.
    example : str
        How it would be written right: '--days 10'.
    above : bool
        ``low`` itself is too small.

    Returns
    -------
    callable
        It raises `ArgumentTypeError` that goes on after the option's name: 'must be a number
        of days above 0 and at most 400, such as --days 10; 'ten' is no number'.
    """
    # No powers of ten: a person reads 1000000 rather than 1e+06.
    first, last = f'{low:.15g}', f'{high:.15g}'
    between = f' above {first} and at most {last}' if above else f' from {first} to {last}'
    if math.isinf(low) and math.isinf(high):
        between = ''

    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            raise _refusal(wanted, between, example, f"'{text}' is no number") from None
        if not (math.isfinite(value) and low <= value <= high) or (above and value == low):
            raise _refusal(wanted, between, example, f"'{text}' is not")
        return value

    return read


def whole(wanted: str, low: int, high: int | None, example: str) -> Callable[[str], int]:
    """Return a reader of whole numbers; parameters and errors as of `number`."""
    between = f' of {low} or more' if high is None else f' from {low} to {high}'

    def read(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            raise _refusal(wanted, between, example, f"'{text}' is no whole number") from None
        if value < low or (high is not None and value > high):
            raise _refusal(wanted, between, example, f"'{text}' is not")
        return value

    return read


def _refusal(wanted: str, between: str, example: str, why: str) -> ArgumentTypeError:
    return ArgumentTypeError(f'must be {wanted}{between}, such as {example}; {why}')
