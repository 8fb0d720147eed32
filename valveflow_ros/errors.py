# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The exceptions of the project, each with a message of one sentence.

Every error that the project raises on purpose derives from `ValveflowError`, and
``str(error)`` is a sentence that says what is wrong, where, and what to do. The
command line prints it and exits with status 1; the node logs it and continues.
Errors of other libraries are converted where they are raised.
"""

import math
import resource
from collections.abc import Sequence


class ValveflowError(Exception):
    """Base class of all errors raised on purpose; its text is one sentence for the user."""


class InputError(ValveflowError):
    """An argument, option, column, unit or value given by the user is invalid."""


class UsageError(InputError):
    """Arguments have a wrong form or contradict each other, independent of the data."""


class ParameterError(InputError):
    """A parameter is unknown, of the wrong type, out of range, or contradicts another one."""

    def __init__(self, name: str, problem: str) -> None:
        self.name = name
        self.problem = problem
        end = '' if problem.endswith('?') else '.'
        super().__init__(f"Parameter '{name}' {problem}{end}")


class RecordingError(ValveflowError):
    """A file or folder cannot be read or written."""

    def __init__(self, path: object, problem: str) -> None:
        self.path = str(path)
        self.problem = problem
        super().__init__(f'{self.path}: {problem}.')


class DataError(ValveflowError):
    """The data are readable but do not permit the requested result."""


class TooFewSamplesError(DataError):
    """There are fewer samples or distinct openings than the task needs."""

    def __init__(self, what: str, have: int, need: int, advice: str = '') -> None:
        self.have = have
        self.need = need
        tail = f' {advice}' if advice else ''
        super().__init__(f'{what}: {have} found, at least {need} needed.{tail}')


def counted(number: float, one: str, many: str = '') -> str:
    """Return a number with its noun for a sentence: '1 row', '3 rows', '0.5 days'."""
    told = str(number) if isinstance(number, int) else f'{number:g}'
    return f'{told} {one if told == "1" else many or one + "s"}'


def listed(words: Sequence[str], last: str = 'and') -> str:
    """Return words as a list for a sentence: 'a', 'a and b', 'a, b and c'."""
    return f' {last} '.join(filter(None, (', '.join(words[:-1]), *words[-1:])))


def short(value: float, places: int = 0, sign: str = '') -> str:
    """Return a number with the given decimals, or more if it would have fewer than two digits."""
    size = abs(value)
    if 0.0 < size < math.inf:
        places = max(places, 1 - math.floor(math.log10(size)))
    return f'{value:{sign}.{places}f}'


# Compiled code ends the process without a message if it gets no memory. On two cores the engine
# needed 1 GiB of address space to load, and 2.4 GiB to identify a log of one day.
LOADING_BYTES, WORKING_BYTES = 1 << 30, 5 << 29


def check_address_space(need: int) -> None:
    """Raise `ValveflowError` if the limit of address space is below ``need`` bytes."""
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit != resource.RLIM_INFINITY and limit < need:
        raise ValveflowError(
            f'This process may use {limit >> 20} MiB of address space and needs '
            f'{need >> 20} MiB at least; raise the limit (ulimit -v).'
        )
