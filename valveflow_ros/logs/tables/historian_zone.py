"""Turns local times into UTC, and says what the change of the clocks did to them."""

from __future__ import annotations

import re
import zoneinfo
from datetime import timedelta, timezone, tzinfo
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from valveflow_ros.errors import InputError
from valveflow_ros.logs.tables.historian_refusal import RefusedError, Remedy
from valveflow_ros.records import IntArray

if TYPE_CHECKING:
    import pandas as pd

_OFFSET = re.compile(r'(?:UTC|GMT)?\s*([+-])(\d{1,2})(?::?(\d{2}))?')
_NEVER = np.iinfo(np.int64).min
_HOUR_NS = 3_600_000_000_000


def zone_of(name: str) -> tzinfo | None:
    """Return a time zone by its name or offset; ``None`` for UTC.

    Raises
    ------
    InputError
        If there is no such zone.
    """
    text = name.strip()
    if text.upper() in ('', 'UTC', 'Z', 'GMT'):
        return None
    offset = _OFFSET.fullmatch(text)
    if offset and int(offset[2]) <= 14:
        minutes = 60 * int(offset[2]) + int(offset[3] or 0)
        return timezone(timedelta(minutes=minutes if offset[1] == '+' else -minutes))
    try:
        return zoneinfo.ZoneInfo(text)
    except (zoneinfo.ZoneInfoNotFoundError, ValueError, OSError):
        raise InputError(
            f"--time-zone '{name}' is not known; use a name such as Europe/Berlin, or an offset "
            'such as +01:00.'
        ) from None


class LocalClock:
    """Gives local times their place in UTC, block by block in the order of the file.

    In the hour that comes twice in autumn the first pass is summer time; the
    second begins where the times go back. Where rows stand newest first
    (`newest_first`) it is the other way round.
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
        """Return naive local stamps as stamps in UTC; NaT stays NaT.

        Raises
        ------
        InputError
            If a time does not exist in the zone: its clock was being set forward.
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
        """Tell for each row whether it belongs to the second pass of an hour."""
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
