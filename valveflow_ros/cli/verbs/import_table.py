# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow import``: convert the table of a historian to a log."""

from __future__ import annotations

import os
import re
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from valveflow_ros.cli import command
from valveflow_ros.cli.command import Console, TableOption, VerbResult, time_ns
from valveflow_ros.errors import DataError, InputError, UsageError

if TYPE_CHECKING:
    from valveflow_ros.interface.importing.table_import import TableImport
    from valveflow_ros.interface.mapping import LogMapping
    from valveflow_ros.logs.tables.refusal import RefusedError, Remedy

USAGE = 'TABLE -o LOG.mcap [options]'
DESCRIPTION = """\
Read a table exported from a historian (CSV, Excel or Parquet; one column for each signal, or one
row for each value) and write it as an MCAP recording that valveflow, ros2 bag, Foxglove and
PlotJuggler read. It recognises columns, units, dates and decimal marks, and shows what it
recognised. Where a table can be read in two ways, it stops and names the option to add. A signal
that was not recorded can be given as a constant. --dry-run writes nothing.

example:
  valveflow import history.csv --dry-run

a period from the history of an OPC UA server, with the mapping file of the gateway; after a stop
the same command continues:
  valveflow import opcua://127.0.0.1:4840 --mapping opcua.yaml --from 2026-01-01
      --to 2026-02-01 -o january.mcap

with column names that the program cannot recognise:
  valveflow import history.csv -o history.mcap --column valve_opening=CV_POS
      --column main_steam_pressure=PT_100:bar --column generated_power=MW_GROSS
      --constant main_steam_temperature=540 --time-zone Europe/Berlin"""

_OPCUA = 'opcua://'
_HEAD = ('your column', 'is', 'found', 'converted', 'values')
_FLAGS = ('dry_run', 'overwrite', 'quiet', 'json')
# Columns named in a sentence.
_NAMED = 3
# The table shows that one of these is needed, but not which one.
_CHOICES = ('time-zone', 'date-order', 'decimal', 'sheet')


