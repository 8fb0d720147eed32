"""What can follow what: every verb, its options, and what stands behind them."""

from __future__ import annotations

import argparse
import enum
from dataclasses import dataclass
from pathlib import Path

from valveflow_ros.cli.usage import Parser, add_common
from valveflow_ros.cli.verbs import VERBS, load


class Kind(enum.Enum):
    """What follows an option."""

    NOTHING = enum.auto()
    FILE = enum.auto()
    WORD = enum.auto()  # one of `Option.words`
    NAME = enum.auto()  # one of `Option.words`, and more after a sign
    VALUE = enum.auto()  # nothing that could be known


@dataclass(frozen=True, slots=True)
class Option:
    """An option: how it is written, what it is for, what follows it.

    Attributes
    ----------
    flags : tuple of str
    about : str
    kind : Kind
    words : tuple of str
        What may follow; for names with the sign that follows them.
    """

    flags: tuple[str, ...]
    about: str
    kind: Kind
    words: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Verb:
    """A verb: its name, what it does, its options, and the words that stand for themselves."""

    name: str
    about: str
    options: tuple[Option, ...]
    words: tuple[str, ...] = ()
    files: bool = True


def table() -> tuple[Verb, ...]:
    """Return every verb, read from the parsers themselves."""
    known = _known()
    return tuple(_verb(name, about, known) for name, _, about in VERBS)


def _verb(name: str, about: str, known: dict[str, tuple[str, ...]]) -> Verb:
    parser = Parser(f'valveflow {name}')
    load(name).arguments(parser)
    add_common(parser)
    options: list[Option] = []
    words: list[str] = []
    files = False
    for action in parser._actions:
        if action.option_strings:
            options.append(_option(action, known))
        elif action.choices:
            words += map(str, action.choices)
        else:
            files |= action.type is Path
    return Verb(name, about, tuple(options), tuple(words), files)


def _option(action: argparse.Action, known: dict[str, tuple[str, ...]]) -> Option:
    flags, about = tuple(action.option_strings), ' '.join((action.help or '').split())
    named = known.get(flags[-1])
    if action.nargs == 0:
        return Option(flags, about, Kind.NOTHING)
    if action.choices:
        return Option(flags, about, Kind.WORD, tuple(map(str, action.choices)))
    if named is not None:
        return Option(flags, about, Kind.NAME, named)
    return Option(flags, about, Kind.FILE if action.type is Path else Kind.VALUE)


def _known() -> dict[str, tuple[str, ...]]:
    """Return the names that may follow an option, by its long form."""
    from valveflow_ros.parameters import TABLE
    from valveflow_ros.plant.effects import catalogue
    from valveflow_ros.records import SIGNALS

    signals = tuple(f'{info.topic}=' for info in SIGNALS)
    return {
        '--effect': tuple(catalogue()),
        '--column': ('time=', *signals),
        '--constant': signals,
        '--set': tuple(f'{row.name}=' for row in TABLE),
    }
