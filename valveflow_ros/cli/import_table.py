"""``valveflow import``: a historian's table becomes a log."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from valveflow_ros.cli.console import Console, Outcome
from valveflow_ros.cli.mapping import MAPPING_HELP, add_mapping, read_mapping

if TYPE_CHECKING:
    from valveflow_ros.cli.historian import Imported

_DESCRIPTION = """\
Read a table exported from a historian, .csv or .parquet, and write it as an MCAP recording
that valveflow, ros2 bag, Foxglove and PlotJuggler read. Say which of your columns is which
signal and in which unit; what was not logged can be given as a constant.

example:
  valveflow import history.csv -o history.mcap --column valve_opening=CV_POS
      --column main_steam_pressure=PT_100:bar --column generated_power=MW_GROSS
      --constant main_steam_temperature=540"""


def arguments(parser: ArgumentParser) -> None:
    """Add description, example and options."""
    parser.description = _DESCRIPTION
    parser.usage = 'valveflow import TABLE -o LOG.mcap [options]'
    parser.epilog = MAPPING_HELP
    parser.add_argument('table', metavar='TABLE', type=Path, help='a .csv or .parquet file')
    parser.add_argument(
        '-o', '--output', metavar='LOG', type=Path, required=True,
        help='where to write: an .mcap file, or a folder as ros2 bag makes it',
    )  # fmt: skip
    add_mapping(parser)
    parser.add_argument('--overwrite', action='store_true', help='replace a log that is there')


def run(options: Namespace, console: Console) -> Outcome:
    """Read, convert, write, and say what was understood."""
    mapping = read_mapping(options.column, options.constant)
    from valveflow_ros.cli.historian import read_historian
    from valveflow_ros.cli.outputs import check_log, write_log

    check_log(options.output, source=options.table, overwrite=options.overwrite)
    console.progress(0.1, 'reading')
    imported = read_historian(options.table, mapping, console)
    console.progress(0.6, 'writing')
    written, notes = write_log(
        imported.table, options.output, overwrite=options.overwrite,
        attachments={'import.json': imported.as_json().encode()},
    )  # fmt: skip
    for note in notes:
        console.say(note)
    text = '\n'.join([*_understood(imported), f'Wrote {written}.'])
    return Outcome(text, {'log': str(written), **imported.summary()})


def _understood(imported: Imported) -> list[str]:
    """Return what a person should check before trusting the log."""
    from valveflow_ros.cli.report_words import columns
    from valveflow_ros.report.numbers import count, counted, duration, moment, plain

    first, last = imported.span_ns
    lines = [
        f'Read {count(imported.rows_read)} rows, one every {duration(imported.period_s)}, '
        f'{moment(first)} to {moment(last)}.'
    ]
    rows = []
    for source in imported.sources:
        if source.constant:
            rows.append([source.topic, '(constant)', '', plain(source.low), source.unit])
            continue
        span = f'{plain(source.low)} to {plain(source.high)}'
        lost = f'{counted(source.missing, "value")} missing' if source.missing else ''
        taken = f'from {source.written_unit}' if source.written_unit != source.unit else ''
        rows.append([source.topic, source.column, taken, span, source.unit, lost])
    width = max(len(r) for r in rows)
    lines.append(columns([r + [''] * (width - len(r)) for r in rows]))
    if imported.ignored:
        lines.append(f'Not used: {", ".join(imported.ignored)}.')
    if imported.duplicates:
        lines.append(
            f'{counted(imported.duplicates, "row")} had a time that stood there before and '
            'were left out; the first of each was kept.'
        )
    if imported.gaps:
        longest = imported.gaps[0]
        lines.append(
            f'{counted(len(imported.gaps), "gap")}, the longest {duration(longest.seconds)} '
            f'from {moment(longest.start_ns)}.'
        )
    return lines
