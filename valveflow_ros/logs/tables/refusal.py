# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Questions that a table leaves open, and the command-line options that answer them."""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from valveflow_ros.errors import InputError

# Placeholder for a name that only the user knows.
THEIRS = 'THEIRS'


class Remedy(NamedTuple):
    """A command-line option to add: its name without dashes, and its value."""

    option: str
    value: str

    def __str__(self) -> str:
        """Return the option as text for a shell."""
        # A value that begins with a dash would be parsed as an option.
        between = '=' if self.value.startswith('-') else ' '
        return f'--{self.option}{between}{quoted(self.value)}'


class RefusedError(InputError):
    """A table that can be read only with more options.

    ``where`` is the file, ``problems`` say what is unclear and which option to add, without a
    final period; ``listing`` is their text. ``remedies`` solve all problems together; if there is
    a choice, the first one. ``last`` says that the whole table was read, so that no further
    problem can follow.
    """

    def __init__(
        self, where: object, problems: str | Sequence[str], remedies: Sequence[Remedy], *,
        last: bool = False,
    ) -> None:  # fmt: skip
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
    """Return a word quoted for a shell; letters of any language need no quotes."""
    return word if re.fullmatch(r'[\w.:/=%+@,-]+', word) else shlex.quote(word)


# Compression reduces tables to about a tenth, and hardly ever to a hundredth.
_UNPACKED_FREELY = 64_000_000
_UNPACKED_TIMES = 200
DATE_ORDERS = ('dmy', 'mdy', 'ymd')
_SECONDS = {'ms': 1e-3, 's': 1.0, 'sec': 1.0, 'min': 60.0, 'm': 60.0, 'h': 3600.0}
_PERIOD = re.compile(r'(\d+(?:\.\d+)?) ?(ms|s|sec|min|m|h)?')
_LONGEST_PERIOD_S = 86_400.0
DECIMALS = ('point', 'comma')


@dataclass(frozen=True, slots=True)
class TableOptions:
    """Options for reading a table; an empty option is inferred, or the table is refused."""

    # Zone of times without a zone: a name of the tz database (``Europe/Berlin``) or an offset
    # (``+01:00``). Empty: the zone in the column name, otherwise UTC.
    time_zone: str = ''
    date_order: str = ''  # ``dmy``, ``mdy`` or ``ymd``, for dates such as 01/02/2026
    decimal: str = ''  # ``point`` or ``comma``
    sheet: str = ''  # sheet of a workbook; by default the only sheet with a table
    # Maximum unpacked megabytes of a workbook or of the needed columns of a Parquet file. Empty:
    # 64, or 200 times the file size if that is more, up to a fixed limit.
    max_unpacked: str = ''
    period: str = ''  # time between two rows of a table without times: ``60s``, ``1min``, ``60``

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
        """Return the period in s; NaN if it is empty or invalid."""
        found = _PERIOD.fullmatch(self.period.strip().lower())
        return float(found[1]) * _SECONDS[found[2] or 's'] if found else math.nan

    def unpacked_bytes(self, packed: int, bound: int) -> float:
        """Return the maximum unpacked bytes of a file; at most ``bound`` without a user's limit.

        Raises `InputError` if the limit given by the user is not a positive number.
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
