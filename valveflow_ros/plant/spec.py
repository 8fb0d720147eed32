# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""An effect with the values of its parameters, as requested by a user."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from valveflow_ros.errors import InputError, ParameterError
from valveflow_ros.parameters import Parameter, Value
from valveflow_ros.plant.effect import DAY_S, Effect, Hooks, Values
from valveflow_ros.plant.effects import catalogue


@dataclass(frozen=True, slots=True)
class EffectSpec:
    """An effect and the checked values of all its parameters.

    Created by `parse` or `of`; ``str`` returns a text that `parse` can read.
    """

    effect: Effect
    values: Values

    @property
    def name(self) -> str:
        """Return the name in the catalogue."""
        return self.effect.name

    @property
    def parameters(self) -> dict[str, Value]:
        """Return all parameters with their values, including default values."""
        return dict(self.values.pairs)

    def __str__(self) -> str:
        """Return ``name:key=value,...`` with every parameter."""
        pairs = ','.join(f'{key}={value}' for key, value in self.values.pairs)
        return f'{self.name}:{pairs}'

    @classmethod
    def parse(cls, text: str, known: Mapping[str, Effect] | None = None) -> EffectSpec:
        """Read ``NAME`` or ``NAME:key=value,...``; other parameters keep their defaults.

        ``known`` are the effects by name, by default those of the catalogue. Raises `InputError`
        for an unknown effect or parameter, a value that is missing, no number or out of range, or
        a parameter given twice; the message lists the known names.
        """
        name, colon, rest = text.strip().partition(':')
        effect = _lookup(name.strip(), known or catalogue())
        given: dict[str, Value] = {}
        for part in rest.split(',') if colon and rest.strip() else []:
            key, equals, word = (piece.strip() for piece in part.partition('='))
            if not key or not equals or not word:
                raise InputError(
                    f"Effect '{effect.name}': '{part.strip()}' is not of the form key=value."
                )
            if key in given:
                raise InputError(f"Effect '{effect.name}': {key} is given twice.")
            given[key] = _read(effect, _parameter(effect, key), word)
        return cls.of(effect, **given)

    @classmethod
    def of(cls, effect: Effect | str, **given: Value) -> EffectSpec:
        """Set parameters by keyword; ``effect`` may also be one outside the catalogue.

        Raises `InputError` as `parse`.
        """
        if isinstance(effect, str):
            effect = _lookup(effect, catalogue())
        for key in given:
            _parameter(effect, key)
        pairs = []
        for row in effect.parameters:
            try:
                pairs.append((row.name, row.check(given.get(row.name, row.default))))
            except ParameterError as error:
                raise InputError(f"Effect '{effect.name}': {row.name} {error.problem}.") from None
        values = Values(tuple(pairs))
        if problem := effect.problem(values):
            raise InputError(f"Effect '{effect.name}': {problem}.")
        return cls(effect, values)


def install(specs: Sequence[EffectSpec], hooks: Hooks) -> None:
    """Install effects in the hooks of a run, in the order of their names.

    The order in which they were given has no influence, so that a set of effects always gives the
    same plant, bit for bit. Raises `InputError` if an effect begins after the end of the run, or
    two effects need the same place.
    """
    for spec in sorted(specs, key=str):
        start, days = spec.effect.starts_days(spec.values), hooks.length_s / DAY_S
        if start >= days:
            raise InputError(
                f"Effect '{spec.name}' would begin after {start:g} days, but the simulation "
                f'lasts {days:g}: simulate longer or let it begin earlier.'
            )
        spec.effect.install(spec.values, hooks)


def describe(effect: Effect) -> str:
    """Return one line for the effect and one for each parameter, for the user."""
    lines = [f'{effect.name}: {effect.summary}']
    for row in effect.parameters:
        span = ', '.join(row.choices) if row.choices else f'{row.low:g} to {row.high:g}'
        unit = f' {row.unit}' if row.unit else ''
        lines.append(f'  {row.name}={row.default}{unit}: {row.sentence} ({span})')
    return '\n'.join(lines)


def _lookup(name: str, known: Mapping[str, Effect]) -> Effect:
    if name in known:
        return known[name]
    close = difflib.get_close_matches(name, known, n=1)
    hint = f" Did you mean '{close[0]}'?" if close else ''
    raise InputError(f"Effect '{name}' is unknown: use one of {', '.join(known)}.{hint}")


def _parameter(effect: Effect, key: str) -> Parameter:
    for row in effect.parameters:
        if row.name == key:
            return row
    known = ', '.join(
        f'{row.name} ({row.unit})' if row.unit else row.name for row in effect.parameters
    )
    raise InputError(f"Effect '{effect.name}' has no parameter '{key}': it has {known}.")


def _read(effect: Effect, row: Parameter, word: str) -> Value:
    if isinstance(row.default, str):
        return word
    kind = int if isinstance(row.default, int) else float
    try:
        return kind(word)
    except ValueError:
        noun = 'whole number' if kind is int else 'number'
        raise InputError(
            f"Effect '{effect.name}': {row.name} must be a {noun}, not '{word}'."
        ) from None
