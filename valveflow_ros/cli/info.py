"""``valveflow info``: what is in a log."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from valveflow_ros.cli.console import Console, Outcome
from valveflow_ros.cli.options import MAPPING_HELP, add_mapping, read_mapping

_DESCRIPTION = """\
Look into a log before working with it: its span, topics and rates, the range of each signal,
gaps, values that will be rejected and why, attachments, and whether anything is damaged.

example:
  valveflow info plant.mcap"""


def arguments(parser: ArgumentParser) -> None:
    """Add description, example and options."""
    parser.description = _DESCRIPTION
    parser.usage = 'valveflow info LOG [options]'
    parser.epilog = MAPPING_HELP
    parser.add_argument('log', metavar='LOG', type=Path, help='the log to look into')
    add_mapping(parser)


def run(options: Namespace, console: Console) -> Outcome:
    """Read and describe."""
    mapping = read_mapping(options.column, options.constant)
    console.progress(0.1, 'reading')
    if not options.json:
        from valveflow_ros.cli.first_facts import first_facts

        told = first_facts(options.log)
        if told:
            console.say(told)
    from valveflow_ros.cli.inspection import inspect
    from valveflow_ros.cli.log_input import open_input

    inspected = inspect(open_input(options.log, mapping, console))
    return Outcome(inspected.text(), inspected.data())
