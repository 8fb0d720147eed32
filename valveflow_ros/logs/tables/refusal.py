# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a table leaves open, and the option of the command that would decide it."""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from valveflow_ros.errors import InputError

# Stands for a name that only the person knows.
THEIRS = 'THEIRS'


class Remedy(NamedTuple):
    """An option to add: its name without the dashes, and its value."""

    option: str
    value: str

    def __str__(self) -> str:
        """Return it as it can be pasted into a shell."""
        # A value that begins with a dash would be taken for an option.
        between = '=' if self.value.startswith('-') else ' '
        return f'--{self.option}{between}{quoted(self.value)}'


class RefusedError(InputError):
    """A table that could be read if the person said more.

    Parameters
    ----------
    where : object
        The file.
    problems : str or sequence of str
        What is left open, and what to add; sentences without their full stop.
    remedies : sequence of Remedy
        With all of these together the problems are gone; where there is a choice, the first.
    last : bool
        All of the table was read: nothing else can come after this.

    Attributes
    ----------
    listing : str
        The sentences alone.
    """

    def __init__(
        self,
        where: object,
        problems: str | Sequence[str],
        remedies: Sequence[Remedy],
        *,
        last: bool = False,
    ) -> None:
        self.where = str(where)
        self.problems = (problems,) if isinstance(problems, str) else tuple(problems)
        self.remedies = tuple(remedies)
        self.last = last
        self.listing = f'{self.where}: {_listed(self.problems)}'
        more = len(self.problems) > 1 and self.remedies
        super().__init__(f'{self.listing}\nAdd {self.options}' if more else self.listing)

    @property
    def options(self) -> str:
        """Return the options in one line."""
        return ' '.join(map(str, self.remedies))


def _listed(problems: Sequence[str]) -> str:
    if len(problems) == 1:
        return f'{problems[0]}.'
    listed = '\n'.join(f'  {k}. {problem}.' for k, problem in enumerate(problems, 1))
    return f'{len(problems)} things are open, which the table does not say:\n{listed}'


def quoted(word: str) -> str:
    """Return a word as a shell takes it; letters of any language need no quotes."""
    return word if re.fullmatch(r'[\w.:/=%+@,-]+', word) else shlex.quote(word)


# Tables shrink to a tenth when they are packed, hardly ever to a hundredth.
_UNPACKED_FREELY = 64_000_000
_UNPACKED_TIMES = 200
DATE_ORDERS = ('dmy', 'mdy', 'ymd')
_SECONDS = {'ms': 1e-3, 's': 1.0, 'sec': 1.0, 'min': 60.0, 'm': 60.0, 'h': 3600.0}
_PERIOD = re.compile(r'(\d+(?:\.\d+)?) ?(ms|s|sec|min|m|h)?')
_LONGEST_PERIOD_S = 86_400.0
DECIMALS = ('point', 'comma')


@dataclass(frozen=True, slots=True)
class TableOptions:
    """How to read a table; what is empty is seen in the file or refused as ambiguous.

    Attributes
    ----------
    time_zone : str
        Zone of times that name none: a name of the tz database (``Europe/Berlin``)
        or an offset (``+01:00``). Empty means UTC.
    date_order : str
        ``dmy`` or ``mdy``, for dates such as 01/02/2026.
    decimal : str
        ``point`` or ``comma``.
    sheet : str
        Sheet of a workbook; the first with a table by default.
    max_unpacked : str
        Megabytes to which a workbook or the needed columns of a Parquet file may unpack. Empty:
        64, or 200 times the file if that is more, up to a fixed bound.
    period : str
        Time from one row to the next of a table without times: ``60s``, ``1min``, ``60``.
    """

    time_zone: str = ''
    date_order: str = ''
    decimal: str = ''
    sheet: str = ''
    max_unpacked: str = ''
    period: str = ''

    def __post_init__(self) -> None:
        if self.date_order not in ('', *DATE_ORDERS):
            raise InputError(f"--date-order must be dmy, mdy or ymd, not '{self.date_order}'.")
        if self.decimal not in ('', *DECIMALS):
            raise InputError(f"--decimal must be point or comma, not '{self.decimal}'.")
        if self.max_unpacked:
            self.unpacked_bytes(0, 0)
        if self.period and not 0.0 < self.period_s <= _LONGEST_PERIOD_S:
            raise InputError(
                '--period must be a time from one row to the next, such as 60s, 1min or 500ms, '
                f"not '{self.period}'."
            )

    @property
    def period_s(self) -> float:
        """Return the period in s, NaN if none was given or it is no time."""
        found = _PERIOD.fullmatch(self.period.strip().lower())
        return float(found[1]) * _SECONDS[found[2] or 's'] if found else math.nan

    def unpacked_bytes(self, packed: int, bound: int) -> float:
        """Return to how many bytes a file of ``packed`` bytes may unpack; ``bound`` at most.

        Raises
        ------
        InputError
            The limit that a person set is no positive number.
        """
        if not self.max_unpacked:
            return min(bound, max(_UNPACKED_FREELY, _UNPACKED_TIMES * packed))
        try:
            given = float(self.max_unpacked)
        except ValueError:
            given = math.nan
        if not 0.0 < given < math.inf:
            raise InputError(
                f"--max-unpacked must be a number of megabytes, not '{self.max_unpacked}'."
            )
        return given * 1e6


AS_SEEN = TableOptions()
