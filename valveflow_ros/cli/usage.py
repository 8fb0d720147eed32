"""How options are read and wrong ones are refused."""

from __future__ import annotations

from argparse import ArgumentParser, RawDescriptionHelpFormatter
from typing import NoReturn

from valveflow_ros.errors import InputError


class UsageError(InputError):
    """The command was written wrongly; exit status 2."""


class Parser(ArgumentParser):
    """A parser that refuses with `UsageError` and keeps the layout of what we wrote."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog=prog, formatter_class=_Formatter, allow_abbrev=False)

    def error(self, message: str) -> NoReturn:
        """Refuse what argparse found wrong, as a sentence."""
        text = message[:1].upper() + message[1:]
        raise UsageError(text if text.endswith('.') else f'{text}.')


class _Formatter(RawDescriptionHelpFormatter):
    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=28, width=92)


def add_common(parser: ArgumentParser) -> None:
    """Add what every verb knows."""
    parser.add_argument(
        '--json', action='store_true', help='print the result as JSON, for programs'
    )
    parser.add_argument(
        '--quiet', action='store_true', help='say nothing but warnings and the result'
    )
