# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Converts the times in a historian's table to nanoseconds since 1970.

The format of the dates is determined first, and ambiguous dates are refused.
"""

from __future__ import annotations

import re
from contextlib import suppress
from dataclasses import dataclass
from datetime import tzinfo
from itertools import pairwise, product
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from valveflow_ros.errors import InputError
from valveflow_ros.logs.tables.refusal import AS_SEEN, RefusedError, Remedy, TableOptions
from valveflow_ros.records import NS_PER_S, FloatArray, IntArray, zone_of

if TYPE_CHECKING:
    import pandas as pd


_HOUR_NS = 3600 * NS_PER_S
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
    found = _NAMED.match(text) or _NAMED_FIRST.match(text)
    if not found:
        return text
    words = (word if word.isdigit() else _month(word) for word in found.groups())
    return '-'.join(words) + _BETWEEN.sub(' ', text[found.end() :]).replace(',', ' ', 1)


def _month(word: str) -> str:
    return MONTHS.get(word.lower(), word[:3].lower())


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

        Raises `InputError` if a time does not exist, because the clock was set forward.
        """
        import pandas as pd

        missing = stamps.isna().to_numpy()
        try:
            summer = stamps.dt.tz_localize(self._zone, ambiguous=True, nonexistent='raise')
            winter = stamps.dt.tz_localize(self._zone, ambiguous=False, nonexistent='raise')
        except Exception as error:
            raise self._nonexistent(stamps) from error
        first, second = from_stamps(summer), from_stamps(winter)
        twice = (first != second) & ~missing
        if not twice.any():
            if not missing.all():
                self._last, self._second = None, False
            return summer.dt.tz_convert('UTC')
        later = self._later(from_stamps(stamps), twice)
        self.folded += int(twice.sum())
        ns = pd.Series(np.where(later, second, first)).where(~missing)
        return pd.to_datetime(ns, unit='ns', utc=True)

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


_WHOLE_LIMIT = 2.0**63
# Zones written after a time; the German ones distinguish summer and winter time.
_ABBREVIATED = (
    (r'\s*\b(?:UTC|GMT)$', 'Z'),
    (r'\s*\b(?:CEST|MESZ)$', '+02:00'),
    (r'\s*\b(?:CET|MEZ)$', '+01:00'),
    # PostgreSQL writes offsets of whole hours only.
    (r'(:\d{2}(?:\.\d+)?\s*[+-]\d{2})$', r'\1:00'),
)


def from_stamps(column: pd.Series[Any]) -> IntArray:
    """Return timestamps as ns since 1970; those without a zone are taken as UTC."""
    import pandas as pd

    if column.dtype.kind == 'M' and not isinstance(column.dtype, pd.DatetimeTZDtype):
        column = column.dt.tz_localize('UTC')
    bare = column.dt.tz_convert('UTC').dt.tz_localize(None)
    stamps: NDArray[np.datetime64] = bare.to_numpy()
    seconds = stamps.astype('datetime64[s]').astype(np.int64).astype(np.float64)
    # A year after 2262 does not fit into int64 ns; some versions of numpy overflow silently.
    beyond = np.abs(seconds) * NS_PER_S >= _WHOLE_LIMIT
    kept = np.where(beyond, np.datetime64('NaT', 's'), stamps).astype('datetime64[ns]')
    found: IntArray = kept.astype(np.int64)
    return found


def iso_times(text: pd.Series[Any]) -> IntArray:
    """Return ISO 8601 texts as ns since 1970; those without a zone are taken as UTC."""
    import pandas as pd

    found = pd.to_datetime(text, format='ISO8601', utc=True, errors='coerce')
    stamps = from_stamps(found)
    left = (found.isna() & text.notna()).to_numpy(dtype=bool)
    if left.any():
        # Replacing zone names is ten times as slow, so it is done only for unread texts.
        again = with_offsets(text[left])
        stamps[left] = from_stamps(
            pd.to_datetime(again, format='ISO8601', utc=True, errors='coerce')
        )
    return stamps


def with_offsets(text: pd.Series[Any]) -> pd.Series[Any]:
    """Return the texts with zone names replaced by offsets."""
    for words, offset in _ABBREVIATED:
        text = text.str.replace(words, offset, regex=True)
    return text


