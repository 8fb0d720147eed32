# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Determines the date format of a table, and refuses ambiguous dates."""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import tzinfo
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from valveflow_ros.errors import InputError
from valveflow_ros.logs.tables.refusal import RefusedError, Remedy
from valveflow_ros.records import IntArray

if TYPE_CHECKING:
    import pandas as pd


# Formats of pandas; each is tried on the texts that the previous ones could not read.
_CLOCKS_24 = (' %H:%M:%S', ' %H:%M:%S.%f', ' %H:%M', '')
_CLOCKS_12 = (' %I:%M:%S %p', ' %I:%M %p', ' %I:%M:%S.%f %p', '')
_ISO = re.compile(r'\d{4}-\d{1,2}-\d{1,2}(?:[T ].*)?$|\d{8}T\d+.*$')
_PARTS = re.compile(r'(\d{1,4})([./-])(\d{1,2})\2(\d{1,4})(?=[T ,]|$)')
_NAMED = re.compile(r'(\d{1,2})[-. ]+([^\W\d]{3,9})\.?[-. ,]+(\d{2,4})(?=[T ,]|$)')
_NAMED_FIRST = re.compile(r'([^\W\d]{3,9})\.? +(\d{1,2}),? +(\d{4})(?=[T ,]|$)')
_TWELVE = re.compile(r'\d\s*[ap]\.?m\.?\s*$', re.IGNORECASE)
# An offset without a colon must follow a time of day, because a date may end in '-05' or '-2026'.
_ZONED = re.compile(
    r'(?:Z|UTC|GMT|[+-]\d{2}:\d{2})\s*$|\b(?:CES?T|MES?Z)\s*$|'
    r'(?:\d:\d{2}|T\d{2,6})(?:[.,]\d+)?\s*(?:UTC|GMT)?[+-]\d{2}(?:\d{2})?\s*$'
)
# The T of ISO 8601 between date and time, which other formats use, too.
_BETWEEN = re.compile(r'(?:(?<=\d)|^)T(?=\d)')
# Names of months that differ from the English abbreviations.
MONTHS = {
    'januar': 'jan', 'jän': 'jan', 'februar': 'feb', 'märz': 'mar', 'mär': 'mar', 'mrz': 'mar',
    'mai': 'may', 'juni': 'jun', 'juli': 'jul', 'oktober': 'oct', 'okt': 'oct',
    'dezember': 'dec', 'dez': 'dec', 'january': 'jan', 'february': 'feb', 'march': 'mar',
    'april': 'apr', 'june': 'jun', 'july': 'jul', 'august': 'aug', 'september': 'sep',
    'sept': 'sep', 'october': 'oct', 'november': 'nov', 'december': 'dec',
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class DateStyle:
    """Format of dates.

    ``formats`` are strptime formats, none for ISO 8601; ``words`` is an example for messages.
    ``zoned`` is True if the texts contain a zone, ``named`` if months are written as words.
    """

    formats: tuple[str, ...] = ()
    words: str = 'ISO 8601'
    zoned: bool = False
    named: bool = False


def date_style(cells: list[str], order: str, where: str) -> DateStyle | None:
    """Return the date format of samples from the whole file; ``None`` if they are no dates.

    ``order`` is given by the user: ``dmy``, ``mdy``, ``ymd`` or empty. ``where`` is file and
    column, for messages. Raises `InputError` if day and month cannot be distinguished.
    """
    text = [cell.strip() for cell in cells if cell.strip()]
    if not text:
        return None
    zoned = 2 * sum(bool(_ZONED.search(cell)) for cell in text) > len(text)
    if 2 * sum(bool(_ISO.match(cell)) for cell in text) > len(text):
        return DateStyle(zoned=zoned)
    clocks = _CLOCKS_12 if any(_TWELVE.search(cell) for cell in text) else _CLOCKS_24
    named = [m for cell in text if (m := _NAMED.match(cell))]
    if 2 * len(named) > len(text):
        year = '%y' if all(len(m[3]) == 2 for m in named) else '%Y'
        return _style(f'%d-%b-{year}', clocks, text[0], zoned, named=True)
    if 2 * sum(bool(_NAMED_FIRST.match(cell)) for cell in text) > len(text):
        return _style('%b-%d-%Y', clocks, text[0], zoned, named=True)
    parts = [m for cell in text if (m := _PARTS.match(cell))]
    if 2 * len(parts) <= len(text):
        return None
    mark = parts[0][2]
    if all(len(m[1]) == 4 for m in parts):
        return _style(f'%Y{mark}%m{mark}%d', clocks, text[0], zoned)
    year = '%Y' if any(len(m[4]) == 4 for m in parts) else '%y'
    day_first = _day_first(parts, mark, order, where, text[0])
    if day_first is None:
        return _style(f'%y{mark}%m{mark}%d', clocks, text[0], zoned)
    pattern = f'%d{mark}%m{mark}{year}' if day_first else f'%m{mark}%d{mark}{year}'
    return _style(pattern, clocks, text[0], zoned)


def _style(
    date: str, clocks: tuple[str, ...], example: str, zoned: bool, named: bool = False
) -> DateStyle:
    return DateStyle(tuple(date + clock for clock in clocks), f"'{example}'", zoned, named)


def _day_first(
    parts: list[re.Match[str]], mark: str, order: str, where: str, example: str
) -> bool | None:
    """Return True if the day comes before the month, ``None`` if the year comes first."""
    if order:
        return {'dmy': True, 'mdy': False, 'ymd': None}[order]
    first_large = any(int(m[1]) > 12 for m in parts)
    second_large = any(int(m[3]) > 12 for m in parts)
    if mark == '.' or (first_large and not second_large):
        return True
    if second_large and not first_large:
        return False
    both = 'day, month and year' if first_large else 'day and month'
    raise RefusedError(
        where,
        f"in '{example}' {both} cannot be told apart, here and in all rows looked at; "
        'add --date-order dmy (day first) or --date-order mdy (month first)',
        [Remedy('date-order', 'dmy')],
    )


def tidied(text: str) -> str:
    """Return a text of date and time in a form that the formats of `DateStyle` can read."""
    plain = ' '.join(_BETWEEN.sub(' ', text).split())
    plain = re.sub(r'(\d)\s*([AaPp])\.?[Mm]\.?$', lambda m: f'{m[1]} {m[2].upper()}M', plain)
    plain = re.sub(r'(:\d{2}),(\d+)', r'\1.\2', plain)
    return re.sub(r'^([^ ]+), ', r'\1 ', plain)


def english(text: str) -> str:
    """Return a date with an English month abbreviation and hyphens, such as 5-mar-2026."""
    found = _NAMED.match(text)
    if found:
        head = f'{found[1]}-{_month(found[2])}-{found[3]}'
    else:
        found = _NAMED_FIRST.match(text)
        if not found:
            return text
        head = f'{_month(found[1])}-{found[2]}-{found[3]}'
    return head + _BETWEEN.sub(' ', text[found.end() :]).replace(',', ' ', 1)


def _month(word: str) -> str:
    return MONTHS.get(word.lower(), word[:3].lower())


_HOUR_NS = 3_600_000_000_000


class LocalClock:
    """Converts local times to UTC, block by block in file order.

    In the repeated hour in autumn, the first pass is summer time; the second
    pass begins where the times go back. If the rows are in descending order
    (`newest_first`), it is reversed.
    """

    def __init__(self, zone: tzinfo, name: str, where: str) -> None:
        self._zone = zone
        self._name = name
        self._where = where
        self._last: int | None = None
        self._second = False
        self.folded = 0
        self.newest_first = False

    def to_utc(self, stamps: pd.Series[Any]) -> pd.Series[Any]:
        """Convert local timestamps without a zone to UTC; NaT stays NaT.

        Raises
        ------
        InputError
            If a time does not exist in the zone, because its clock was set forward.
        """
        import pandas as pd

        missing = stamps.isna().to_numpy()
        try:
            summer = stamps.dt.tz_localize(self._zone, ambiguous=True, nonexistent='raise')
            winter = stamps.dt.tz_localize(self._zone, ambiguous=False, nonexistent='raise')
        except Exception as error:
            raise self._nonexistent(stamps) from error
        first, second = _utc(summer), _utc(winter)
        twice = (first != second) & ~missing
        if not twice.any():
            known = stamps[~missing]
            if len(known):
                self._last, self._second = None, False
            return summer.dt.tz_convert('UTC')
        later = self._later(_local(stamps), twice)
        self.folded += int(twice.sum())
        return pd.Series(np.where(later, second, first)).pipe(
            lambda ns: pd.to_datetime(ns.where(~missing), unit='ns', utc=True)
        )

    def _later(self, local: IntArray, twice: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return True for each row in the second pass of a repeated hour."""
        later = np.zeros(len(local), dtype=np.bool_)
        places = np.flatnonzero(twice)
        for group in np.split(places, np.flatnonzero(np.diff(places) > 1) + 1):
            if self._last is None or group[0] > 0:
                self._last, self._second = None, False
            times = local[group] if self._last is None else np.r_[self._last, local[group]]
            steps = -np.diff(times) if self.newest_first else np.diff(times)
            passed = np.cumsum(steps < -_HOUR_NS // 12) > 0
            own = passed if self._last is not None else np.r_[False, passed]
            own |= self._second
            later[group] = own ^ self.newest_first
            self._second = bool(own[-1])
            self._last = int(local[group[-1]])
        if places[-1] < len(local) - 1:
            self._last, self._second = None, False
        return later

    def _nonexistent(self, stamps: pd.Series[Any]) -> InputError:
        import pandas as pd

        moved = stamps.dt.tz_localize(self._zone, ambiguous=True, nonexistent='NaT')
        wrong = moved.isna() & stamps.notna()
        if not wrong.any():
            return InputError(f'{self._where}: its times do not fit the zone {self._name}.')
        first = pd.Timestamp(stamps[wrong].iloc[0])
        before = pd.Timestamp(first - pd.Timedelta(hours=3)).tz_localize(self._zone)
        offset = before.strftime('%z')
        zone = Remedy('time-zone', f'{offset[:3]}:{offset[3:]}')
        return RefusedError(
            self._where,
            f'{first:%Y-%m-%d %H:%M:%S} does not exist in {self._name}, where the '
            f'clock was set forward then; the clock of the file was not. Use {zone}',
            [zone],
        )


def _utc(stamps: pd.Series[Any]) -> IntArray:
    bare = stamps.dt.tz_convert('UTC').dt.tz_localize(None)
    found: IntArray = bare.to_numpy().astype('datetime64[ns]').astype(np.int64)
    return found


def _local(stamps: pd.Series[Any]) -> IntArray:
    local: IntArray = stamps.to_numpy().astype('datetime64[ns]').astype(np.int64)
    return local
