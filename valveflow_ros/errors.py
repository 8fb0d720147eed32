# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Everything that can go wrong for a person, each as one sentence.

Every error the project raises on purpose derives from `ValveflowError`, and
``str(error)`` is a sentence that says what was wrong, where, and what to do.
The command line prints it and exits with status 1; the node logs it and goes
on. Errors of other libraries are translated at the edge where they arise.
"""

import math
import resource
from collections.abc import Sequence


class ValveflowError(Exception):
    """Root of all errors raised on purpose; its text is one sentence for a person."""


class InputError(ValveflowError):
    """An argument, option, column, unit or value given by a person cannot be used."""


class UsageError(InputError):
    """Arguments are of the wrong form or contradict each other, whatever the data hold."""


class ParameterError(InputError):
    """A parameter is unknown, of the wrong type, out of range, or at odds with another."""

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
    """The data are readable but do not carry what was asked of them."""


class TooFewSamplesError(DataError):
    """Fewer samples, or fewer distinct openings, than the task needs."""

    def __init__(self, what: str, have: int, need: int, advice: str = '') -> None:
        self.have = have
        self.need = need
        tail = f' {advice}' if advice else ''
        super().__init__(f'{what}: {have} found, at least {need} needed.{tail}')


def counted(number: float, one: str, many: str = '') -> str:
    """Write a number and its noun for a sentence: '1 row', '3 rows', '0.5 days'."""
    told = str(number) if isinstance(number, int) else f'{number:g}'
    return f'{told} {one if told == "1" else many or one + "s"}'


def listed(words: Sequence[str], last: str = 'and') -> str:
    """Write words as a list for a sentence: 'a', 'a and b', 'a, b and c'."""
    return f' {last} '.join(filter(None, (', '.join(words[:-1]), *words[-1:])))


def short(value: float, places: int = 0, sign: str = '') -> str:
    """Write a number with so many decimals, and more where that leaves no two digits of it."""
    size = abs(value)
    if 0.0 < size < math.inf:
        places = max(places, 1 - math.floor(math.log10(size)))
    return f'{value:{sign}.{places}f}'


# Compiled code ends the process without a word when it gets no memory. On two cores the engine
# was loaded in 1 GiB of address space, and a log of a day identified in 2.4 GiB.
LOADING_BYTES, WORKING_BYTES = 1 << 30, 5 << 29


def check_address_space(need: int) -> None:
    """Refuse a limit of address space below ``need`` bytes; raises `ValveflowError`."""
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit != resource.RLIM_INFINITY and limit < need:
        raise ValveflowError(
            f'This process may use {limit >> 20} MiB of address space and needs '
            f'{need >> 20} MiB at least; raise the limit (ulimit -v).'
        )