def arguments(parser: ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument(
        'table', metavar='TABLE', type=_source,
        help='a .csv, .xlsx or .parquet file, or opcua://host:port',
    )  # fmt: skip
    told = 'where to write: an .mcap file, or a folder as ros2 bag makes it'
    command.add_output(parser, 'LOG', told, required=False)
    parser.add_argument(
        '--dry-run', action='store_true', help='show what was recognised and write nothing'
    )
    command.add_mapping(parser)
    command.add_covariate(
        parser, 'a further column to keep as the topic NAME, for diagnose and monitor --covariate'
    )
    parser.add_argument('--overwrite', action='store_true', help='replace a log that is there')
    historian = parser.add_argument_group('history of an OPC UA server')
    historian.add_argument(
        '--mapping', metavar='FILE', type=Path,
        help='OPC UA nodes of the signals and login of the server; see docs/tutorial_opcua.md',
    )  # fmt: skip
    historian.add_argument('--unit', metavar='TAG', help='which unit of several in that file')
    for option, name, told in (
        ('--from', 'begin', 'begin of the period, such as 2026-01-31 or 2026-01-31T06:00Z'),
        ('--to', 'end', 'end of the period; not included'),
    ):
        historian.add_argument(option, dest=name, metavar='TIME', help=told)


def run(options: Namespace, console: Console) -> VerbResult:
    """Read, convert, write, and report how the table was interpreted."""
    if isinstance(options.table, str):
        return _from_history(options, console)
    mapping = command.mapping_of(options)
    if options.output is None and not options.dry_run:
        raise UsageError(
            'Name the log to write with -o LOG.mcap, or add --dry-run to write nothing.'
        )
    from valveflow_ros.interface import SILENT
    from valveflow_ros.interface.files import TABLES, check_log
    from valveflow_ros.interface.importing.table_import import TableImport
    from valveflow_ros.interface.mapping import LOOKING_ON, gather_refusals
    from valveflow_ros.logs.tables.refusal import RefusedError

    covariates = _further(options)
    if options.output is not None:
        if covariates and options.output.suffix.lower() in TABLES:
            raise UsageError('--covariate needs a recording as output, such as -o LOG.mcap.')
        check_log(options.output, source=options.table, overwrite=options.overwrite)

    def again(said: LogMapping) -> None:
        console(0.1, LOOKING_ON)
        TableImport(options.table, said, SILENT, covariates=covariates, strict=True).read(None)

    try:
        return gather_refusals(
            options.table,
            lambda said: _imported(options, said, covariates, console),
            mapping,
            again,
        )
    except RefusedError as refused:
        raise InputError(_refusal(refused, options)) from None


def _source(text: str) -> Path | str:
    return text if text.startswith(_OPCUA) else Path(text)


def _from_history(options: Namespace, console: Console) -> VerbResult:
    if None in (options.mapping, options.begin, options.end, options.output):
        raise UsageError(
            'The history of a server wants --mapping FILE, --from TIME, --to TIME and -o LOG.'
        )
    if options.constant or options.column or options.covariate or options.dry_run:
        raise UsageError('The mapping file says all about the nodes: no --column or the like.')
    from valveflow_ros.opcua.session import OpcUaHistory, check_installed

    check_installed()
    from valveflow_ros.interface.files import check_log
    from valveflow_ros.interface.importing.history_import import import_history
    from valveflow_ros.opcua.mapping import read_mapping_file

    begin_ns, end_ns = time_ns(options.begin), time_ns(options.end)
    if begin_ns >= end_ns:
        raise UsageError('--from must be before --to.')
    units = {unit.tag: unit for unit in read_mapping_file(options.mapping).units}
    tag = options.unit or (next(iter(units)) if len(units) == 1 else '')
    if tag not in units:
        raise InputError(f'--unit must be one of {", ".join(units)}, the units of the mapping.')
    check_log(options.output, overwrite=options.overwrite)
    source = OpcUaHistory(units[tag], 'opc.tcp://' + options.table.removeprefix(_OPCUA))
    written = import_history(
        source, begin_ns, end_ns, options.output, overwrite=options.overwrite, progress=console
    )
    return VerbResult(
        f'Wrote {written.path}: {written.messages} values of {len(source.columns)} signals.',
        {'log': str(written.path), 'source': source.name, 'values': written.messages,
         'start_ns': begin_ns, 'end_ns': end_ns},
    )  # fmt: skip


def _further(options: Namespace) -> dict[str, str]:
    """Return the columns to keep by topic; raises `UsageError` and `InputError`."""
    from valveflow_ros.diagnosis.causes import check_covariates
    from valveflow_ros.records import SIGNALS

    covariates = command.covariates_of(options)
    check_covariates(covariates)
    for name in covariates.keys() & {info.topic for info in SIGNALS}:
        raise InputError(f"--covariate '{name}' is the name of a signal; choose another name.")
    return covariates


def _imported(
    options: Namespace, mapping: LogMapping, covariates: dict[str, str], console: Console
) -> VerbResult:
    from valveflow_ros.interface.importing.table_import import Spool, TableImport

    console(0.05, 'looking at the table')
    table = TableImport(options.table, mapping, console, covariates=covariates)
    console(0.1, 'reading')
    place, last = None, 'Nothing was written (--dry-run).'
    if options.dry_run:
        table.read(None)
    else:
        spool = Spool(options.output.absolute().parent)
        try:
            table.read(spool)
            console(0.6, 'writing')
            place = str(_written(options, table))
        finally:
            spool.close()
        last = f'Wrote {place}.'
    from valveflow_ros.logs.tables.refusal import Remedy

    zone = mapping.table.time_zone
    if place and zone:
        last += f' Its times are in UTC: add {Remedy("time-zone", zone)} to identify and diagnose'
        last += ' to see local times.'
    return VerbResult('\n'.join([*_understood(table), last]), {'log': place, **table.summary()})


def _written(options: Namespace, table: TableImport) -> Path:
    from valveflow_ros.interface.files import TABLES, is_empty, write_log
    from valveflow_ros.logs.mcap.importing import write_readings
    from valveflow_ros.records import SampleTable

    path: Path = options.output
    if path.suffix.lower() not in TABLES:
        return write_readings(
            table.readings(), table.signals, path,
            attachments={'import.json': table.as_json().encode()},
            overwrite=options.overwrite or is_empty(path), further=list(table.further),
        ).path  # fmt: skip
    if table.is_long:
        raise DataError(
            f'{options.table}: each of its signals has times of its own, which a table cannot '
            'hold; write an .mcap file.'
        )
    return write_log(SampleTable.concatenate(list(table.tables())), path, options.overwrite)


def _understood(table: TableImport) -> list[str]:
    """Return the assumptions that a person should check before using the log."""
    from valveflow_ros.report.words import count, counted, duration, moment, plain
    from valveflow_ros.signals.units import DIFFERENCES

    first, last = table.span_ns
    sources, gaps = table.sources(), table.gaps
    every = duration(table.period_s)
    # In a long table a row is one value of one signal.
    read = counted(table.rows_read, 'value' if table.is_long else 'row')
    step = f'one of each signal every {every}' if table.is_long else f'one every {every}'
    zone = table.time_zone
    if 'name no zone' in zone:
        zone += '; if they are local, add --time-zone, such as --time-zone Europe/Berlin'
    rows = []
    for s in sources:
        if s.constant:
            rows.append(['(constant)', s.topic, 'as you said', '', f'{plain(s.low)} {s.unit}'])
            continue
        taken = f'from {s.written_unit}' if s.written_unit != s.unit else ''
        if s.topic == 'main_steam_pressure' and not s.air and s.written_unit not in DIFFERENCES:
            taken = f'{taken or s.unit}, absolute'
        span = f'{plain(s.low)} to {plain(s.high)} {s.unit}'
        rows.append([s.column, s.topic, s.ground or '', taken, span])
    for name, series in table.further.items():
        low, high = plain(float(series.values.min())), plain(float(series.values.max()))
        rows.append([series.column, name, 'covariate', '', f'{low} to {high} {series.unit}'])
    lines = [
        f'Read {read}, {step}, {moment(first)} to {moment(last)}.',
        f'Times: {table.time_words}; zone: {zone}.',
        command.table(_HEAD, rows),
    ]
    lines += [source.air for source in sources if source.air]
    for source in sources:
        told = [f"{count(n)} '{word}'" for word, n in source.words.items()]
        told += [f'{count(source.empty)} empty'] if source.empty and told else []
        if source.missing:
            found = f' ({", ".join(told)})' if told else ''
            lines.append(f'{source.column}: {counted(source.missing, "value")} missing{found}.')
    if table.ignored:
        lines.append(f'Not used: {", ".join(table.ignored)}.')
    if table.numeric_ignored:
        lines.append(_left_out(table.numeric_ignored))
    if table.duplicates:
        were = 'was' if table.duplicates == 1 else 'were'
        lines.append(
            f'{counted(table.duplicates, "row")} had a time that stood there before and '
            f'{were} left out; the first of each was kept.'
        )
    if gaps:
        longest = gaps[0]
        lines.append(
            f'{counted(len(gaps), "gap")}, the longest {duration(longest.seconds)} '
            f'from {moment(longest.start_ns)}.'
        )
    return lines


def _left_out(names: Sequence[str]) -> str:
    """Return a sentence about columns of numbers that were left out, and the option for one."""
    from valveflow_ros.diagnosis.causes import catalogue
    from valveflow_ros.logs.tables.refusal import quoted
    from valveflow_ros.logs.tables.words import folded, split_unit
    from valveflow_ros.records import SIGNALS

    several = len(names) > 1
    topic = re.sub(r'\W+', '_', folded(split_unit(names[0])[0]), flags=re.ASCII).strip('_')[:30]
    if not topic[:1].isalpha() or topic in {*catalogue(), *(info.topic for info in SIGNALS)}:
        topic = f'further_{topic}'
    example = quoted(f'{topic}={names[0]}')
    listed = ', '.join(names[:_NAMED]) + (', ...' if len(names) > _NAMED else '')
    return (
        f'Of these {listed} {"hold" if several else "holds"} numbers; if the power may follow '
        f'{"one of them" if several else "it"}, keep it with --covariate {example}.'
    )


def _refusal(refused: RefusedError, options: Namespace) -> str:
    """Return the open questions, followed by a complete command with the missing options."""
    from valveflow_ros.logs.tables.refusal import THEIRS

    if not refused.remedies:
        return refused.listing
    checks = []
    if any(r.value.endswith(f'={THEIRS}') for r in refused.remedies):
        checks.append(f'with your names in place of {THEIRS}')
    if any(r.option == 'constant' for r in refused.remedies):
        checks.append('with assumed constant values: check them')
    if any(r.option in _CHOICES for r in refused.remedies) or ' or --' in refused.listing:
        checks.append('with the first of each choice: check it')
    head = ', '.join(['Then this reads it', *checks])
    return f'{refused.listing.rstrip()}\n{head}:\n  {_command(refused, options)}'


def _command(refused: RefusedError, options: Namespace) -> str:
    """Return the given command with the missing options added."""
    from valveflow_ros.logs.tables.refusal import Remedy, quoted

    given = [
        Remedy(*(said if isinstance(said, TableOption) else ('column', said)))
        for said in options.column
    ]
    given += [Remedy('constant', said) for said in options.constant]
    new = {_subject(remedy) for remedy in refused.remedies}
    words = ['valveflow', 'import', _quoted(options.table)]
    if options.output is not None:
        words += ['-o', _quoted(options.output)]
    words += [f'--{name.replace("_", "-")}' for name in _FLAGS if getattr(options, name, False)]
    words += [str(old) for old in given if _subject(old) not in new]
    words += [f'--covariate {quoted(said)}' for said in options.covariate]
    return ' '.join([*words, refused.options])


def _quoted(path: Path) -> str:
    """Return a path quoted for a shell, which cannot be mistaken for an option."""
    from valveflow_ros.logs.tables.refusal import quoted

    told = str(path)
    return quoted(f'.{os.sep}{told}' if told.startswith('-') else told)


def _subject(remedy: Remedy) -> str:
    """Return the subject of an option, for any of the names of a signal."""
    from valveflow_ros.interface.mapping import read_mapping, subject

    if remedy.option == 'column':
        return next(iter(read_mapping([remedy.value], []).columns))
    return subject(remedy)
