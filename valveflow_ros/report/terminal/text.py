# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Lines of a terminal view: pieces of text with a style, and their terminal codes."""

from __future__ import annotations

import math
import re
import unicodedata
from argparse import ArgumentParser, ArgumentTypeError
from collections.abc import Callable, Iterator
from typing import TypeVar

from valveflow_ros.errors import listed

# Pieces of a line: the text of each, and one of the styles below or '' for plain.
Line = tuple[tuple[str, str], ...]

# Suitable for colour blindness: bad and good also differ in weight, brightness and words.
TONES = {'strong': '1', 'dim': '2', 'curve': '36', 'good': '32', 'warn': '33', 'bad': '1;31'}
# One character for one, so that the length of a line stays.
_PLAIN = str.maketrans('…·●┄─−\u202f±│°', '~|@--- ~| ')
# Longer than any displayed sentence: external text may have any length.
_LONGEST = 4096
_BLANKS = re.compile(r'[^\S\u202f]+')


def clean(text: str) -> str:
    """Return external text safe for a terminal: no control characters, one line."""
    if len(text) > _LONGEST:
        text = f'{text[: _LONGEST - 1]}…'
    text = _BLANKS.sub(' ', text).strip()
    return ''.join(c if c.isprintable() or c == '\u202f' else '?' for c in text)


def cells(text: str) -> int:
    """Return the number of terminal columns of a text."""
    wide = sum(unicodedata.east_asian_width(c) in 'WF' for c in text)
    return len(text) + wide - sum(bool(unicodedata.combining(c)) for c in text)


def cut(text: str, width: int) -> str:
    """Return a text, shortened to a width."""
    taken, kept = 0, 0
    for place, character in enumerate(text):
        taken += cells(character)
        if taken > width:
            return f'{text[:kept].rstrip()}…' if width > 0 else ''
        if taken <= width - 1:
            kept = place + 1
    return text


def wrapped(text: str, width: int, most: int) -> list[str]:
    """Return a text in at most ``most`` lines of a width; omitted text becomes an ellipsis."""
    lines = ['']
    for word in text.split(' '):
        longer = f'{lines[-1]} {word}'.lstrip()
        if cells(longer) <= width:
            lines[-1] = longer
        elif len(lines) == most:
            lines[-1] = cut(f'{lines[-1]} {word}', width)
            break
        else:
            lines.append(word)
    return [cut(line, width) for line in lines]


def labelled(label: str, text: str, tone: str, width: int, most: int) -> Iterator[Line]:
    """Yield the lines of a text, indented by a label."""
    space = len(label) + 2
    for k, line in enumerate(wrapped(clean(text), max(1, width - space), most)):
        head = f'{label}  ' if k == 0 else ' ' * space
        yield ((head, 'strong'), (line, tone))


def painted(line: Line, width: int, colour: bool, unicode: bool = True) -> str:
    """Return the terminal output of a line, at most ``width`` columns."""
    parts, left = [], width
    for text, tone in line:
        shown = cut(text, left)
        left -= cells(shown)
        if not unicode:
            bare = ''.join(c for c in shown.translate(_PLAIN) if not unicodedata.combining(c))
            shown = bare.encode('ascii', 'replace').decode()
        parts.append(f'\x1b[{TONES[tone]}m{shown}\x1b[0m' if colour and tone else shown)
        if left <= 0:
            break
    return ''.join(parts).rstrip(' ')


# Parsers of numeric options, with readable error messages.


def number(
    wanted: str, low: float, high: float, example: str, *, above: bool = False
) -> Callable[[str], float]:
    """Return a parser of finite numbers from ``low`` to ``high`` for ``type=`` of an option.

    With ``above``, ``low`` itself is not allowed. The parser raises `ArgumentTypeError` with a
    text that follows the name of the option: 'must be a number of days above 0 and at most 400,
    such as --days 10; 'ten' is no number', of ``wanted`` 'a number of days'.
    """
    # No powers of ten: 1000000 is easier to read than 1e+06.
    first, last = f'{low:.15g}', f'{high:.15g}'
    between = f' above {first} and at most {last}' if above else f' from {first} to {last}'
    if math.isinf(low) and math.isinf(high):
        between = ''

    return _parser(
        float, 'number', f'{wanted}{between}', example,
        lambda v: math.isfinite(v) and low <= v <= high and not (above and v == low),
    )  # fmt: skip


def whole(wanted: str, low: int, high: int | None, example: str) -> Callable[[str], int]:
    """Return a parser of whole numbers; parameters and errors as for `number`."""
    between = f' of {low} or more' if high is None else f' from {low} to {high}'
    top = math.inf if high is None else high
    return _parser(
        int, 'whole number', f'{wanted}{between}', example, lambda value: low <= value <= top
    )


Number = TypeVar('Number', int, float)


def _parser(
    kind: type[Number], noun: str, wanted: str, example: str, fits: Callable[[Number], bool]
) -> Callable[[str], Number]:
    def read(text: str) -> Number:
        why = f"'{text}' is not"
        try:
            value = kind(text)
            if fits(value):
                return value
        except ValueError:
            why = f"'{text}' is no {noun}"
        raise ArgumentTypeError(f'must be {wanted}, such as {example}; {why}')

    return read


def usage_sentence(message: str) -> str:
    """Rewrite an error message of argparse as a sentence: the option first, then its error."""
    missing = message.removeprefix('the following arguments are required: ')
    if missing != message:
        return f'Something is missing: {listed(missing.split(", "))}.'
    words = message.removeprefix('unrecognized arguments: ')
    if words != message:
        return f"'{words}' is one argument too many."
    about = re.fullmatch(r'argument (\S+): (.*)', message.removesuffix('.'), re.DOTALL)
    if about is None:
        return f'{message[:1].upper()}{message[1:].removesuffix(".")}.'
    name, problem = about[1].rpartition('/')[2], about[2]
    if problem.startswith('expected one argument'):
        return f'{name} wants a value after it.'
    choice = re.fullmatch(r'invalid choice: (.*) \(choose from (.*)\)', problem)
    if choice is not None:
        return f'{name} must be one of {choice[2].replace(chr(39), "")}, not {choice[1]}.'
    return f'{name} {problem}.' if problem.startswith('must ') else f'{name}: {problem}.'


def zone_argument(parser: ArgumentParser) -> None:
    """Add the option for the time zone of the output."""
    parser.add_argument(
        '--time-zone', metavar='ZONE', type=_zone, default='',
        help='zone in which times are told, such as Europe/Berlin or +01:00 (default: UTC)',
    )  # fmt: skip


def _zone(text: str) -> str:
    # Loaded late: it is not needed to list the options.
    from valveflow_ros.errors import InputError
    from valveflow_ros.records import zone_of

    try:
        zone_of(text)
    except InputError:
        raise ArgumentTypeError(
            f"must be a time zone, such as Europe/Berlin or +01:00; '{text}' is not"
        ) from None
    return text
