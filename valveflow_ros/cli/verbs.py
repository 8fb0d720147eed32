"""The verbs, and what the command says of itself before any of them is loaded."""

from __future__ import annotations

import difflib
import importlib
from argparse import ArgumentParser, Namespace
from typing import Protocol, cast

from valveflow_ros.cli.console import Console, Outcome
from valveflow_ros.cli.usage import UsageError

# In the order in which a newcomer needs them: verb, module, what it does.
VERBS: tuple[tuple[str, str, str], ...] = (
    ('simulate', 'simulate', "the paper's plant, with any effect switched on"),
    ('import', 'import_table', 'a historian table becomes a log'),
    ('info', 'info', 'what is in a log, and is it any good'),
    ('identify', 'identify', 'find the flow characteristic'),
    ('diagnose', 'diagnose', 'what the simulation gets wrong, and why'),
    ('validate', 'validate', 'hold a characteristic against other days'),
    ('compare', 'compare', 'the proposed method beside two of the literature'),
    ('compensate', 'compensate', 'the inverse curve as a table for the turbine controller'),
    ('export', 'export', 'a log becomes a table'),
    ('recover', 'recover', 'repair a broken recording'),
    ('config', 'config_verb', 'a parameter file for the monitor, fitted to a log'),
    ('watch', 'watch', 'look on while a monitor works'),
    ('completion', 'completion', 'let the shell finish what you type'),
)

OVERVIEW = """\
valveflow finds the flow characteristic of main steam valves in ordinary operating data.

{verbs}

Try it:
  valveflow simulate -o plant.mcap
  valveflow identify plant.mcap -o result
and open result/report.html.

A log is an .mcap file, a rosbag2 folder, or a table: .csv, .xlsx or .parquet.
"valveflow VERB --help" tells more about a verb, "valveflow --version" which version this is.
"""


class Verb(Protocol):
    """What the module of a verb offers."""

    def arguments(self, parser: ArgumentParser) -> None:
        """Add description, example and options."""

    def run(self, options: Namespace, console: Console) -> Outcome:
        """Do it."""


def overview() -> str:
    """Return what ``valveflow`` says without a verb."""
    lines = [f'  valveflow {name:<11} {about}' for name, _, about in VERBS]
    return OVERVIEW.format(verbs='\n'.join(lines))


def load(name: str) -> Verb:
    """Return the module of a verb.

    Raises
    ------
    UsageError
        There is no such verb; the sentence names the nearest one.
    """
    for verb, module, _ in VERBS:
        if verb == name:
            return cast(Verb, importlib.import_module(f'valveflow_ros.cli.{module}'))
    known = [verb for verb, _, _ in VERBS]
    near = difflib.get_close_matches(name, known, n=1)
    hint = f" Did you mean '{near[0]}'?" if near else f' The verbs are {", ".join(known)}.'
    raise UsageError(f"There is no verb '{name}'.{hint}")
