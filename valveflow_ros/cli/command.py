# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Functions shared by the verbs: options, messages, progress on the terminal, the result."""

from __future__ import annotations

import json
import os
import re
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone, tzinfo
from functools import partial
from itertools import zip_longest
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any, NamedTuple, TextIO

from valveflow_ros.errors import UsageError
from valveflow_ros.interface import Progress
from valveflow_ros.report.terminal.progress import Progress as ProgressLine

if TYPE_CHECKING:
    from valveflow_ros.interface.files import Result
    from valveflow_ros.interface.logs import Log
    from valveflow_ros.interface.mapping import LogMapping

_INDENT = '  '  # of a table
_TERMINAL = 80  # characters; a wider table has its head in several lines
# Terminal control characters and those that change the text direction, except tabs and newlines.
_COMMANDS = re.compile('[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069]')


@dataclass(frozen=True, slots=True)
class VerbResult:
    """The result of a verb for people, and the same for programs.

    ``drawn``: the text is a picture for this terminal, with control codes, made from sanitised
    words; terminal control characters are removed from any other text.
    """

    text: str
    data: Mapping[str, Any]
    drawn: bool = False


class Console(Progress):
    """Messages, warnings, a progress bar on a terminal, and the result, perhaps as JSON."""

    def __init__(
        self, out: TextIO, err: TextIO, *, as_json: bool = False, quiet: bool = False
    ) -> None:
        self._out = out
        self._as_json = as_json
        self._quiet = quiet
        self._unit = 'MW'
        self._zone: tzinfo | None = None
        bar = err.isatty() and os.environ.get('TERM') != 'dumb'
        self._line = ProgressLine(err, bar)

    def __call__(self, share: float, what: str) -> None:
        """Show the progress: a bar on a terminal, otherwise a line if the work takes long."""
        if not self._quiet:
            self._line.at(share, _harmless(self._local(what)))

    def measured_in(self, unit: str) -> None:
        """Print all further texts for an output in this unit."""
        self._unit = unit

    def times_in(self, zone: tzinfo | None) -> None:
        """Print times in this zone from now on; JSON keeps UTC."""
        self._zone = zone

    def say(self, sentence: str) -> None:
        """Print an informative message."""
        if not self._quiet:
            self._line.write(_harmless(self._local(self._told(sentence))))

    def warn(self, sentence: str) -> None:
        """Print a warning."""
        self._line.write(_harmless(f'Warning: {self._local(self._told(sentence))}'))

    def fail(self, sentence: str) -> None:
        """Print why the command failed."""
        self._line.end()
        self._line.write(_harmless(f'valveflow: {self._local(self._told(sentence))}'))

    def finish(self, outcome: VerbResult) -> None:
        """Print the result."""
        self._line.end()
        if self._as_json:
            from valveflow_ros.records import finite

            text = json.dumps(finite(outcome.data), indent=2, allow_nan=False, ensure_ascii=False)
            text = self._told(text)
            self._out.write(_COMMANDS.sub(lambda c: f'\\u{ord(c[0]):04x}', text) + '\n')
        elif outcome.text:
            told = self._local(self._told(outcome.text))
            text = outcome.text if outcome.drawn else _harmless(told)
            self._out.write(text.rstrip('\n') + '\n')
        self._out.flush()

    def _told(self, text: str) -> str:
        if self._unit == 'MW':
            return text
        from valveflow_ros.signals.units import in_unit

        return in_unit(text, self._unit)

    def _local(self, text: str) -> str:
        if self._zone is None:
            return text
        from valveflow_ros.report.words import in_zone

        return in_zone(text, self._zone)


def _harmless(text: str) -> str:
    """Return a text safe for a terminal: it may contain external names and table cells."""
    return _COMMANDS.sub('?', text)


class TableOption(NamedTuple):
    """An option on the format of a table, in the list of ``--column``."""

    option: str
    value: str


def add_file(parser: ArgumentParser, option: str, told: str, *, required: bool = False) -> None:
    """Add an option for a file."""
    parser.add_argument(option, metavar='FILE', type=Path, required=required, help=told)


def add_output(parser: ArgumentParser, metavar: str, told: str, *, required: bool = True) -> None:
    """Add the option for the place of the result."""
    parser.add_argument('-o', '--output', metavar=metavar, type=Path, required=required, help=told)


def add_set(parser: ArgumentParser, told: str) -> None:
    """Add the option for single parameters."""
    parser.add_argument(
        '--set', action='append', default=[], metavar='NAME=VALUE', dest='pairs', help=told
    )


def add_parameters(parser: ArgumentParser) -> None:
    """Add the options for parameters."""
    add_file(
        parser,
        '--params',
        'parameters: a YAML file as the node takes it, or with one NAME: VALUE in a line',
    )
    add_set(parser, 'one parameter, such as time_constant=120; overrides the file')


