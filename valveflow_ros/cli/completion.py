"""``valveflow completion``: let the shell finish what one begins to type."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from valveflow_ros.cli.console import Console, Outcome

SHELLS = ('bash', 'zsh', 'fish')

_DESCRIPTION = """\
Print a script that teaches the shell to finish verbs, options, effects, signals and parameters
when Tab is pressed. One line in the file that the shell reads at its start is enough.

example:
  valveflow completion bash

in ~/.bashrc:                   source <(valveflow completion bash)
in ~/.zshrc, after compinit:    source <(valveflow completion zsh)
in ~/.config/fish/config.fish:  valveflow completion fish | source"""


def arguments(parser: ArgumentParser) -> None:
    """Add description, example and options."""
    parser.description = _DESCRIPTION
    parser.usage = 'valveflow completion SHELL'
    parser.add_argument('shell', metavar='SHELL', choices=SHELLS, help='bash, zsh or fish')


def run(options: Namespace, console: Console) -> Outcome:
    """Print the script."""
    from valveflow_ros.cli.completion_scripts import script
    from valveflow_ros.cli.completion_table import table

    text = script(options.shell, table())
    return Outcome(text, {'shell': options.shell, 'script': text})
