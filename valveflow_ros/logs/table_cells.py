"""Makes numbers of the cells of a table, and says which were none."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from valveflow_ros.records import ByteArray, FloatArray, Quality

if TYPE_CHECKING:
    import pandas as pd


QUALITY_SUFFIX = '_quality'


@dataclass(frozen=True, slots=True)
class Column:
    """Numbers of a column; ``bad`` counts cells that hold something else than a number."""

    values: FloatArray
    bad: int = 0
    empty: int = 0
    first_bad_row: int = -1
    first_bad_text: str = ''


def to_numbers(column: pd.Series[Any], decimal_comma: bool) -> Column:
    """Return float64 values; NaN where a cell is empty or no number.

    Parameters
    ----------
    column : Series
        Cells in the order of the file.
    decimal_comma : bool
        Whether ``1,5`` means one and a half.
    """
    import pandas as pd

    if column.dtype.kind in 'iufb' and not hasattr(column.dtype, 'na_value'):
        values = column.to_numpy(dtype=np.float64)
        return Column(values, empty=int(np.isnan(values).sum()))
    text = column.astype('string').str.strip()
    empty = text.isna() | text.str.lower().isin(_EMPTY)
    clean = text.str.replace(',', '.', regex=False) if decimal_comma else text
    numbers = pd.to_numeric(clean, errors='coerce')
    values = numbers.to_numpy(dtype=np.float64, na_value=np.nan)
    bad = np.isnan(values) & ~empty.to_numpy(dtype=bool)
    if not bad.any():
        return Column(values, empty=int(empty.sum()))
    first = int(bad.argmax())
    return Column(values, int(bad.sum()), int(empty.sum()), first, str(text.iloc[first])[:40])


def to_quality(column: pd.Series[Any]) -> ByteArray:
    """Return a `Quality` per cell; an empty or unknown code is bad."""
    import pandas as pd

    codes = pd.to_numeric(column, errors='coerce').to_numpy(dtype=np.float64, na_value=np.nan)
    known = np.isin(codes, [int(quality) for quality in Quality])
    return np.where(known, codes, float(Quality.BAD)).astype(np.uint8)


_EMPTY = frozenset({'', 'nan', 'na', 'n/a', 'null', 'none', '-'})
