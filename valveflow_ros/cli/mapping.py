"""The options that say how a log is to be understood: ``--column``, ``--constant`` and more."""

from __future__ import annotations

from argparse import ArgumentParser
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from valveflow_ros.cli.usage import UsageError

if TYPE_CHECKING:
    from valveflow_ros.logs.tables.table_options import TableOptions
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
    from valveflow_ros.logs.tables.table_options import AS_SEEN

    return AS_SEEN


@dataclass(frozen=True, slots=True)
class Mapping:
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


def read_mapping(columns: Sequence[str | About], constants: Sequence[str]) -> Mapping:
    """Read both options.

    Raises
    ------
    UsageError
        Something is not of the right form, given twice, or contradictory.
    """
    found = Mapping(table=_table([c for c in columns if isinstance(c, About)]))
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
    from valveflow_ros.logs.tables.historian_zone import zone_of

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
    from valveflow_ros.signals.unit_table import convert

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
    from valveflow_ros.logs.tables.historian_units import unit_named
    from valveflow_ros.signals.unit_table import known_units

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
