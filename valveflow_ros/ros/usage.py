"""What the executables answer to ``--help``."""

from __future__ import annotations

import argparse
import os
import re
import sys
from collections.abc import Iterable, Sequence
from typing import NoReturn

from valveflow_ros.config import Parameter

_WIDTH = 28


def wants_help(args: Sequence[str] | None) -> bool:
    """Tell whether somebody asked what there is to give."""
    given = sys.argv[1:] if args is None else args
    return any(word in ('-h', '--help') for word in given)


def show(text: str) -> None:
    """Print, also where whoever reads has had enough: ``monitor --help | head``."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        # What is left over is flushed again at the end of the process.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


class Parser(argparse.ArgumentParser):
    """A parser whose help may be cut short by whoever reads it."""

    def print_help(self, file: object = None) -> None:
        """Print the help on stdout."""
        show(self.format_help().rstrip('\n'))

    def error(self, message: str) -> NoReturn:
        """Refuse what was typed, in words."""
        super().error(re.sub(r'^argument (\S+): must ', r'\1 must ', message))


def usage(about: str, example: str, rows: Iterable[Parameter]) -> str:
    """Return a page: what it does, an example, and every parameter with unit and default."""
    lines = [about, '', 'Parameters are given as for any ROS 2 node:', f'  {example}', '']
    for row in rows:
        default = repr(row.default) if isinstance(row.default, str) else str(row.default).lower()
        unit = f' {row.unit}' if row.unit else ''
        lines.append(f'  {row.name:{_WIDTH}} {default}{unit}')
        lines.append(f'  {"":{_WIDTH}} {row.sentence}')
    return '\n'.join(lines)
