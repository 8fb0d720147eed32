"""The options that say how a log is to be understood: ``--column``, ``--constant`` and more."""

from __future__ import annotations

import math
from argparse import ArgumentParser
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from valveflow_ros.cli.usage import UsageError
from valveflow_ros.errors import InputError, ParameterError, RecordingError
from valveflow_ros.parameters import PARAMETERS, Settings, parameter
from valveflow_ros.records import Signal

if TYPE_CHECKING:
    from valveflow_ros.logs.tables.refusal import TableOptions
    from valveflow_ros.records import Signal


_TIMES = ('time', 'date')


@dataclass(frozen=True, slots=True)
class Column:
    """One ``--column name=THEIRS[:unit]``.

    Attributes
    ----------
    name : str
        The topic's name of a signal, or 'time' or 'date'.
    theirs : str
        What it is called in the log.
    unit : str
        As written; empty means the engine's own unit.
    whole : str
        Everything after the equals sign: a column's name may itself hold a colon.
    """

    name: str
    theirs: str
    unit: str
    whole: str


@dataclass(frozen=True, slots=True)
class Constant:
    """One ``--constant name=value[:unit]``, in the engine's unit."""

    name: str
    value: float
    written: str


def _as_seen() -> TableOptions:
    from valveflow_ros.logs.tables.refusal import AS_SEEN

    return AS_SEEN


@dataclass(frozen=True, slots=True)
class LogMapping:
    """All of them, by the topic's name."""

    columns: dict[str, Column] = field(default_factory=dict)
    constants: dict[str, Constant] = field(default_factory=dict)
    table: TableOptions = field(default_factory=_as_seen)


@dataclass(frozen=True, slots=True)
class About:
    """What one of the options says of a table: the name of a field and its value."""

    name: str
    value: str


def add_mapping(parser: ArgumentParser) -> None:
    """Add the options.

    Those about tables are gathered in the same list as ``--column``, so that
    every verb hands on one thing.
    """
    parser.add_argument(
        '--column', action='append', default=[], metavar='NAME=THEIRS[:UNIT]',
        help='which column or topic of yours is the signal NAME, and its unit if it is not the '
        'usual one; may be given several times',
    )  # fmt: skip
    parser.add_argument(
        '--constant', action='append', default=[], metavar='NAME=VALUE[:UNIT]',
        help='a signal that was not logged and hardly changes',
    )  # fmt: skip
    about = parser.add_argument_group('how a table is written, where it does not show it itself')
    about.add_argument(
        '--time-zone', dest='column', action='append', type=_about('time_zone'), metavar='ZONE',
        help='zone of times that name none, such as Europe/Berlin or +01:00; west of '
        'Greenwich with an equals sign, --time-zone=-05:00 (default: UTC)',
    )  # fmt: skip
    about.add_argument(
        '--date-order', dest='column', action='append', type=_about('date_order'),
        metavar='dmy|mdy', help='whether 01/02/2026 is in February (dmy) or in January (mdy)',
    )  # fmt: skip
    about.add_argument(
        '--decimal', dest='column', action='append', type=_about('decimal'),
        metavar='point|comma', help='what stands before the decimals of a number',
    )  # fmt: skip
    about.add_argument(
        '--sheet', dest='column', action='append', type=_about('sheet'), metavar='NAME',
        help='which sheet of a workbook',
    )  # fmt: skip


def _about(name: str) -> Callable[[str], About]:
    return lambda value: About(name, value)


MAPPING_HELP = """\
names and units (the usual unit first):
  valve_opening             %, fraction
  main_steam_pressure       MPa, kPa, Pa, bar, psi; absolute. MPag, kPag, barg, psig are gauge:
                            0.101325 MPa of air is added
  main_steam_temperature    degC, K, degF
  generated_power           MW, kW, W
  valve_command             %, fraction; optional
  time, date                date and time of the usual kinds, or Unix seconds
Columns of a table that are named after what they hold need no --column."""


