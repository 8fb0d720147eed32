"""``valveflow config``: a parameter file for the monitor, fitted to a log, or checked."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from valveflow_ros.cli.console import Console, Outcome
from valveflow_ros.cli.options import MAPPING_HELP, add_mapping, read_mapping
from valveflow_ros.cli.usage import UsageError

_DESCRIPTION = """\
init LOG reads a log of the plant and writes a parameter file for the monitor: every parameter
with its meaning, unit and range; those that the data tell (the step, the units, the noise, time
constants) are fitted and say from what, the rest has its default. check FILE reads a parameter
file as the monitor would and names what is wrong with it, or what differs from the defaults.

example:
  valveflow config init plant.mcap -o monitor.yaml
  valveflow config check monitor.yaml"""


def arguments(parser: ArgumentParser) -> None:
    """Add description, example and options."""
    parser.description = _DESCRIPTION
    parser.usage = (
        'valveflow config init LOG [-o FILE] [options]\n       valveflow config check FILE'
    )
    parser.epilog = MAPPING_HELP
    parser.add_argument('task', metavar='init|check', help='make a parameter file, or check one')
    parser.add_argument('place', metavar='LOG|FILE', type=Path, help='the log, or the file')
    parser.add_argument(
        '-o', '--output', metavar='FILE', type=Path,
        help='where to write the parameters (default: on the screen)',
    )  # fmt: skip
    parser.add_argument('--unit-tag', metavar='TAG', help='tag of the unit, such as U3')
    parser.add_argument('--overwrite', action='store_true', help='replace a file that is there')
    add_mapping(parser)


def run(options: Namespace, console: Console) -> Outcome:
    """Make or check a parameter file."""
    mapping = read_mapping(options.column, options.constant)
    if options.task == 'check':
        from valveflow_ros.cli.config_check import check

        return check(options.place)
    if options.task != 'init':
        raise UsageError(f"config can init or check, not '{options.task}'.")
    from valveflow_ros.cli.config_fit import fitted
    from valveflow_ros.cli.config_text import parameter_file
    from valveflow_ros.cli.files import check_output, whole_file
    from valveflow_ros.cli.log_input import open_input

    if options.output is not None:
        check_output(
            options.output, ('.yaml', '.yml'), source=options.place, overwrite=options.overwrite
        )
    console.progress(0.02, 'reading')
    log = open_input(options.place, mapping, console)
    found = fitted(log, options.unit_tag, console)
    text = parameter_file(options.place.name, found)
    data = {
        'file': None if options.output is None else str(options.output),
        'fitted': {f.name: {'value': f.value, 'from': f.ground} for f in found.values()},
        'left': list(found.left),
    }
    if options.output is None:
        return Outcome(text, data)
    with whole_file(options.output) as draft:
        draft.write_text(text, encoding='utf-8')
    lines = [f'  {f.name}: {f.shown}  ({f.ground})' for f in found.values()]
    said = ['Fitted to the data:', *lines] if lines else ['Nothing differs from the defaults.']
    return Outcome('\n'.join([*said, *found.left, f'Wrote {options.output}.']), data)
