# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Schema of JSON from untrusted files; `checked` validates a value by a schema.

A schema is a dict of its keys, or one of the classes here. Every error names its place.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any

from valveflow_ros.errors import DataError


@dataclass(frozen=True, slots=True)
class Number:
    """A number from ``low`` to ``high``; with ``null`` also null, which becomes NaN."""

    low: float
    high: float
    null: bool = False


@dataclass(frozen=True, slots=True)
class Count:
    """An integer from 0 to ``high``."""

    high: int = 2**53


@dataclass(frozen=True, slots=True)
class Text:
    """A text; one of ``words`` if they are given."""

    words: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Flag:
    """True or false."""


@dataclass(frozen=True, slots=True)
class ListOf:
    """A list of ``least`` to ``most`` entries; with ``rising`` they are strictly increasing."""

    of: Any
    least: int = 0
    most: int = 10_000
    rising: bool = False


@dataclass(frozen=True, slots=True)
class Members:
    """An object with any keys; with ``pieces`` the keys are numbers of pieces."""

    of: Any
    pieces: bool = False


@dataclass(frozen=True, slots=True)
class Maybe:
    """The value of an optional key; a missing key becomes None."""

    of: Any
    or_empty: bool = False


# Possible values of a plant, from the outer bounds of the parameters: -50 to 1000 % and 100 MPa
# to the power of 2; the power of an extrapolated curve may be a hundred times too large.
U, MW, DEGC = (-5e5, 1e7), (-1e7, 1e7), (-273.15, 1000.0)
NS = 2**63 - 1
MOST_PIECES = 100


def checked(value: Any, schema: Any, whole: str, path: str = '') -> Any:
    """Return the JSON value validated by the schema; keys that the schema lacks are left out.

    Raises `DataError` if a value is missing or invalid; the message names the place.

    Parameters
    ----------
    value : object
        A value from `json.loads`.
    schema : object
    whole, path : str
        The name of the file in messages, and the place in it.
    """
    place = whole, path
    if isinstance(schema, dict):
        return _object(value, schema, whole, path)
    if isinstance(schema, Members):
        if not isinstance(value, dict):
            raise fail(*place, 'is not an object')
        names = {name: _pieces(name, *place) if schema.pieces else name for name in value}
        return {names[k]: checked(v, schema.of, whole, f'{path}.{k}') for k, v in value.items()}
    if isinstance(schema, ListOf):
        return _list(value, schema, whole, path)
    if isinstance(schema, Flag | Text):
        kind, problem = (bool, 'neither true nor false') if isinstance(schema, Flag) else (
            str, 'not a text'
        )  # fmt: skip
        if not isinstance(value, kind) or value not in (getattr(schema, 'words', ()) or (value,)):
            raise fail(*place, f'is {problem}' if not isinstance(value, kind) else 'is unknown')
        return value
    if isinstance(value, bool) or not isinstance(value, int | float):
        if value is None and getattr(schema, 'null', False):
            return math.nan
        raise fail(*place, 'is not a number' if isinstance(schema, Number) else 'is not a count')
    if isinstance(schema, Count):
        if not isinstance(value, int) or not 0 <= value <= schema.high:
            raise fail(*place, f'is not a count from 0 to {schema.high}')
        return value
    if not schema.low <= value <= schema.high:
        raise fail(*place, f'is out of range ({schema.low:g} to {schema.high:g})')
    return float(value)


def fail(whole: str, path: str, problem: str) -> DataError:
    """Return an error that describes the problem at a place."""
    return DataError(f"The {whole} cannot be used: '{path}' {problem}.")


def _object(value: Any, schema: dict[str, Any], whole: str, path: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise fail(whole, path, 'is not an object')
    found: dict[str, Any] = {}
    for name, part in schema.items():
        inner = f'{path}.{name}' if path else name
        optional = isinstance(part, Maybe)
        if name not in value or (optional and part.or_empty and value[name] == {}):
            if not optional:
                raise fail(whole, inner, 'is missing')
            found[name] = None
        else:
            found[name] = checked(value[name], part.of if optional else part, whole, inner)
    return found


def _list(value: Any, schema: ListOf, whole: str, path: str) -> list[Any]:
    if not isinstance(value, list):
        raise fail(whole, path, 'is not a list')
    if not schema.least <= len(value) <= schema.most:
        alone = f'{schema.least}' if schema.least == schema.most else f'at least {schema.least}'
        many = f'at most {schema.most}' if len(value) > schema.most > schema.least else alone
        raise fail(whole, path, f'is empty: it must have {many} entries' if not value else
                   f'must have {many} entries')  # fmt: skip
    found = [checked(v, schema.of, whole, f'{path}[{k}]') for k, v in enumerate(value)]
    if schema.rising and any(b <= a for a, b in itertools.pairwise(found)):
        raise fail(whole, path, 'do not rise')
    return found


def _pieces(name: Any, whole: str, path: str) -> int:
    short = isinstance(name, str) and name.isascii() and name.isdecimal() and len(name) <= 3
    if not (short and 1 <= int(name) <= MOST_PIECES):
        raise fail(whole, path, 'has a key that is no number of pieces')
    return int(name)
