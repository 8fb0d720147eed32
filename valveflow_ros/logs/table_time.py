"""Makes nanoseconds of whatever a historian writes as time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from valveflow_ros.errors import InputError
from valveflow_ros.records import NS_PER_S, FloatArray, IntArray

if TYPE_CHECKING:
    import pandas as pd

# Numbers above these cannot be seconds (year 5138), milliseconds, microseconds of our age.
_SCALES = ((1e11, 's', NS_PER_S), (1e14, 'ms', 1_000_000), (1e17, 'us', 1000))
_NEVER = np.iinfo(np.int64).min
_WHOLE_LIMIT = 2.0**63


def to_nanoseconds(column: pd.Series[Any], path: str, name: str) -> tuple[IntArray, list[str]]:
    """Return int64 nanoseconds and notes; a time that cannot be read is ``never()``.

    Numbers are Unix seconds unless they are too large for that; texts are ISO
    8601, taken as UTC where they name no zone.

    Raises
    ------
    InputError
        If not one value of the column is a time.
    """
    import pandas as pd

    if isinstance(column.dtype, pd.DatetimeTZDtype) or column.dtype.kind == 'M':
        stamps = _from_stamps(column)
        notes: list[str] = []
    else:
        stamps, notes = _from_cells(column)
    if not (stamps != _NEVER).any():
        raise InputError(
            f"{path}: the column '{name}' holds no time; "
            'it must be ISO 8601 or Unix seconds, or name another with --column time=THEIRS.'
        )
    return stamps, notes


def never() -> int:
    """Return the stamp that stands for a time that cannot be read."""
    return int(_NEVER)


def _from_cells(column: pd.Series[Any]) -> tuple[IntArray, list[str]]:
    import pandas as pd

    if column.dtype.kind in 'iu':
        return _from_whole(column.to_numpy())
    text = column.astype('string').str.strip()
    numbers = pd.to_numeric(text, errors='coerce')
    if float(numbers.notna().mean()) >= 0.5:
        whole = text.str.fullmatch(r'[+-]?[0-9]{1,18}').fillna(False)
        if bool(whole[numbers.notna()].all()):
            filled = text.where(whole, '0').astype('int64').to_numpy()
            stamps, notes = _from_whole(filled)
            stamps[~whole.to_numpy(dtype=bool)] = _NEVER
            return stamps, notes
        return _from_numbers(numbers.to_numpy(dtype=np.float64, na_value=np.nan))
    # Other ways of writing a date are not guessed at: 05/06 is May or June.
    return _from_stamps(pd.to_datetime(text, format='ISO8601', utc=True, errors='coerce')), []


def _from_stamps(column: pd.Series[Any]) -> IntArray:
    import pandas as pd

    if column.dtype.kind == 'M' and not isinstance(column.dtype, pd.DatetimeTZDtype):
        column = column.dt.tz_localize('UTC')
    bare = column.dt.tz_convert('UTC').dt.tz_localize(None)
    stamps: NDArray[np.datetime64] = bare.to_numpy()
    seconds = stamps.astype('datetime64[s]').astype(np.int64).astype(np.float64)
    # A year beyond 2262 does not fit into nanoseconds; some numpy let it run over in silence.
    beyond = np.abs(seconds) * NS_PER_S >= _WHOLE_LIMIT
    return (
        np.where(beyond, np.datetime64('NaT', 's'), stamps)
        .astype('datetime64[ns]')
        .astype(np.int64)
    )


def _from_whole(numbers: NDArray[np.integer[Any]]) -> tuple[IntArray, list[str]]:
    """Scale whole numbers without passing through floats, which would round nanoseconds."""
    unit, factor = _scale(numbers.astype(np.float64))
    wide = numbers.astype(np.float64) * factor
    stamps = np.where(np.abs(wide) < _WHOLE_LIMIT, numbers.astype(np.int64) * factor, _NEVER)
    return stamps.astype(np.int64), _note(unit)


def _from_numbers(numbers: FloatArray) -> tuple[IntArray, list[str]]:
    unit, factor = _scale(numbers)
    usable = np.isfinite(numbers) & (np.abs(numbers) < _WHOLE_LIMIT / factor)
    safe = np.where(usable, numbers, 0.0)
    # Whole part and fraction apart: a double of seconds since 1970 resolves 0.2 us only as a
    # whole, and its fraction would lose digits in the product.
    whole = np.floor(safe)
    fraction = np.rint((safe - whole) * factor).astype(np.int64)
    stamps = whole.astype(np.int64) * factor + fraction
    stamps[~usable] = _NEVER
    return stamps, _note(unit)


def _scale(numbers: FloatArray) -> tuple[str, int]:
    finite = np.abs(numbers[np.isfinite(numbers)])
    typical = float(np.median(finite)) if len(finite) else 0.0
    for bound, unit, factor in _SCALES:
        if typical < bound:
            return unit, factor
    return 'ns', 1


def _note(unit: str) -> list[str]:
    if unit == 's':
        return []
    return [f'The numbers in the time column are too large for seconds and were taken as {unit}.']
