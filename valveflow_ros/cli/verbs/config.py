# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow config``: make a parameter file for the monitor from a log, or check one."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from valveflow_ros.cli.command import (
    Console,
    VerbResult,
    add_mapping,
    add_output,
    lines,
    mapping_of,
)
from valveflow_ros.errors import InputError, ParameterError, UsageError, counted

USAGE = 'init LOG [-o FILE] [options]\n       valveflow config check FILE'
DESCRIPTION = """\
init LOG reads a log of the plant and writes a parameter file for the monitor: every parameter
with its meaning, unit and range; those that the data show (the step, the units, the noise, time
constants) are set from the data, with the reason; the others have their default. check FILE
reads a parameter file as the monitor would and names what is wrong with it, or what differs from
the defaults.

example:
  valveflow config init plant.mcap -o monitor.yaml
  valveflow config check monitor.yaml"""


def arguments(parser: ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument(
        'task', metavar='init|check', help='make a parameter file (init), or check one'
    )
    parser.add_argument('place', metavar='LOG|FILE', type=Path, help='the log, or the file')
    told = 'where to write the parameters (default: on the screen)'
    add_output(parser, 'FILE', told, required=False)
    parser.add_argument(
        '--unit-tag',
        metavar='TAG',
        help='tag of the unit, such as U3 (default: that of the recording)',
    )
    parser.add_argument('--overwrite', action='store_true', help='replace a file that is there')
    add_mapping(parser)


def run(options: Namespace, console: Console) -> VerbResult:
    """Make or check a parameter file."""
    mapping = mapping_of(options)
    if options.task == 'check':
        return _checked(options.place)
    if options.task != 'init':
        told = 'config can init (make a parameter file) or check (one)'
        raise UsageError(f"{told}, not '{options.task}'.")
    from valveflow_ros.interface.files import check_output, whole_file
    from valveflow_ros.interface.logs import open_log
    from valveflow_ros.interface.parameter_fit import fit_parameters, parameter_file

    if options.output is not None:
        check_output(
            options.output, ('.yaml', '.yml'), source=options.place, overwrite=options.overwrite
        )
    console(0.02, 'reading')
    log = open_log(options.place, mapping, progress=console)
    found = fit_parameters(log, options.unit_tag or '', progress=console)
    text = parameter_file(options.place.name, found)
    data = {
        'file': None if options.output is None else str(options.output),
        'fitted': {f.name: {'value': f.value, 'from': f.ground} for f in found.values()},
        'left': list(found.left),
    }
    if options.output is None:
        return VerbResult(text, data)
    with whole_file(options.output) as draft:
        draft.write_text(text, encoding='utf-8')
    said = [f'  {f.name}: {f.shown}  ({f.ground})' for f in found.values()]
    head = 'Fitted to the data:' if said else 'Nothing differs from the defaults.'
    return VerbResult(lines(head, *said, *found.left, f'Wrote {options.output}.'), data)


def _checked(file: Path) -> VerbResult:
    """Read a parameter file as the monitor would, and return its changes."""
    from valveflow_ros.interface.parameter_files import given_model, given_reference
    from valveflow_ros.interface.settings import check_names, read_parameters
    from valveflow_ros.parameters import PARAMETERS, Settings

    given = read_parameters(file, [], of_node=True)
    try:
        settings = Settings(given)
        check_names(settings)
        given_model(settings)
        given_reference(settings)
    except ParameterError as error:
        raise InputError(f'{file}: {error}') from None
    changed = {
        name: settings[name] for name in settings if settings[name] != PARAMETERS[name].default
    }
    many = (
        'all as the defaults' if not changed else
        '1 differs from its default' if len(changed) == 1 else
        f'{len(changed)} differ from their defaults'
    )  # fmt: skip
    rows = (PARAMETERS[name] for name in changed)
    text = lines(
        f'{file}: the monitor takes it; {counted(len(given), "parameter")}, {many}.',
        *(
            f'  {row.name}: {_shown(changed[row.name], row.unit)}, '
            f'default {_shown(row.default, row.unit)}'
            for row in rows
        ),
    )
    return VerbResult(text, {'file': str(file), 'good': True, 'changed': changed})


def _shown(value: object, unit: str) -> str:
    if isinstance(value, float):
        text = f'{value:g}'
    else:
        text = f"'{value}'" if isinstance(value, str) else str(value).lower()
    return f'{text} {unit}'.rstrip()