MAPPING_HELP = """\
names and units (the usual unit first):
  valve_opening             %, fraction
  main_steam_pressure       MPa, kPa, Pa, bar, psi; absolute. MPag, kPag, barg, psig are gauge:
                            0.101325 MPa of air is added; kPad, bard, mbard, psid are the
                            difference over the valve
  main_steam_temperature    degC, K, degF
  generated_power           MW, kW, W; or a flow, which keeps its unit: t/h, kg/h, kg/s, m3/h,
                            Nm3/h, l/s, l/min, klb/h, lb/h, gpm, scfm
  valve_command             %, fraction; optional
  time, date                date and time of the usual kinds, or Unix seconds
Columns of a table that are named after what they hold need no --column."""


def add_mapping(parser: ArgumentParser) -> None:
    """Add the options on how to read a log.

    Those about tables are collected in the same list as ``--column``, in their order.
    """
    parser.epilog = MAPPING_HELP
    parser.add_argument(
        '--column', action='append', default=[], metavar='NAME=THEIRS[:UNIT]',
        help='your column or topic for the signal NAME, and its unit if it is not the '
        'usual one; may be given several times',
    )  # fmt: skip
    parser.add_argument(
        '--constant', action='append', default=[], metavar='NAME=VALUE[:UNIT]',
        help='a signal that is not in the log and hardly changes',
    )  # fmt: skip
    add_table(parser, 'column')


def add_table(parser: ArgumentParser, gathered: str) -> None:
    """Add the options on the format of a table, collected under the name ``gathered``."""
    parser.set_defaults(**{gathered: []})
    about = parser.add_argument_group('format of a table, if it is not recognised')
    for option, metavar, told in (
        ('time-zone', 'ZONE',
         'time zone of times without one in the table, and of the times shown, such as '
         'Europe/Berlin or +01:00; west of Greenwich with an equals sign, --time-zone=-05:00 '
         '(default: UTC)'),
        ('date-order', 'dmy|mdy',
         'whether 01/02/2026 is in February (dmy) or in January (mdy)'),
        ('decimal', 'point|comma', 'decimal mark of numbers'),
        ('sheet', 'NAME', 'which sheet of a workbook'),
        ('max-unpacked', 'MB',
         'largest unpacked size of a table (default: 64 MB or 200 times the size of the file, '
         'whichever is larger; at most 1074 MB for a workbook and 2147 MB for Parquet)'),
        ('period', 'TIME', 'time from one row to the next, such as 60s or 1min, if no column '
         'holds times; the first row is then at 2000-01-01'),
    ):  # fmt: skip
        about.add_argument(
            f'--{option}', dest=gathered, action='append', metavar=metavar, help=told,
            type=partial(TableOption, option),
        )  # fmt: skip


def mapping_of(options: Namespace) -> LogMapping:
    """Return the mapping from the options of `add_mapping`; raises `UsageError`."""
    from valveflow_ros.interface.mapping import read_mapping

    columns = [c for c in options.column if isinstance(c, str)]
    return read_mapping(columns, options.constant, **table_words(options.column))


def zone_in(options: Namespace) -> tzinfo | None:
    """Return the zone of ``--time-zone`` among the options of `add_table`; None for UTC."""
    gathered = [*getattr(options, 'column', ()), *getattr(options, 'said', ())]
    words = table_words(gathered)
    if not words.get('time_zone'):
        return None
    from valveflow_ros.interface.mapping import table_options
    from valveflow_ros.records import zone_of

    return zone_of(table_options(words).time_zone)


def table_words(gathered: Sequence[str | TableOption]) -> dict[str, str]:
    """Return the options collected by `add_table`, by the names of `table_options`."""
    return {o.option.replace('-', '_'): o.value for o in gathered if isinstance(o, TableOption)}


def add_analysis(parser: ArgumentParser, log: str = 'the log to read') -> None:
    """Add the log of an analysis, and the folder of its results."""
    parser.add_argument('log', metavar='LOG', type=Path, help=log)
    add_output(
        parser,
        'DIR',
        'folder for the results, made if absent; the report of another verb there is kept',
    )


def add_analysis_options(parser: ArgumentParser) -> None:
    """Add the options of every analysis: parameters, additional files, how to read the log."""
    add_parameters(parser)
    parser.add_argument(
        '--figures', action='store_true',
        help='also write each picture of the report as PNG and SVG: DIR/figures',
    )  # fmt: skip
    parser.add_argument(
        '--table', action='store_true',
        help='also write the data of each picture as CSV: DIR/tables',
    )  # fmt: skip
    for name, option, what in (('start', '--from', 'first'), ('end', '--to', 'last')):
        parser.add_argument(
            option, metavar='TIME', dest=name, default='',
            help=f'the {what} time to use, such as 2026-01-31T06:00; in the zone of --time-zone',
        )  # fmt: skip
    add_mapping(parser)


