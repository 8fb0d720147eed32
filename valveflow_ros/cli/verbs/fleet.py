# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow fleet``: analyse many units and months."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from valveflow_ros.cli import command

USAGE = 'LOGS... -o DIR [options]'
DESCRIPTION = """\
Identify, diagnose and monitor many logs of many units, side by side on the cores of this machine
or on a Dask cluster. The curve of a log is the reference of the next one of its unit. DIR gets
fleet.html (which units lose power, since when and why), fleet.parquet (one row for each log) and
the reports of each log in units/UNIT/LOG. Run it again after a stop, or with further logs: a log
that is done and unchanged is not done again.

The unit of a log is the folder it stands in; its logs are taken in the order of their names. A
manifest says otherwise: a CSV file with the columns unit, log and, if wanted, options, such as
--constant main_steam_temperature=540. Paths in it are relative to its folder.

example:
  valveflow fleet plants -o result        with plants/UNIT/2026-01.csv, 2026-02.csv, ...
  valveflow fleet fleet.csv -o result --no-diagnosis
  valveflow fleet fleet.csv -o /shared/result --scheduler tcp://10.0.0.5:8786"""


def arguments(parser: ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument(
        'logs', metavar='LOGS', nargs='+', type=Path, help='logs, folders, globs or manifests'
    )
    command.add_output(parser, 'DIR', 'folder for the results, made if absent')
    parser.add_argument(
        '--scheduler', metavar='ADDRESS', default='',
        help='a Dask scheduler, such as tcp://10.0.0.5:8786, whose workers see LOGS and DIR under '
        'the same names (default: one worker for each core of this machine)',
    )  # fmt: skip
    parser.add_argument(
        '--no-diagnosis', action='store_true',
        help="leave out the monitor's own diagnoses; each log is diagnosed once all the same",
    )  # fmt: skip
    command.add_parameters(parser)
    command.add_mapping(parser)


def run(options: Namespace, console: command.Console) -> command.VerbResult:
    """Read the list of tasks, run them, report the outcome."""
    console(0.0, 'starting')
    from valveflow_ros.interface.fleets.fleet import fleet
    from valveflow_ros.report.words import counted, signed

    words = [f'--params={options.params}'] if options.params else []
    for name, said in (('set', options.pairs), ('constant', options.constant)):
        words += [f'--{name}={value}' for value in said]
    for given in options.column:
        option, value = ('column', given) if isinstance(given, str) else given
        words.append(f'--{option}={value}')
    words += ['--no-diagnosis'] if options.no_diagnosis else []
    found = fleet(
        options.logs, options.output, scheduler=options.scheduler, options=words,
        progress=console,
    )  # fmt: skip
    moved = sorted((s for s in found.stories if s.moved), key=lambda s: s.change_mw or 0.0)
    rows = [
        [s.unit, f'{signed(s.change_mw or 0.0)} {s.output_unit}', s.since,
         ', '.join(s.causes) or 'not named']
        for s in moved
    ]  # fmt: skip
    none = (
        'No unit is seen to have changed.'
        if any(s.change_mw is not None for s in found.stories)
        else 'No unit can be judged yet: a change needs two logs with a curve.'
    )
    head = ['unit that changed', 'mean', 'since', 'named (perhaps only a part)']
    content = found.to_json()
    text = command.lines(
        f'{counted(len(found.stories), "unit")}: {counted(found.anew, "log")} done now, '
        f'{found.unchanged} unchanged, {found.failed} without a result.',
        command.table(head, rows) or none,
        *(f'{s.unit} {log}: {why}' for s in found.stories for log, why in s.failures[:3]),
        f'Wrote {" and ".join(content["files"].values())}.',
    )  # fmt: skip
    return command.VerbResult(text, content)