def read_mapping(columns: Sequence[str | About], constants: Sequence[str]) -> LogMapping:
    """Read both options.

    Raises
    ------
    UsageError
        Something is not of the right form, given twice, or contradictory.
    """
    found = LogMapping(table=_table([c for c in columns if isinstance(c, About)]))
    for text in (c for c in columns if isinstance(c, str)):
        column = _column(text)
        if column.name in found.columns:
            raise UsageError(f'--column {column.name} is given twice.')
        found.columns[column.name] = column
    for text in constants:
        constant = _constant(text)
        if constant.name in found.constants:
            raise UsageError(f'--constant {constant.name} is given twice.')
        if constant.name in found.columns:
            raise UsageError(
                f'{constant.name} is given both as --column and as --constant; leave one out.'
            )
        found.constants[constant.name] = constant
    return found


def _table(said: Sequence[About]) -> TableOptions:
    from valveflow_ros.errors import InputError
    from valveflow_ros.logs.tables.dates import zone_of

    options = _as_seen()
    try:
        for one in said:
            options = replace(options, **{one.name: one.value.strip()})
        zone_of(options.time_zone)
    except InputError as error:
        raise UsageError(str(error)) from None
    return options


def _split(option: str, text: str) -> tuple[str, str]:
    name, equals, rest = text.partition('=')
    if not equals or not name.strip() or not rest.strip():
        raise UsageError(f"--{option} '{text}' is not of the form NAME=... .")
    return name.strip(), rest.strip()


def _column(text: str) -> Column:
    name, whole = _split('column', text)
    if name in _TIMES:
        return Column(name, whole, '', whole)
    signal = _signal(name, 'column')
    theirs, colon, unit = whole.rpartition(':')
    if not colon or not theirs or not unit.strip():
        return Column(_topic(signal), whole, '', whole)
    unit = _unit(signal, unit)
    return Column(_topic(signal), theirs.strip(), unit, whole)


def _constant(text: str) -> Constant:
    import numpy as np

    from valveflow_ros.errors import InputError
    from valveflow_ros.signals.units import convert

    name, rest = _split('constant', text)
    signal = _signal(name, 'constant')
    number, colon, unit = rest.partition(':')
    try:
        value = float(number)
    except ValueError:
        raise UsageError(f"--constant {name}: '{number}' is no number.") from None
    if not np.isfinite(value):
        raise UsageError(f'--constant {name}: the value must be finite.')
    if colon:
        try:
            value = float(convert(signal, _unit(signal, unit), np.array([value]))[0])
        except InputError as error:
            raise UsageError(f'--constant {name}: {error}') from None
    return Constant(_topic(signal), value, rest)


def _unit(signal: Signal, text: str) -> str:
    """Return the project's name of a unit, the text itself if it spells none."""
    from valveflow_ros.logs.tables.words import unit_named
    from valveflow_ros.signals.units import known_units

    written = text.strip()
    known = {spelling.lower(): spelling for spelling in known_units(signal)}
    return known.get(written.lower()) or unit_named(signal, written) or written


def _signal(name: str, option: str) -> Signal:
    """Return the signal of a topic's or a column's name."""
    import difflib

    from valveflow_ros.records import SIGNALS

    names = {info.topic: info.signal for info in SIGNALS}
    names |= {info.column: info.signal for info in SIGNALS}
    if name in names:
        return names[name]
    known = [info.topic for info in SIGNALS] + (list(_TIMES) if option == 'column' else [])
    near = difflib.get_close_matches(name, [*names, *_TIMES], n=1)
    hint = f" did you mean '{near[0]}'?" if near else f' use one of {", ".join(known)}.'
    raise UsageError(f"--{option} '{name}': there is no signal of that name,{hint}")


def _topic(signal: Signal) -> str:
    from valveflow_ros.records import SIGNALS

    return SIGNALS[signal].topic


# Parameters for a log: from its own step, a file, and the command line, in this order.


_ROUND_S = (1.0, 2.0, 5.0, 6.0, 10.0, 12.0, 15.0, 20.0, 30.0, 60.0, 120.0, 300.0, 600.0, 900.0,
            1800.0, 3600.0)  # fmt: skip
# A finished log is fitted once, at its end, whatever a live monitor would do.
_OFFLINE = {'refit_period': 0.0, 'refit_segments': 0}
_TRUE, _FALSE = ('true', 'yes', 'on'), ('false', 'no', 'off')