# Above these limits, numbers are too large to be s (year 5138), ms or us since 1970.
_SCALES = ((1e11, 's', NS_PER_S), (1e14, 'ms', 1_000_000), (1e17, 'us', 1000))
# Range of plausible Excel day numbers: 36526 is the year 2000, 73050 the year 2100.
_EXCEL_DAYS = (36526.0, 73050.0)


def as_numbers(samples: list[str]) -> FloatArray:
    """Return the numbers among the samples, empty if fewer than half are numbers."""
    numbers = []
    text = [cell.strip() for cell in samples if cell.strip()]
    for cell in text:
        with suppress(ValueError):
            numbers.append(float(cell if '.' in cell else cell.replace(',', '.')))
    return np.array(numbers if 2 * len(numbers) >= len(text) else [], dtype=np.float64)


def is_excel(numbers: FloatArray) -> bool:
    """Return True if the numbers are Excel days: between 2000 and 2100, with small steps."""
    finite = numbers[np.isfinite(numbers)]
    if not len(finite):
        return False
    low, high = _EXCEL_DAYS
    inside = bool(((finite >= low) & (finite <= high)).all())
    steps = np.abs(np.diff(finite))
    fine = not len(steps) or float(np.median(steps)) < 0.5
    return inside and fine and bool((finite % 1.0 != 0.0).any())


def scale(numbers: FloatArray) -> tuple[str, int]:
    """Return the unit of times since 1970, judged by their size, and its length in ns."""
    finite = np.abs(numbers[np.isfinite(numbers)])
    typical = float(np.median(finite)) if len(finite) else 0.0
    for bound, unit, factor in _SCALES:
        if typical < bound:
            return unit, factor
    return 'ns', 1


def descending(samples: list[str]) -> bool:
    """Return True if most samples are in descending order, comparing their texts."""
    text = [cell.strip() for cell in samples if cell.strip()]
    # Only samples of the same day are compared, since dates may not sort as text.
    pairs = [(a, b) for a, b in pairwise(text) if a[:10] == b[:10]]
    falling = sum(a > b for a, b in pairs)
    return 2 * falling > len(pairs)


# The value for a time that cannot be read.
NEVER = int(np.iinfo(np.int64).min)
# The Excel day number of 1970-01-01.
_EXCEL_EPOCH_DAYS = 25569
# Maximum number of autumns in a log.
_FEW = 8


FIRST_ROW_NS = 946_684_800 * NS_PER_S


class RowClock:
    """Makes times for a table without times: from 2000-01-01, with the period of the options."""

    zone = ''

    def __init__(self, options: TableOptions) -> None:
        self._period = f'{options.period_s:g} s'
        self._step_ns = round(options.period_s * NS_PER_S)

    def at(self, first: int, count: int) -> IntArray:
        """Return the times of ``count`` rows, beginning with row ``first``."""
        return FIRST_ROW_NS + np.arange(first, first + count, dtype=np.int64) * self._step_ns

    def finish(self) -> list[str]:
        """Return notes about the times."""
        return [
            f'The table has no times; its rows were taken to be {self._period} apart, '
            'oldest first, from 2000-01-01 on.'
        ]

    @property
    def words(self) -> str:
        """Return the origin of the times, as a clause."""
        return f'counted, {self._period} a row'

    @property
    def told_zone(self) -> str:
        """Return the zone."""
        return 'UTC'


