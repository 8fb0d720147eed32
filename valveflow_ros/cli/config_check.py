"""Reads a parameter file as the monitor would."""

from __future__ import annotations

from pathlib import Path

from valveflow_ros.cli.console import Outcome
from valveflow_ros.cli.options import read_parameters
from valveflow_ros.errors import InputError, ParameterError, counted
from valveflow_ros.parameters import PARAMETERS, Settings, Value


def check(file: Path) -> Outcome:
    """Say what a parameter file changes.

    Raises
    ------
    RecordingError, InputError
        It cannot be read, or the monitor would refuse it; the sentence names the parameter.
    """
    given = read_parameters(file, [])
    try:
        settings = Settings(given)
    except ParameterError as error:
        raise InputError(f'{file}: {error}') from None
    changed = {
        name: settings[name] for name in settings if settings[name] != PARAMETERS[name].default
    }
    lines = [
        f'{file}: the monitor takes it; {counted(len(given), "parameter")}, {_many(len(changed))}.'
    ]
    lines += [f'  {name}: {_shown(name, value)}, default {_shown(name, PARAMETERS[name].default)}'
              for name, value in changed.items()]  # fmt: skip
    return Outcome('\n'.join(lines), {'file': str(file), 'good': True, 'changed': changed})


def _many(n: int) -> str:
    if not n:
        return 'all as the defaults'
    return '1 differs from its default' if n == 1 else f'{n} differ from their defaults'


def _shown(name: str, value: Value) -> str:
    unit = PARAMETERS[name].unit
    text = f'{value:g}' if isinstance(value, float) else f"'{value}'" if isinstance(
        value, str) else str(value).lower()  # fmt: skip
    return f'{text} {unit}' if unit else text
