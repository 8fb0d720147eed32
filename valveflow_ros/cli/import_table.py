"""``valveflow import``: a historian's table becomes a log."""

from __future__ import annotations

import os
from argparse import ArgumentParser, Namespace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from valveflow_ros.cli.console import Console, Outcome
from valveflow_ros.cli.options import MAPPING_HELP, LogMapping, add_mapping, read_mapping
from valveflow_ros.cli.usage import UsageError

if TYPE_CHECKING:
    from valveflow_ros.cli.historian import Historian, Imported, Ordered, SignalSource, Spool

_DESCRIPTION = """\
Read a table exported from a historian (CSV, Excel or Parquet; a column a signal, or a row a
value) and write it as an MCAP recording that valveflow, ros2 bag, Foxglove and PlotJuggler
read. Columns, units, dates and decimal marks are recognised, and what was understood is shown;
what could be read in two ways is refused with the option to add. What was not logged can be
given as a constant. --dry-run only shows what was understood.

example:
  valveflow import history.csv --dry-run

and with columns whose names say nothing:
  valveflow import history.csv -o history.mcap --column valve_opening=CV_POS
      --column main_steam_pressure=PT_100:bar --column generated_power=MW_GROSS
      --constant main_steam_temperature=540 --time-zone Europe/Berlin"""

_HEAD = ('your column', 'is', 'why', 'in', 'runs from', '', '')


def arguments(parser: ArgumentParser) -> None:
    """Add description, example and options."""
    parser.description = _DESCRIPTION
    parser.usage = 'valveflow import TABLE -o LOG.mcap [options]'
    parser.epilog = MAPPING_HELP
    parser.add_argument('table', metavar='TABLE', type=Path, help='a .csv, .xlsx or .parquet file')
    parser.add_argument(
        '-o', '--output', metavar='LOG', type=Path,
        help='where to write: an .mcap file, or a folder as ros2 bag makes it',
    )  # fmt: skip
    parser.add_argument(
        '--dry-run', action='store_true', help='show what was understood and write nothing'
    )
    add_mapping(parser)
    parser.add_argument('--overwrite', action='store_true', help='replace a log that is there')


def run(options: Namespace, console: Console) -> Outcome:
    """Read, convert, write, and say what was understood."""
    mapping = read_mapping(options.column, options.constant)
    if options.output is None and not options.dry_run:
        raise UsageError('Name the log to write with -o LOG.mcap, or add --dry-run to look only.')
    from valveflow_ros.cli.historian_command import told
    from valveflow_ros.cli.historian_open import looked_through
    from valveflow_ros.cli.outputs import check_log
    from valveflow_ros.errors import InputError
    from valveflow_ros.logs.tables.refusal import RefusedError

    if options.output is not None:
        check_log(options.output, source=options.table, overwrite=options.overwrite)

    def look(said: LogMapping) -> Outcome:
        return _imported(options, said, console)

    try:
        return looked_through(
            options.table, look, mapping, partial(_looked, options.table, console)
        )
    except RefusedError as refused:
        raise InputError(told(refused, options)) from None


def _looked(table: Path, console: Console, mapping: LogMapping) -> None:
    """Read a table for what else is open, and say nothing of what is understood."""
    from valveflow_ros.cli.historian import Historian
    from valveflow_ros.cli.historian_open import LOOKING_ON

    console.progress(0.1, LOOKING_ON)
    with Path(os.devnull).open('w', encoding='utf-8') as nowhere:
        Historian(table, mapping, Console(nowhere, nowhere, quiet=True), strict=True).read(None)


def _imported(options: Namespace, mapping: LogMapping, console: Console) -> Outcome:
    from valveflow_ros.cli.historian import Historian, Spool

    console.progress(0.05, 'looking at the table')
    historian = Historian(options.table, mapping, console)
    console.progress(0.1, 'reading')
    if options.dry_run:
        imported, _ = historian.read(None)
        return _outcome(imported, None, historian.is_long)
    spool = Spool(options.output.absolute().parent)
    try:
        imported, ordered = historian.read(spool)
        console.progress(0.6, 'writing')
        return _written(options, historian, spool, imported, ordered, console)
    finally:
        spool.close()


