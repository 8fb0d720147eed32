"""Causes held while a curve was fitted, as JSON."""

from __future__ import annotations

from typing import Any

from valveflow_ros.curve.characteristic import HeldCause
from valveflow_ros.curve.json_field import Field


def held_json(held: tuple[HeldCause, ...]) -> dict[str, Any]:
    """Return the causes under their key; a curve without any has no such key."""
    if not held:
        return {}
    return {
        'held': [{'name': h.name, 'values': dict(h.values), 'sentence': h.sentence} for h in held]
    }


def held_from(field: Field | None) -> tuple[HeldCause, ...]:
    """Read what `held_json` wrote.

    Raises
    ------
    DataError
        It is not that; the sentence names the place.
    """
    if field is None:
        return ()
    return tuple(
        HeldCause(
            f.key('name').text(),
            tuple((name, value.real()) for name, value in f.key('values').members()),
            f.key('sentence').text(),
        )
        for f in field.items()
    )
