# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow loop``: judge the valve of one control loop from its command and response."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from valveflow_ros.cli import command
from valveflow_ros.errors import UsageError
from valveflow_ros.interface.files import check_folder

USAGE = 'TABLE -o DIR [options]'
DESCRIPTION = """\
Judge the valve of one control loop from the controller's output and the measured position, or
from the controller's output and the process value alone: it sticks, it has slack, the loop
oscillates for another reason, it is sound, or the record cannot tell. At least 200 rows are
needed. DIR gets loop.json.

example:
  valveflow loop FIC101.csv -o result

with column names that the program cannot recognise:
  valveflow loop trend.csv -o result --command A17 --process A18"""


def arguments(parser: ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument(
        'table', metavar='TABLE', type=Path, help='a .csv or other text, .xlsx or .parquet table'
    )
    command.add_output(parser, 'DIR', 'folder for loop.json, made if absent')
    for option, about in (
        ('command', "the controller's output in %% (by default a column named OP, MV, ...)"),
        ('position', 'the measured position in %%; with it the sizes of the faults are estimated'),
        ('process', 'the process value: flow, level, pressure (by default PV)'),
        ('set-point', 'the set point (by default SP or SV); it may be absent'),
        ('time', 'date and time, or Unix seconds'),
    ):
        parser.add_argument(f'--{option}', metavar='COLUMN', default='', help=about)
    command.add_table(parser, 'said')


def run(options: Namespace, console: command.Console) -> command.VerbResult:
    """Read the table, judge, write."""
    from valveflow_ros.interface.loop import judge_loop
    from valveflow_ros.interface.mapping import table_options

    if options.position and options.process:
        raise UsageError('Give --position or --process, not both.')
    check_folder(options.output)
    found = judge_loop(
        options.table, command=options.command, position=options.position,
        process=options.process, set_point=options.set_point, time=options.time,
        options=table_options(command.table_words(options.said)), progress=console,
    )  # fmt: skip
    path = found.write(options.output)
    content = found.to_json()
    sizes = [
        [key, f'{s["value"]:.3g}', f'{s["low"]:.3g} to {s["high"]:.3g}', str(s['unit'])]
        for key, s in found.judgement.sizes.items()
    ]
    taken = ', '.join(f'{role} {theirs}' for role, theirs in found.names.items())
    text = command.lines(
        f'{options.table.name}: {found.headline}.',
        content['reason'],
        f'What to do: {found.to_do}' if found.to_do else '',
        command.table(['size', 'value', '95 %', ''], sizes),
        f'Columns: {taken}; {content["rows"]} rows.',
        f'Wrote {path}.',
    )
    return command.VerbResult(text, {**content, 'files': {path.name: str(path)}})
