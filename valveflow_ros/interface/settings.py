# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Parameters for a log: from its step, from a file, and from the user, in this order."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import yaml

from valveflow_ros.errors import (
    InputError,
    ParameterError,
    RecordingError,
    UsageError,
    listed,
)
from valveflow_ros.interface.files import reason
from valveflow_ros.parameters import PARAMETERS, Settings, covariate_columns, parameter
from valveflow_ros.records import Signal

_ROUND_S = (1.0, 2.0, 5.0, 6.0, 10.0, 12.0, 15.0, 20.0, 30.0, 60.0, 120.0, 300.0, 600.0, 900.0,
            1800.0, 3600.0)  # fmt: skip
# A finished log is fitted once, at its end, in contrast to a live monitor.
ONE_FIT = {'refit_period': 0.0, 'refit_segments': 0}
# The name of the monitor's node; the executable is called `monitor`.
NODE = 'valveflow_monitor'
# Parameters that every ROS node has.
_OF_ROS = ('use_sim_time', 'start_type_description_service', 'qos_overrides')
_TRUE, _FALSE = ('true', 'yes', 'on'), ('false', 'no', 'off')


def sample_period(steps: Mapping[Signal, float]) -> float:
    """Return a suitable step of the table for readings with these steps, in s.

    The fastest signal decides. The result is at least the default of one second; faster
    readings are averaged.
    """
    base = float(PARAMETERS['sample_period'].default)
    if not steps:
        return base
    step = min(steps.values())
    if step <= 1.05 * base:
        return base
    for nice in _ROUND_S:
        if abs(step - nice) <= 0.05 * nice:
            return nice
    return min(float(f'{step:.3g}'), 3600.0)


def fitting(
    steps: Mapping[Signal, float], span_s: float, given: Mapping[str, object]
) -> dict[str, float]:
    """Return the parameters that depend on the data and differ from the defaults.

    ``steps`` are the median steps of the signals in s, ``span_s`` is the length of the log;
    ``given``, set by the user, overrides what is inferred.
    """
    default = {name: row.default for name, row in PARAMETERS.items()}
    period = given.get('sample_period', sample_period(steps))
    if isinstance(period, bool) or not isinstance(period, int | float):
        return {}
    slowest = max([period, *steps.values()])
    block = max(float(default['block']), float(period))
    longest = max(float(default['longest_segment']), 30.0 * block)
    wanted = {
        'sample_period': float(period),
        'hold_limit': max(float(default['hold_limit']), 2.5 * slowest),
        'lateness': max(float(default['lateness']), float(period)),
        'block': block,
        'longest_segment': longest,
        'alarm_block': max(float(default['alarm_block']), 2.0 * float(period)),
        'alarm_average': max(float(default['alarm_average']), 5.0 * float(period)),
        'window_days': _window_days(span_s, float(period), longest),
    }
    return {
        name: min(max(value, PARAMETERS[name].low or value), PARAMETERS[name].high or value)
        for name, value in wanted.items()
        if name not in given and value != default[name]
    }


def _window_days(span_s: float, period: float, longest_s: float) -> float:
    """Return a window for the whole log, not shorter than the default.

    If the rows are finer than by default, the window is as long as the log, to save memory.
    """
    fine = period < float(PARAMETERS['sample_period'].default)
    least = 1.1 * longest_s / 86400.0 if fine else float(PARAMETERS['window_days'].default)
    return max(least, math.ceil(100.0 * (span_s / 86400.0 + 0.01)) / 100.0)


_EXPONENT = 'pressure_exponent'


def read_parameters(
    file: Path | None, pairs: Sequence[str], *, of_node: bool = False
) -> dict[str, Any]:
    """Return the user's parameters: the values of the file, overridden by those of ``--set``.

    ``of_node``: the file must have the form of ROS 2, with the values below a node's name, and
    only sections for the monitor count. Raises `RecordingError` or `InputError` for the file,
    `UsageError` for ``--set``.
    """
    given: dict[str, Any] = {} if file is None else _from_file(file, of_node)
    # A file may list every parameter: only --set makes the usual exponent one to be checked.
    if given.get(_EXPONENT) == parameter(_EXPONENT).default:
        del given[_EXPONENT]
    for text in pairs:
        name, equals, value = text.partition('=')
        if not equals or not name.strip():
            raise UsageError(f"--set '{text}' is not of the form NAME=VALUE.")
        name = name.strip()
        try:
            given[name] = parameter(name).check(_value(name, value.strip()))
        except ParameterError as error:
            raise UsageError(str(error)) from None
    return given


def check_names(settings: Settings) -> None:
    """Raise `ParameterError` if a name in the parameter ``covariates`` cannot be used."""
    from valveflow_ros.diagnosis.causes import check_covariates

    try:
        check_covariates(covariate_columns(settings.text('covariates').split()), 'entry')
    except InputError as error:
        raise ParameterError('covariates', f'cannot be used: {str(error).rstrip(".")}') from None


def _value(name: str, text: str) -> object:
    """Convert a text to the type of the parameter."""
    default = parameter(name).default
    if isinstance(default, str):
        return text
    if isinstance(default, bool):
        word = text.lower()
        return word in _TRUE if word in _TRUE + _FALSE else text
    try:
        return float(text)
    except ValueError:
        return text


