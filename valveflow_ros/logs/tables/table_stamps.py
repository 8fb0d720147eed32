"""Makes nanoseconds of the stamps of pandas."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from valveflow_ros.records import NS_PER_S, IntArray

if TYPE_CHECKING:
    import pandas as pd

_WHOLE_LIMIT = 2.0**63
# Zones that stand behind a time: German ones tell summer from winter themselves.
_ABBREVIATED = (
    (r'\s*\b(?:UTC|GMT)$', 'Z'),
    (r'\s*\b(?:CEST|MESZ)$', '+02:00'),
    (r'\s*\b(?:CET|MEZ)$', '+01:00'),
    # PostgreSQL writes whole hours only.
    (r'(:\d{2}(?:\.\d+)?\s*[+-]\d{2})$', r'\1:00'),
)


def from_stamps(column: pd.Series[Any]) -> IntArray:
    """Return stamps, in UTC where they name no zone, as nanoseconds."""
    import pandas as pd

    if column.dtype.kind == 'M' and not isinstance(column.dtype, pd.DatetimeTZDtype):
        column = column.dt.tz_localize('UTC')
    bare = column.dt.tz_convert('UTC').dt.tz_localize(None)
    stamps: NDArray[np.datetime64] = bare.to_numpy()
    seconds = stamps.astype('datetime64[s]').astype(np.int64).astype(np.float64)
    # A year beyond 2262 does not fit into nanoseconds; some numpy let it run over in silence.
    beyond = np.abs(seconds) * NS_PER_S >= _WHOLE_LIMIT
    kept = np.where(beyond, np.datetime64('NaT', 's'), stamps).astype('datetime64[ns]')
    found: IntArray = kept.astype(np.int64)
    return found


def iso_times(text: pd.Series[Any]) -> IntArray:
    """Return texts of ISO 8601 in UTC as nanoseconds."""
    import pandas as pd

    found = pd.to_datetime(text, format='ISO8601', utc=True, errors='coerce')
    stamps = from_stamps(found)
    left = (found.isna() & text.notna()).to_numpy(dtype=bool)
    if left.any():
        # Looking at each text costs ten times as much, so only what is left is looked at.
        again = with_offsets(text[left])
        stamps[left] = from_stamps(
            pd.to_datetime(again, format='ISO8601', utc=True, errors='coerce')
        )
    return stamps


def with_offsets(text: pd.Series[Any]) -> pd.Series[Any]:
    """Return texts with their zones as offsets."""
    for words, offset in _ABBREVIATED:
        text = text.str.replace(words, offset, regex=True)
    return text