def log_of(options: Namespace, console: Console) -> Callable[[], Log]:
    """Return what opens the log of an analysis, between the times asked for.

    The functions of the interface call it after they have read and checked all other files.
    """
    mapping = mapping_of(options)
    console(0.0, 'starting')
    from valveflow_ros.interface.logs import open_log
    from valveflow_ros.records import zone_of

    zone = zone_of(mapping.table.time_zone)

    def opened() -> Log:
        start, end = (time_ns(t, zone) if t else None for t in (options.start, options.end))
        console(0.02, 'reading')
        return open_log(options.log, mapping, progress=console).between(start, end)

    return opened


def add_covariate(
    parser: ArgumentParser, what: str = 'a column beside the signals that the power may follow'
) -> None:
    """Add the option for columns that a diagnosis tries as causes."""
    parser.add_argument(
        '--covariate', action='append', default=[], metavar='NAME=COLUMN[:UNIT]',
        help=f'{what}, such as vacuum=condenser_pressure_kpa; may be given several times',
    )  # fmt: skip


def covariates_of(options: Namespace) -> dict[str, str]:
    """Return the columns of these options by name; raises `UsageError`."""
    from valveflow_ros.parameters import covariate_columns

    return covariate_columns(options.covariate)


def checked_parameters(options: Namespace) -> dict[str, Any]:
    """Return the parameters set by the user; raise early if the results could not be written."""
    from valveflow_ros.interface.files import check_results
    from valveflow_ros.interface.settings import read_parameters

    given = read_parameters(options.params, options.pairs)
    check_results(options.output, options.figures, options.table)
    return given


def write_results(
    result: Result, options: Namespace, text: str, data: Mapping[str, Any]
) -> VerbResult:
    """Write the files of a result; return its text and data with the list of the files."""
    done = result.write(
        options.output, figures=options.figures, tables=options.table,
        time_zone=mapping_of(options).table.time_zone,
    )  # fmt: skip
    files = {'files': {name: str(path) for name, path in done.files.items()}}
    kept = {'kept': dict(done.kept)} if done.kept else {}
    return VerbResult('\n'.join([text, *done.words]), {**data, **files, **kept})


def time_ns(text: str, zone: tzinfo | None = None) -> int:
    """Return a time in ns; in ``zone``, or UTC, if it gives none."""
    try:
        moment = datetime.fromisoformat(text.replace('Z', '+00:00').replace(' UTC', '+00:00'))
    except ValueError:
        raise UsageError(f"'{text}' is no time such as 2026-01-31T06:00Z.") from None
    moment = moment if moment.tzinfo else moment.replace(tzinfo=zone or timezone.utc)
    return round(moment.timestamp() * 1e6) * 1000


def lines(*parts: str) -> str:
    """Return the parts that are not empty, one per line."""
    return '\n'.join(part for part in parts if part)


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return rows below their head, the first column left, the others right; empty without rows.

    If they are wider than a usual terminal, the head is broken into several lines.
    """
    if not rows:
        return ''
    everything = [head, *rows]
    if len(_INDENT) + sum(w + 2 for w in _widths(everything)) > _TERMINAL:
        parts = (
            wrap(name, max(width, 1, *map(len, name.split())))[::-1]
            for name, width in zip(head, _widths(rows), strict=True)
        )
        everything = [*[*zip_longest(*parts, fillvalue='')][::-1], *rows]
    first, *others = _widths(everything)
    told = []
    for row in everything:
        cells = [row[0].ljust(first), *map(str.rjust, row[1:], others)]
        told.append((_INDENT + '  '.join(cells)).rstrip())
    return '\n'.join(told)


def _widths(rows: Sequence[Sequence[str]]) -> list[int]:
    return [max(map(len, column)) for column in zip(*rows, strict=True)]


def rejected_words(
    counts: Mapping[str, Mapping[str, int]], ranges: Mapping[str, str] | None = None
) -> str:
    """Return one line per signal about the readings that were not used.

    ``ranges`` has the accepted range of each signal in words, which is then added.
    """
    from valveflow_ros.report.data import reason_words, rejected

    told = [
        f'  {topic}: {reason_words(refused, (ranges or {}).get(topic, ""))}'
        for topic, by_reason in counts.items()
        if (refused := rejected({topic: by_reason}))
    ]
    if not any(n for by_reason in counts.values() for n in by_reason.values()):
        return 'No reading was found.'
    return '\n'.join(['Readings not used:', *told]) if told else 'Every reading was used.'
