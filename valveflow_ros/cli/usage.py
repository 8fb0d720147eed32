"""How options are read and wrong ones are refused."""

from __future__ import annotations

import difflib
import re
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from typing import Any, NoReturn

from valveflow_ros.errors import InputError


class UsageError(InputError):
    """The command was written wrongly; exit status 2."""


class Parser(ArgumentParser):
    """A parser that refuses with `UsageError` and keeps the layout of what we wrote."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog=prog, formatter_class=_Formatter, allow_abbrev=False, add_help=False)
        self._positionals.title = 'arguments'
        self.add_argument('-h', '--help', action='help', help='show this page')

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse; an option that does not exist is told before anything that is missing."""
        for word in [] if args is None else list(args):
            if word == '--':
                break
            name = word.partition('=')[0]
            if name.startswith('--') and name not in self._option_string_actions:
                known = [o for o in self._option_string_actions if o.startswith('--')]
                near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
                hint = f" Did you mean '{near[0]}'?" if near else ''
                raise UsageError(f"There is no option '{name}'.{hint}")
        return super().parse_args(args, namespace)

    def error(self, message: str) -> NoReturn:
        """Refuse what argparse found wrong, as a sentence."""
        missing = message.removeprefix('the following arguments are required: ')
        if missing != message:
            *most, last = missing.split(', ')
            text = f'Something is missing: {", ".join(most)}{" and " if most else ""}{last}.'
            raise UsageError(text)
        text = _sentence(message)
        raise UsageError(text if text.endswith('.') else f'{text}.')


def _sentence(message: str) -> str:
    """Put what argparse says into words: the option first, then what is wrong with it."""
    about = re.fullmatch(r'argument (\S+): (.*)', message, re.DOTALL)
    if about is None:
        words = message.removeprefix('unrecognized arguments: ')
        return message[:1].upper() + message[1:] if words == message else (
            f"There is no place for '{words}' here."
        )  # fmt: skip
    name, problem = about[1].rpartition('/')[2], about[2]
    if problem.startswith('expected one argument'):
        return f'{name} wants a value after it'
    choice = re.fullmatch(r'invalid choice: (.*) \(choose from (.*)\)', problem)
    if choice is not None:
        return f'{name} must be one of {choice[2].replace(chr(39), "")}, not {choice[1]}'
    return f'{name} {problem}' if problem.startswith('must ') else f'{name}: {problem}'


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