class TimeReader:
    """Reads the time column block by block, with the same format for all blocks.

    ``samples`` are texts of the column from the whole file; ``where`` and ``name`` are file and
    column, for messages. ``zone`` is the zone in the file; the zone in ``options`` has priority.
    Raises `InputError` if dates are ambiguous, or the zone is unknown.
    """

    def __init__(
        self, samples: list[str], where: str, name: str, options: TableOptions = AS_SEEN,
        zone: str = '',
    ) -> None:  # fmt: skip
        self.where = f"{where}: the column '{name}'"
        self._file, self._name = where, name
        self.zone = options.time_zone or zone
        self.notes: list[str] = []
        self.any_time = False
        self.kind = ''
        self._zoned = False
        self._last: int | None = None
        self._set_back: list[int] = []
        self._other_steps_back = 0
        place = zone_of(self.zone)
        self._clock = None if place is None else LocalClock(place, self.zone, where)
        if self._clock is not None and len(samples) > 1:
            self._clock.newest_first = descending(samples)
        numbers = as_numbers(samples)
        self._excel = is_excel(numbers)
        self._unit, self._factor = scale(numbers)
        self._style = None if len(numbers) else date_style(samples, options.date_order, self.where)

    def read(self, column: pd.Series[Any]) -> IntArray:
        """Return int64 nanoseconds; a time that cannot be read is `NEVER`.

        Numbers are Excel days, or times since 1970 in a unit judged by their
        size. Texts without a zone are in the zone of this reader.
        """
        import pandas as pd

        if isinstance(column.dtype, pd.DatetimeTZDtype):
            self._zoned = True
            stamps = from_stamps(column)
        elif column.dtype.kind == 'M':
            stamps = self._from_local(column)
        else:
            stamps = self._from_cells(column)
        self.any_time = self.any_time or bool((stamps != NEVER).any())
        if self._clock is None and not self._zoned and not self.zone and self.kind != 'seconds':
            self._look_back(stamps[stamps != NEVER])
        return stamps

    def _look_back(self, stamps: IntArray) -> None:
        """Find steps back by an hour, which a local clock makes in autumn."""
        steps = np.diff(stamps if self._last is None else np.r_[self._last, stamps])
        back = np.flatnonzero(steps < 0)
        hour = (steps[back] >= -_HOUR_NS) & (steps[back] < -_HOUR_NS // 2)
        self._other_steps_back += int((~hour).sum())
        if hour.any():
            at = int(back[hour][0]) + (0 if self._last is None else -1)
            self._set_back.append(int(stamps[at]) if at >= 0 else int(self._last or 0))
        self._last = int(stamps[-1]) if len(stamps) else self._last

    def finish(self) -> list[str]:
        """Return notes about the times, after all blocks were read.

        Raises `InputError` if no value was a time, or they go back by an hour as local times do.
        """
        if not self.any_time:
            raise RefusedError(
                self._file,
                f"the column '{self._name}' holds no time; it must be a date with a time of day, "
                'or Unix seconds: name another with --column time=THEIRS, or say with --period '
                '60s how far apart the rows are',
                [Remedy('period', '60s')],
            )
        if 0 < len(self._set_back) <= _FEW and not self._other_steps_back:
            when = np.datetime64(self._set_back[0], 'ns').astype('datetime64[s]')
            raise RefusedError(
                self.where,
                f'the times go back by an hour after {when}, as those of a local '
                'clock do in autumn; add --time-zone with the place, such as --time-zone '
                'Europe/Berlin (or --time-zone UTC if they are UTC all the same)',
                [Remedy('time-zone', 'Europe/Berlin')],
            )
        notes = [*self.notes]
        if self._clock is not None and self._clock.folded:
            notes.append(
                f'In autumn the clock of {self.zone} is set back: {self._clock.folded} rows '
                'are in the hour that comes twice; its first pass was taken as summer time.'
            )
        return notes

    @property
    def words(self) -> str:
        """Return the format of the times, as a clause."""
        if self.kind == 'seconds':
            return f'numbers of {self._unit} since 1970'
        return f'written like {self.kind}' if self.kind.startswith("'") else self.kind

    @property
    def told_zone(self) -> str:
        """Return the zone of the times and its origin, as a clause."""
        if self.kind in ('seconds', ''):
            return 'UTC'
        if self._zoned:
            return 'given in each time'
        return self.zone or 'UTC (the times name no zone)'

    def _from_cells(self, column: pd.Series[Any]) -> IntArray:
        import pandas as pd

        if column.dtype.kind in 'iu' and not self._excel:
            return self._whole(column.to_numpy())
        if column.dtype.kind == 'f' and not hasattr(column.dtype, 'na_value'):
            return self._numbers(column.to_numpy(dtype=np.float64))
        text = column.astype('string').str.strip()
        numbers = pd.to_numeric(text, errors='coerce')
        if self._style is not None or not float(numbers.notna().mean()) >= 0.5:
            return self._from_texts(text)
        whole = text.str.fullmatch(r'[+-]?[0-9]{1,18}').fillna(False)
        if bool(whole[numbers.notna()].all()) and not self._excel:
            filled = text.where(whole, '0').astype('int64').to_numpy()
            stamps = self._whole(filled)
            stamps[~whole.to_numpy(dtype=bool)] = NEVER
            return stamps
        return self._numbers(numbers.to_numpy(dtype=np.float64, na_value=np.nan))

    def _from_texts(self, text: pd.Series[Any]) -> IntArray:
        import pandas as pd

        style = self._style or DateStyle()
        self._zoned = self._zoned or style.zoned
        if not style.formats:
            self.kind = 'ISO 8601'
            if style.zoned or self._clock is None:
                return iso_times(text)
            return self._from_local(pd.to_datetime(text, format='ISO8601', errors='coerce'))
        self.kind = style.words
        return self._styled(text, style)

    def _styled(self, text: pd.Series[Any], style: DateStyle) -> IntArray:
        """Parse texts with the formats of a style; each is used on what is still unread."""
        import pandas as pd

        found, left = self._by_formats(text, style)
        if left.any():
            # Tidying is slow, so it is done only for texts that no format matches.
            tidy = text[left].map(lambda t: english(tidied(t)) if style.named else tidied(t),
                                  na_action='ignore')  # fmt: skip
            again, _ = self._by_formats(with_offsets(tidy) if style.zoned else tidy, style)
            found = found.copy()
            found[left] = again
        return self._from_local(found) if not style.zoned else from_stamps(pd.to_datetime(found))

    def _by_formats(
        self, text: pd.Series[Any], style: DateStyle
    ) -> tuple[pd.Series[Any], NDArray[np.bool_]]:
        import pandas as pd

        kind = 'datetime64[ns, UTC]' if style.zoned else 'datetime64[ns]'
        found = pd.Series(pd.NaT, index=text.index, dtype=kind)
        left = text.notna().to_numpy(dtype=bool)
        for form, suffix in product(style.formats, ('%z', ' %z') if style.zoned else ('',)):
            if not left.any():
                break
            read = pd.to_datetime(
                text[left], format=form + suffix, errors='coerce', utc=style.zoned
            )
            found[left] = read.astype(kind)
            left = found.isna().to_numpy() & text.notna().to_numpy(dtype=bool)
        return found, left

    def _from_local(self, stamps: pd.Series[Any]) -> IntArray:
        if not self.kind:
            self.kind = 'stamps of the file'
        return from_stamps(stamps if self._clock is None else self._clock.to_utc(stamps))

    def _whole(self, numbers: NDArray[np.integer[Any]]) -> IntArray:
        """Convert whole numbers to ns in integers, because floats would round nanoseconds."""
        self._say_numbers()
        wide = numbers.astype(np.float64) * self._factor
        near = np.abs(wide) < _WHOLE_LIMIT
        return np.where(near, numbers.astype(np.int64) * self._factor, NEVER).astype(np.int64)

    def _numbers(self, numbers: FloatArray) -> IntArray:
        import pandas as pd

        if self._excel:
            self.kind = 'days of a workbook'
            days = np.where(np.isfinite(numbers), numbers, 0.0) - _EXCEL_EPOCH_DAYS
            # A double of days resolves about 1 us.
            milli = np.rint(days * 86_400_000.0).astype(np.int64) * 1_000_000
            local = pd.Series(milli.astype('datetime64[ns]')).where(np.isfinite(numbers))
            return self._from_local(local)
        self._say_numbers()
        usable = np.isfinite(numbers) & (np.abs(numbers) < _WHOLE_LIMIT / self._factor)
        safe = np.where(usable, numbers, 0.0)
        # A double of seconds since 1970 resolves 0.2 us. Whole part and fraction are converted
        # separately, because their product would lose digits.
        whole = np.floor(safe)
        fraction = np.rint((safe - whole) * self._factor).astype(np.int64)
        stamps: IntArray = whole.astype(np.int64) * self._factor + fraction
        stamps[~usable] = NEVER
        return stamps

    def _say_numbers(self) -> None:
        self.kind = 'seconds'
        if self._unit != 's' and not self.notes:
            self.notes.append(
                'The numbers in the time column are too large for seconds and were taken as '
                f'{self._unit}.'
            )