def sample_period(steps: Mapping[Signal, float]) -> float:
    """Return the step of the table that suits readings with these steps, in s.

    The quickest signal decides; below the default of one second the engine
    averages anyway, so the table is never finer than that by itself.
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
    """Return the parameters that follow from the data and differ from the defaults.

    Parameters
    ----------
    steps : mapping
        Median step of each signal in s.
    span_s : float
        Length of the log.
    given : mapping
        What a person has set; it decides over what would be inferred.
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
    """Return a window that holds the whole log, not shorter than the default.

    Of rows finer than usual only as many as the log has, for the sake of memory.
    """
    fine = period < float(PARAMETERS['sample_period'].default)
    least = 1.1 * longest_s / 86400.0 if fine else float(PARAMETERS['window_days'].default)
    return max(least, math.ceil(100.0 * (span_s / 86400.0 + 0.01)) / 100.0)


def read_parameters(file: Path | None, pairs: Sequence[str]) -> dict[str, Any]:
    """Return what a person has set: the file's values, then those of ``--set``.

    Raises
    ------
    RecordingError
        The file cannot be read.
    InputError
        The file is no parameter file; a name or value in it is wrong.
    UsageError
        A name or value of ``--set`` is wrong.
    """
    given: dict[str, Any] = {} if file is None else _from_file(file)
    for text in pairs:
        name, equals, value = text.partition('=')
        if not equals or not name.strip():
            raise UsageError(f"--set '{text}' is not of the form NAME=VALUE.")
        try:
            given[name.strip()] = _check(name.strip(), _value(name.strip(), value.strip()))
        except ParameterError as error:
            raise UsageError(str(error)) from None
    return given


def _check(name: str, value: object) -> object:
    return parameter(name).check(value)


def _value(name: str, text: str) -> object:
    """Read a text as what the parameter is."""
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


def _from_file(file: Path) -> dict[str, Any]:
    try:
        content = yaml.safe_load(file.read_text(encoding='utf-8'))
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise RecordingError(file, f'cannot be read ({reason})') from None
    except (yaml.YAMLError, UnicodeDecodeError, ValueError) as error:
        reason = ' '.join(str(error).split())
        raise InputError(f'{file} is no YAML file: {reason}.') from None
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise InputError(f'{file} is no parameter file: it must hold names and values.')
    try:
        return {name: _check(name, value) for name, value in _flat(content).items()}
    except ParameterError as error:
        raise InputError(f'{file}: {error}') from None


def _flat(content: dict[Any, Any]) -> dict[str, Any]:
    """Take the values out of ``node: ros__parameters:`` or from the top."""
    values: dict[str, Any] = {}
    for name, value in content.items():
        if isinstance(value, dict):
            inner = value.get('ros__parameters', value)
            values |= _flat(inner if isinstance(inner, dict) else {})
        elif name != 'use_sim_time':
            values[str(name)] = value
    return values


def settings_for(
    steps: Mapping[Signal, float], span_s: float, given: Mapping[str, object]
) -> tuple[Settings, list[str]]:
    """Return the complete settings for a log, and sentences about what was adapted.

    Raises
    ------
    ParameterError
        Values are at odds with each other.
    """
    adapted = fitting(steps, span_s, given)
    settings = Settings({**adapted, **given, **_OFFLINE})
    return settings, _words(adapted, given, settings, steps, span_s)


def _words(
    adapted: Mapping[str, float],
    given: Mapping[str, object],
    settings: Settings,
    steps: Mapping[Signal, float],
    span_s: float,
) -> list[str]:
    said = []
    period = settings.real('sample_period')
    told = [
        f'{name} {adapted[name]:g} {PARAMETERS[name].unit}'
        for name in (
            'hold_limit',
            'lateness',
            'block',
            'longest_segment',
            'alarm_block',
            'alarm_average',
        )
        if name in adapted
    ]
    if 'sample_period' in adapted:
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
    return said


# The options that set parameters: ``--params`` and ``--set``.


def add_parameters(parser: ArgumentParser) -> None:
    """Add the options that `parameters.read_parameters` reads."""
    parser.add_argument(
        '--params', metavar='FILE', type=Path, help='parameters, a YAML file as the node takes it'
    )
    parser.add_argument(
        '--set', action='append', default=[], metavar='NAME=VALUE', dest='pairs',
        help='one parameter, such as time_constant=120; stands above the file',
    )  # fmt: skip
