# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the executables share: signals, errors in one line, and help."""

from __future__ import annotations

import argparse
import json
import os
import re
import signal
import sys
import traceback
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import NamedTemporaryFile
from types import FrameType
from typing import NamedTuple, NoReturn

from valveflow_ros.errors import InputError, RecordingError
from valveflow_ros.parameters import Parameter

_ASKED_TO_STOP = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Stopped(BaseException):
    """A signal came where it may interrupt what runs."""


class StopFlag:
    """Set by SIGINT, SIGTERM or SIGHUP: what runs is finished, then the process ends in order."""

    def __init__(self) -> None:
        self._by: int | None = None
        self._cuts = False

    def install(self) -> StopFlag:
        """Take over the signals of this process."""
        for number in _ASKED_TO_STOP:
            signal.signal(number, self._note)
        return self

    @contextmanager
    def cutting(self) -> Iterator[None]:
        """Let signals raise `Stopped` inside, for work that leaves nothing to be finished.

        Raises
        ------
        Stopped
            One came, or had come before.
        """
        if self:
            raise Stopped
        self._cuts = True
        try:
            yield
        finally:
            self._cuts = False

    def last(self) -> None:
        """Ignore signals from now on: the process ends already, and its last steps must finish."""
        for number in _ASKED_TO_STOP:
            signal.signal(number, signal.SIG_IGN)

    def __bool__(self) -> bool:
        """Return True if the process is to stop."""
        return self._by is not None

    @property
    def name(self) -> str:
        """Return the name of the signal, empty before one came."""
        return '' if self._by is None else signal.Signals(self._by).name

    def _note(self, number: int, _frame: FrameType | None) -> None:
        self._by = number
        if self._cuts:
            self._cuts = False
            raise Stopped


_IN_C = re.compile(r',? at /\S+\.c(?:pp)?:\d+')


def one_line(error: BaseException) -> str:
    """Return the first line of an error's text, or its name if it has none.

    Where in C code it happened, as rcl writes it, tells nobody anything.
    """
    text = _IN_C.sub('', str(error)).strip().splitlines()
    return text[0] if text else type(error).__name__


def with_place(error: BaseException) -> str:
    """Return an unexpected error with where it happened, for the report of the fault."""
    found = traceback.extract_tb(error.__traceback__)
    place = f', {os.path.basename(found[-1].filename)}, line {found[-1].lineno}' if found else ''
    return f'{one_line(error)} ({type(error).__name__}{place})'


def complain(executable: str, sentence: str) -> int:
    """Print a sentence on stderr; return the exit status 1."""
    print(f'valveflow {executable}: {sentence}', file=sys.stderr)
    return 1


def wants_help(args: Sequence[str] | None) -> bool:
    """Return True if help was asked for."""
    given = sys.argv[1:] if args is None else args
    return any(word in ('-h', '--help') for word in given)


def show(text: str) -> None:
    """Print; a reader that ends early, as in ``monitor --help | head``, is no error."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        # What is left over is flushed again at the end of the process.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


class Parser(argparse.ArgumentParser):
    """A parser whose help may be read by a pipe that ends early."""

    def print_help(self, file: object = None) -> None:
        """Print the help on stdout."""
        show(self.format_help().rstrip('\n'))

    def error(self, message: str) -> NoReturn:
        """Refuse what was typed, in words."""
        super().error(re.sub(r'^argument (\S+): must ', r'\1 must ', message))


def parameter_file(values: Mapping[str, object]) -> str:
    """Write a parameter file for a launched node, and return its name.

    Texts stand in quotes in it. launch itself writes them without: a tag such as 1E5 would arrive
    as a number, and an empty text not at all.
    """
    with NamedTemporaryFile('w', prefix='valveflow_', suffix='.yaml', delete=False) as file:
        json.dump({'/**': {'ros__parameters': values}}, file)
    return file.name


def usage(about: str, example: str, rows: Iterable[Parameter]) -> str:
    """Return a page: what it does, an example, and every parameter with unit and default."""
    lines = [about, '', 'example:', f'  {example}', '', 'parameters, given as for any node:']
    for row in rows:
        default = repr(row.default) if isinstance(row.default, str) else str(row.default).lower()
        unit = f' {row.unit}' if row.unit else ''
        lines.append(f'  {row.name:28} {default}{unit}')
        lines.append(f'  {"":28} {row.sentence}')
    return '\n'.join(lines)


class UnitOfHost(NamedTuple):
    """A unit in the list of a host: absolute paths, the gateway's empty where it has none."""

    namespace: str
    params_file: str
    gateway: str


def read_units(path: str | Path) -> list[UnitOfHost]:
    """Read the list of units for `units.launch.py`.

    Raises
    ------
    RecordingError
        It cannot be read, or a file that it names is not there.
    InputError
        It is no such list, or two units have the same namespace.
    """
    import yaml

    path = Path(path).expanduser().absolute()
    try:
        rows = yaml.safe_load(path.read_text(encoding='utf-8'))
    except (OSError, UnicodeDecodeError, yaml.YAMLError):
        raise RecordingError(path, 'cannot be read as a list of units (YAML)') from None
    known = set(UnitOfHost._fields)
    if not isinstance(rows, list) or not rows:
        raise InputError(f'{path}: a list of units is expected, such as config/units.yaml.')
    units = []
    for k, row in enumerate(rows, 1):
        if not isinstance(row, dict) or not {'namespace', 'params_file'} <= set(row) <= known:
            raise InputError(
                f'{path}, unit {k}: namespace and params_file are expected, and gateway where it '
                'has one.'
            )
        files = [str(path.parent / str(row[n])) if row.get(n) else '' for n in UnitOfHost._fields]
        for name in filter(None, files[1:]):
            if not Path(name).is_file():
                raise RecordingError(name, f'is not there; unit {k} of {path.name} names it')
        units.append(UnitOfHost(str(row['namespace']), *files[1:]))
    names = [unit.namespace.strip('/') for unit in units]
    if twice := {name for name in names if names.count(name) > 1}:
        raise InputError(f"{path}: two units have the namespace '/{twice.pop()}'.")
    return units