def _from_file(file: Path, of_node: bool) -> dict[str, Any]:
    try:
        content = yaml.safe_load(file.read_text(encoding='utf-8'))
    except OSError as error:
        raise RecordingError(file, f'cannot be read ({reason(error)})') from None
    except (yaml.YAMLError, UnicodeDecodeError, ValueError) as error:
        told = ' '.join(str(error).split())
        raise InputError(f'{file} is no YAML file: {told}.') from None
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise InputError(f'{file} is no parameter file: it must hold names and values.')
    if of_node and (stray := _without_node(content)):
        raise InputError(
            f"{file}: ROS 2 does not take '{stray}' where it stands. Put the lines '/**:' and "
            "'  ros__parameters:' above all parameters, and four blanks before each of them."
        )
    if of_node and (problem := unmatched(content)):
        raise InputError(
            f'{file} {problem}: the monitor would ignore it and run with its defaults. Name the '
            "section '/**:'."
        )
    if of_node:
        content = {name: values for name, values in sections(content) if applies(name)}
    given, wrong = {}, []
    for name, value in _flat(content).items():
        try:
            given[name] = parameter(name, value).check(value)
        except ParameterError as error:
            ignored = of_node and name not in PARAMETERS
            wrong.append(f'{error} The monitor would ignore it.' if ignored else str(error))
    if wrong:
        raise InputError('\n  '.join([f'{file}:', *wrong]) if wrong[1:] else f'{file}: {wrong[0]}')
    return given


def _without_node(content: dict[Any, Any]) -> str:
    """Return the first name that is not below ``ros__parameters``; empty if all are."""
    for name, value in content.items():
        if name == 'ros__parameters' and isinstance(value, dict | None):
            continue
        below = _without_node(value) if isinstance(value, dict) and value else str(name)
        if below:
            return below
    return ''


def sections(content: Mapping[Any, Any], above: str = '') -> Iterator[tuple[str, dict[Any, Any]]]:
    """Yield the name of a node, as the parameter file writes it, and the parameters below it."""
    for name, inner in content.items():
        if name == 'ros__parameters':
            yield above, inner if isinstance(inner, dict) else {}
        elif isinstance(inner, dict):
            yield from sections(inner, f'{above}/{name}' if above else str(name))


def applies(section: str, node: str = '') -> bool:
    """Return True if ROS applies a section of a parameter file to a node.

    In the name of a section, * stands for one part of the node's full name and ** for any number
    of parts. Without ``node`` it is the monitor in any namespace.
    """
    parts = [part for part in section.split('/') if part]
    if not node:
        return parts[-1:] in ([NODE], ['*'], ['**'])
    forms = {'*': '/[^/]+', '**': '(/[^/]+)*'}
    return re.fullmatch(''.join(forms.get(p, f'/{re.escape(p)}') for p in parts), node) is not None


def unmatched(content: Mapping[Any, Any], node: str = '') -> str:
    """Return what is wrong if no section of a parameter file applies to a node; else ''."""
    names = [name for name, _ in sections(content)]
    if not names or any(applies(name, node) for name in names):
        return ''
    return f'has no section for the node {node or NODE}, only {listed([repr(n) for n in names])}'


def unmatched_files(words: Sequence[str], node: str) -> list[str]:
    """Return a sentence for each parameter file of a command line that ROS does not apply.

    ``node`` is the full name of the node. Files that cannot be read are left to ROS.
    """
    told = []
    for option, name in pairwise(words):
        if option != '--params-file':
            continue
        try:
            content = yaml.safe_load(Path(name).read_text(encoding='utf-8'))
        except (OSError, yaml.YAMLError, ValueError):
            continue
        if isinstance(content, dict) and (problem := unmatched(content, node)):
            told.append(f'The parameter file {name} {problem}.')
    return told


def _flat(content: dict[Any, Any]) -> dict[str, Any]:
    """Return the values from below ``node: ros__parameters:`` or from the top level."""
    values: dict[str, Any] = {}
    for name, value in content.items():
        if str(name).partition('.')[0] in _OF_ROS:
            continue
        if isinstance(value, dict):
            inner = value.get('ros__parameters', value)
            values |= _flat(inner if isinstance(inner, dict) else {})
        else:
            values[str(name)] = value
    return values


def settings_for(
    steps: Mapping[Signal, float], span_s: float, given: Mapping[str, object], *,
    live: bool = False, held: bool = False,
) -> tuple[Settings, list[str]]:  # fmt: skip
    """Return the complete settings for a log, and notes on the adapted parameters.

    The curve is fitted once, at the end, unless ``live`` requests the behaviour of a live
    monitor. ``held``: values of a compressed log were repeated; a note on this exists already.
    Raises `ParameterError` if values contradict each other.
    """
    adapted = fitting(steps, span_s, given)
    settings = Settings({**adapted, **given, **({} if live else ONE_FIT)})
    period, said = settings.real('sample_period'), []
    told = [
        f'{name} {value:g} {PARAMETERS[name].unit}'
        for name, value in adapted.items()
        if name not in ('sample_period', 'window_days')
    ]
    if 'sample_period' in adapted and not held:
        said.append(f'The log has a value every {period:g} s, so the table has that step.')
    if told:
        said.append(f'Adapted to the step of the data: {", ".join(told)}.')
    natural = sample_period(steps)
    if 'sample_period' in given and steps and period < 0.5 * natural:
        said.append(
            f'sample_period is set to {period:g} s, but the data come every {natural:g} s; '
            'values are held in between.'
        )
    if span_s > 86400.0 * settings.real('window_days'):
        said.append(
            f'The log is longer than window_days ({settings.real("window_days"):g} d); '
            'only its last part counts.'
        )
    return settings, said
