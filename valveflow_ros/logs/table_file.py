"""Opens a table's file, whatever its separator."""

from __future__ import annotations

import csv
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs.source import Source

if TYPE_CHECKING:
    import pandas as pd

_SEPARATORS = ',;\t'
_SNIFF_BYTES = 64 * 1024


def load_frame(path: Path) -> tuple[pd.DataFrame, str, list[str]]:
    """Return the table as it stands, its separator (empty for Parquet), and notes.

    Raises
    ------
    RecordingError
        If the file cannot be read as a table.
    """
    notes: list[str] = []
    with Source.open(path) as source:
        head = source.read(0, _SNIFF_BYTES)
        source.stream.seek(0)
        try:
            if head[:4] == b'PAR1':
                frame, separator = _parquet(source), ''
            else:
                separator = _separator(_text(path, head))
                frame = _csv(source, separator, notes)
        except RecordingError:
            raise
        except MemoryError:
            raise RecordingError(path, 'is too large for the memory of this machine') from None
        except Exception as error:  # noqa: BLE001
            # pandas and pyarrow raise what they like for a file they do not understand.
            reason = str(error).strip().split('\n')[0][:160] or type(error).__name__
            raise RecordingError(path, f'cannot be read as a table ({reason})') from None
    frame.columns = [str(name).strip() for name in frame.columns]
    if frame.empty:
        raise RecordingError(path, 'is a table without rows')
    return frame, separator, notes


def _parquet(source: Source) -> pd.DataFrame:
    import pandas as pd

    frame = pd.read_parquet(source.stream)
    # A time that was made the index of the frame is a column like any other here.
    return frame if frame.index.name is None else frame.reset_index()


def _csv(source: Source, separator: str, notes: list[str]) -> pd.DataFrame:
    import pandas as pd

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter('always')
        frame = pd.read_csv(
            source.stream,
            sep=separator,
            decimal=',' if separator == ';' else '.',
            encoding='utf-8-sig',
            encoding_errors='replace',
            # The quick way of reading decimals may miss the nearest double.
            float_precision='round_trip',
            keep_default_na=False,
            na_values=[''],
            skipinitialspace=True,
            index_col=False,
            low_memory=False,
        )
    if any(issubclass(w.category, pd.errors.ParserWarning) for w in caught):
        notes.append('Rows have more cells than the header; what stands beyond it was left out.')
    return frame


def _text(path: Path, head: bytes) -> str:
    if b'\0' in head:
        raise RecordingError(path, 'is neither a CSV nor a Parquet file')
    return head.decode('utf-8-sig', errors='replace')


def _separator(text: str) -> str:
    """Return the separator that the header line holds most of."""
    header = next((line for line in text.splitlines() if line.strip()), '')
    cells = {mark: len(next(csv.reader([header], delimiter=mark))) for mark in _SEPARATORS}
    return max(_SEPARATORS, key=lambda mark: cells[mark])