def _written(
    options: Namespace,
    historian: Historian,
    spool: Spool,
    imported: Imported,
    ordered: Ordered,
    console: Console,
) -> Outcome:
    from valveflow_ros.cli.outputs import TABLES, write_log
    from valveflow_ros.errors import DataError
    from valveflow_ros.logs.mcap.importing import write_readings
    from valveflow_ros.records import SampleTable

    path: Path = options.output
    attachments = {'import.json': imported.as_json().encode()}
    if path.suffix.lower() in TABLES:
        if historian.is_long:
            raise DataError(
                f'{options.table}: each of its signals has times of its own, which a table cannot '
                'hold; write an .mcap file.'
            )
        table = SampleTable.concatenate(list(historian.tables(spool, ordered)))
        place = write_log(table, path, overwrite=options.overwrite)
    else:
        # An empty file is no obstacle, and the writer knows no third way.
        replace = options.overwrite or (path.is_file() and path.stat().st_size == 0)
        place = write_readings(
            historian.readings(spool, ordered), historian.signals, path,
            attachments=attachments, overwrite=replace,
        ).path  # fmt: skip
    return _outcome(imported, place, historian.is_long)


def _outcome(imported: Imported, written: Path | None, long: bool) -> Outcome:
    last = 'Nothing was written (--dry-run).' if written is None else f'Wrote {written}.'
    log = None if written is None else str(written)
    text = '\n'.join([*_understood(imported, long), last])
    return Outcome(text, {'log': log, **imported.summary()})


def _understood(imported: Imported, long: bool) -> list[str]:
    """Return what a person should check before trusting the log."""
    from valveflow_ros.cli.report_words import columns
    from valveflow_ros.report.words import count, counted, duration, moment

    first, last = imported.span_ns
    # In a long table a row is one value of one signal.
    read = counted(imported.rows_read, 'value' if long else 'row')
    step = f'one of each signal every {duration(imported.period_s)}' if long else (
        f'one every {duration(imported.period_s)}'
    )  # fmt: skip
    lines = [
        f'Read {read}, {step}, {moment(first)} to {moment(last)}.',
        f'Times: {imported.time_words}; zone: {_zone(imported.time_zone)}.',
        columns(_rows(imported), _HEAD),
    ]
    lines += [source.air for source in imported.sources if source.air]
    for source in imported.sources:
        told = [f"{count(n)} '{word}'" for word, n in source.words.items()]
        told += [f'{count(source.empty)} empty'] if source.empty and source.words else []
        if told:
            lines.append(f'Not numbers in {source.column}: {", ".join(told)}.')
    if imported.ignored:
        lines.append(f'Not used: {", ".join(imported.ignored)}.')
    if imported.duplicates:
        were = 'was' if imported.duplicates == 1 else 'were'
        lines.append(
            f'{counted(imported.duplicates, "row")} had a time that stood there before and '
            f'{were} left out; the first of each was kept.'
        )
    if imported.gaps:
        longest = imported.gaps[0]
        lines.append(
            f'{counted(len(imported.gaps), "gap")}, the longest {duration(longest.seconds)} '
            f'from {moment(longest.start_ns)}.'
        )
    return lines


def _zone(zone: str) -> str:
    if 'name no zone' not in zone:
        return zone
    return f'{zone}; if they are local, add --time-zone, such as --time-zone Europe/Berlin'


def _rows(imported: Imported) -> list[list[str]]:
    return [_row(source) for source in imported.sources]


def _row(source: SignalSource) -> list[str]:
    from valveflow_ros.report.words import counted, plain

    if source.constant:
        return ['(constant)', source.topic, 'as you said', '', plain(source.low), source.unit, '']
    span = f'{plain(source.low)} to {plain(source.high)}'
    lost = f'{counted(source.missing, "value")} missing' if source.missing else ''
    taken = f'from {source.written_unit}' if source.written_unit != source.unit else ''
    ground = source.ground or ''
    return [source.column, source.topic, ground, taken, span, source.unit, lost]
