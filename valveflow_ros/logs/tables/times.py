# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Converts the times in a historian's table to nanoseconds since 1970."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from valveflow_ros.errors import InputError
from valveflow_ros.logs.tables.dates import (
    DateStyle,
    LocalClock,
    date_style,
    english,
    tidied,
)
from valveflow_ros.logs.tables.refusal import AS_SEEN, RefusedError, Remedy, TableOptions
from valveflow_ros.records import NS_PER_S, FloatArray, IntArray, zone_of

if TYPE_CHECKING:
    import pandas as pd


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
        try:
            numbers.append(float(cell if '.' in cell else cell.replace(',', '.')))
        except ValueError:
            continue
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
_HOUR_NS = 3600 * NS_PER_S
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
            f'The table has no times; its rows were taken to be {self._period} apart, from '
            '2000-01-01 on.'
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
        self,
        samples: list[str],
        where: str,
        name: str,
        options: TableOptions = AS_SEEN,
        zone: str = '',
    ) -> None:
        self.where = f"{where}: the column '{name}'"
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

        Raises
        ------
        InputError
            If no value was a time, or the times go back by an hour as local times do.
        """
        if not self.any_time:
            raise InputError(
                f'{self.where} holds no time; it must be a date with a time of day, or Unix '
                'seconds, or name another with --column time=THEIRS.'
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
                'stand in the hour that comes twice; its first pass was taken as summer time.'
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
            return 'as each time says'
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
        for form in style.formats:
            if not left.any():
                break
            suffixes = ('%z', ' %z') if style.zoned else ('',)
            for suffix in suffixes:
                read = pd.to_datetime(
                    text[left], format=form + suffix, errors='coerce', utc=style.zoned
                )
                found[left] = read.astype(kind)
                left = found.isna().to_numpy() & text.notna().to_numpy(dtype=bool)
                if not left.any():
                    break
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
