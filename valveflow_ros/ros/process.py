# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Common parts of the executables: signals, one-line errors and help."""

from __future__ import annotations

import argparse
import json
import os
import re
import signal
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import NamedTemporaryFile
from types import FrameType
from typing import NamedTuple, NoReturn

from valveflow_ros.errors import InputError, RecordingError
from valveflow_ros.parameters import Parameter
from valveflow_ros.report.terminal.text import usage_sentence

_ASKED_TO_STOP = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Stopped(BaseException):
    """A signal arrived while interruption was allowed; see `StopFlag.cutting`."""


class StopFlag:
    """Set by SIGINT, SIGTERM or SIGHUP, so that the process finishes its work and then ends."""

    def __init__(self) -> None:
        self._by: int | None = None
        self._cuts = False

    def install(self) -> StopFlag:
        """Install the signal handlers of this process."""
        for number in _ASKED_TO_STOP:
            signal.signal(number, self._note)
        return self

    @contextmanager
    def cutting(self) -> Iterator[None]:
        """Let signals raise `Stopped` in the block, for work that may be interrupted.

        Raises `Stopped` if a signal arrives or has arrived before.
        """
        if self:
            raise Stopped
        self._cuts = True
        try:
            yield
        finally:
            self._cuts = False

    def last(self) -> None:
        """Ignore signals from now on, so that the last steps of the process can finish."""
        for number in _ASKED_TO_STOP:
            signal.signal(number, signal.SIG_IGN)

    def __bool__(self) -> bool:
        """Return True if the process must stop."""
        return self._by is not None

    @property
    def name(self) -> str:
        """Return the name of the signal; empty if there was none."""
        return '' if self._by is None else signal.Signals(self._by).name

    def _note(self, number: int, _frame: FrameType | None) -> None:
        self._by = number
        if self._cuts:
            self._cuts = False
            raise Stopped


_IN_C = re.compile(r',? at /\S+\.c(?:pp)?:\d+')


def one_line(error: BaseException) -> str:
    """Return the first line of an error's text, or its type if it has no text.

    The locations in C code that rcl adds are removed.
    """
    text = _IN_C.sub('', str(error)).strip().splitlines()
    return text[0] if text else type(error).__name__


def with_place(error: BaseException) -> str:
    """Return an unexpected error with its location in the code, for a bug report."""
    found = traceback.extract_tb(error.__traceback__)
    place = f', {os.path.basename(found[-1].filename)}, line {found[-1].lineno}' if found else ''
    return f'{one_line(error)} ({type(error).__name__}{place})'


def complain(executable: str, sentence: str) -> int:
    """Print a sentence on stderr; return the exit status 1."""
    print(f'valveflow {executable}: {sentence}', file=sys.stderr)
    return 1


def answered(
    executable: str, args: Sequence[str] | None, page: Callable[[], str], example: str
) -> int | None:
    """Print the help if the arguments request it; refuse what is outside ``--ros-args``.

    Returns the exit status, or None if the node can start.
    """
    given = sys.argv[1:] if args is None else args
    if any(word in ('-h', '--help') for word in given):
        show(page())
        return 0
    of_ros = False
    for word in given:
        if word == '--ros-args' or (of_ros and word == '--'):
            of_ros = word == '--ros-args'
        elif not of_ros:
            complain(executable, f"'{word}' must follow --ros-args, as in: {example}")
            return 2
    return None


def show(text: str) -> None:
    """Print a text; a reader that ends early, as in ``monitor --help | head``, is no error."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        # The rest would be flushed at the end of the process and raise again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


class Parser(argparse.ArgumentParser):
    """A parser whose errors are sentences, and whose help may be cut off by the reader."""

    def print_help(self, file: object = None) -> None:
        """Print the help on stdout."""
        show(self.format_help().rstrip('\n'))

    def error(self, message: str) -> NoReturn:
        """Report a usage error in a sentence and exit."""
        complain(self.prog.rpartition('.')[2], f'{usage_sentence(message)} Try --help.')
        sys.exit(2)


def parameter_file(values: Mapping[str, object]) -> str:
    """Write a parameter file for a launched node, and return its name.

    Texts are quoted in it. launch itself writes them without quotes, so that a tag such as 1E5
    would be read as a number, and an empty text would be lost.
    """
    with NamedTemporaryFile('w', prefix='valveflow_', suffix='.yaml', delete=False) as file:
        json.dump({'/**': {'ros__parameters': values}}, file)
    return file.name


def usage(about: str, example: str, rows: Iterable[Parameter]) -> str:
    """Return the help text: description, example, and all parameters with unit and default."""
    lines = [about, '', 'example:', f'  {example}', '', 'parameters, given as for any node:']
    for row in rows:
        default = repr(row.default) if isinstance(row.default, str) else str(row.default).lower()
        unit = f' {row.unit}' if row.unit else ''
        lines.append(f'  {row.name:28} {default}{unit}')
        lines.append(f'  {"":28} {row.sentence}')
    return '\n'.join(lines)


class UnitOfHost(NamedTuple):
    """A unit in the list of a host, with absolute paths; ``gateway`` is empty without one."""

    namespace: str
    params_file: str
    gateway: str


def read_units(path: str | Path) -> list[UnitOfHost]:
    """Read the list of units for `units.launch.py`.

    Raises `RecordingError` if it cannot be read, or a file that it names does not exist. Raises
    `InputError` if it is no list of units, or two units have the same namespace.
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
