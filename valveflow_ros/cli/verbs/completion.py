# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``valveflow completion``: completion of the command line in the shell."""

from __future__ import annotations

import os
from argparse import ArgumentParser, Namespace
from collections.abc import Callable
from typing import Any

from valveflow_ros.cli.command import Console, VerbResult

SHELLS = ('bash', 'zsh', 'fish')

USAGE = 'SHELL'
DESCRIPTION = """\
Print a script that teaches the shell to finish verbs, options, effects, signals and parameters
when Tab is pressed. One line in the file that the shell reads at its start is enough.

example:
  valveflow completion bash

in ~/.bashrc:                   source <(valveflow completion bash)
in ~/.zshrc, after compinit:    source <(valveflow completion zsh)
in ~/.config/fish/config.fish:  valveflow completion fish | source"""


def arguments(parser: ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument('shell', metavar='SHELL', choices=SHELLS, help='bash, zsh or fish')


def run(options: Namespace, console: Console) -> VerbResult:
    """Print the script, which calls the command at each Tab."""
    from argcomplete.shell_integration import shellcode

    text = shellcode(['valveflow'], True, options.shell)
    return VerbResult(text, {'shell': options.shell, 'script': text})


def complete(verbs: list[tuple[str, str]], parser_of: Callable[[str], ArgumentParser]) -> None:
    """Answer a completion request of the shell for the words typed so far, and exit.

    ``verbs`` are names and descriptions; ``parser_of`` returns the parser of a verb.
    """
    import argcomplete

    typed = os.environ.get('COMP_LINE', '').split()
    known = {'effect': _effects, 'column': _columns, 'constant': _signals, 'pairs': _parameters}
    whole = ArgumentParser('valveflow', allow_abbrev=False)
    whole.add_argument('--version', action='store_true')
    below: Any = whole.add_subparsers()
    for name, about in verbs:
        # Only the selected verb is loaded.
        if name not in typed[1:2]:
            below.add_parser(name, help=about)
            continue
        parser = parser_of(name)
        for action in parser._actions:
            if action.dest in known:
                action.completer = known[action.dest]  # type: ignore[attr-defined]
        below.add_parser(name, help=about, parents=[parser], add_help=False, allow_abbrev=False)
    argcomplete.autocomplete(whole, always_complete_options=False)


def _effects(**_: object) -> list[str]:
    from valveflow_ros.plant.effects import catalogue

    return list(catalogue())


def _signals(**_: object) -> list[str]:
    from valveflow_ros.records import SIGNALS

    return [f'{info.topic}=' for info in SIGNALS]


def _columns(action: Any, **_: object) -> list[str]:
    return ['time=', *_signals()] if '--column' in action.option_strings else []


def _parameters(**_: object) -> list[str]:
    from valveflow_ros.parameters import TABLE

    return [f'{row.name}=' for row in TABLE]
