"""Opens a table's file, whatever its kind, and gives its rows block by block."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from valveflow_ros.errors import InputError, RecordingError
from valveflow_ros.logs.source import Source
from valveflow_ros.logs.tables.historian_layout import (
    Heading,
    cells_of,
    decimal_mark,
    encoding_of,
    heading,
    separator_of,
)
from valveflow_ros.logs.tables.table_cells import Marks
from valveflow_ros.logs.tables.table_lines import Lines
from valveflow_ros.logs.tables.table_options import AS_SEEN, TableOptions

if TYPE_CHECKING:
    import pandas as pd

BLOCK_ROWS = 200_000
_HEAD_BYTES = 256 * 1024
_HEAD_ROWS = 400
_PEEKS = 48  # places in the middle of a long file that are looked at
_PEEK_BYTES = 4096
BOOKS = ('.xlsx', '.xlsm')


@dataclass
class TableFile:
    """A table that was looked at and not yet read.

    Attributes
    ----------
    path : Path
    heading : Heading
        Its columns.
    rows : list of list of str
        Rows of data from its beginning, from places on the way, and from its end.
    marks : Marks or None
        How numbers are written; ``None`` where a comma may be either mark.
    notes : list of str
        Sentences; complete when all blocks were read.
    share : float
        How much of a text was read so far, 0 to 1.
    """

    path: Path
    heading: Heading
    rows: list[list[str]]
    marks: Marks | None = Marks()  # noqa: RUF009
    encoding: str = ''
    separator: str = ''
    skip: tuple[int, ...] = ()
    sheet: str = ''
    notes: list[str] = field(default_factory=list)
    share: float = 0.0

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the columns as they stand in the file."""
        return self.heading.names

    def blocks(self, places: Sequence[int]) -> Iterator[pd.DataFrame]:
        """Yield the columns at these places, named by them, block by block.

        Raises
        ------
        RecordingError
            If the file cannot be read on.
        """
        wanted = sorted(set(places))
        with _translated(self.path):
            any_row = False
            for frame in self._frames(wanted):
                if len(frame):
                    any_row = True
                    frame.columns = wanted
                    yield frame
            if not any_row:
                raise RecordingError(self.path, 'is a table without rows')

    def _frames(self, places: list[int]) -> Iterator[pd.DataFrame]:
        if not self.separator:
            from valveflow_ros.logs.tables.historian_binary import (
                parquet_blocks,
                sheet_blocks,
            )

            if self.sheet:
                below = max((self.heading.row, *self.heading.others)) + 1
                yield from sheet_blocks(self.path, self.sheet, below, places)
            else:
                yield from parquet_blocks(self.path, places)
            return
        yield from self._text_frames(places)

    def _text_frames(self, places: list[int]) -> Iterator[pd.DataFrame]:
        import pandas as pd

        marks = self.marks or Marks()
        with Source.open(self.path) as source:
            with warnings.catch_warnings():
                # From pandas 4 on the exact way of reading decimals is the only one.
                warnings.simplefilter('ignore', DeprecationWarning)
                frames = pd.read_csv(
                    Lines(self.path, source.stream, self.encoding, self.separator),
                    sep=self.separator,
                    decimal=marks.decimal,
                    header=0,
                    skiprows=list(self.skip),
                    usecols=places,
                    # The quick way of reading decimals may miss the nearest double.
                    float_precision='round_trip',
                    keep_default_na=False,
                    na_values=[''],
                    skipinitialspace=True,
                    index_col=False,
                    low_memory=False,
                    chunksize=BLOCK_ROWS,
                )
            for frame in frames:
                self.share = min(1.0, source.stream.tell() / source.size)
                yield frame


def look_at(path: Path, options: TableOptions = AS_SEEN) -> TableFile:
    """Look at a table: its kind, its columns, how its numbers are written.

    Raises
    ------
    RecordingError
        If the file cannot be read as a table.
    """
    with Source.open(path) as source:
        head = source.read(0, _HEAD_BYTES)
        with _translated(path):
            if head[:4] == b'PAR1':
                from valveflow_ros.logs.tables.historian_binary import look_at_parquet

                names, rows = look_at_parquet(path)
                blank = ('',) * len(names)
                units = heading([list(names)]).units
                return TableFile(path, Heading(0, (), names, units, blank), rows)
            if path.suffix.lower() in BOOKS or head[:4] == b'PK\x03\x04':
                return _look_at_book(path, options)
            return _look_at_text(source, path, head, options)


def _look_at_book(path: Path, options: TableOptions) -> TableFile:
    from valveflow_ros.logs.tables.historian_binary import look_at_sheet

    sheet, rows = look_at_sheet(path, options.sheet, _HEAD_ROWS)
    top = heading(rows)
    below = max((top.row, *top.others)) + 1
    marks = _marks(rows[below:], '\t', options)
    return TableFile(path, top, rows[below:], marks, sheet=sheet)


def _look_at_text(source: Source, path: Path, head: bytes, options: TableOptions) -> TableFile:
    encoding = encoding_of(head)
    if encoding is None:
        raise RecordingError(path, 'is neither a CSV, an Excel nor a Parquet file')
    text = head.decode(encoding, errors='replace')
    lines = text.splitlines()
    if len(head) == _HEAD_BYTES:
        lines = lines[:-1] or lines
    lines = lines[:_HEAD_ROWS]
    told = lines[0].strip('\ufeff"\' ') if lines else ''
    separator = told[4:5] if told.lower().startswith('sep=') and len(told) == 5 else ''
    first = 1 if separator else 0
    separator = separator or separator_of([line for line in lines if line.strip()])
    rows = [[] if k < first else cells_of(line, separator) for k, line in enumerate(lines)]
    top = heading(rows)
    if not any(name for name in top.names):
        raise RecordingError(path, 'is a table without a header')
    below = max((top.row, *top.others)) + 1
    data = [row for row in rows[below:] if any(cell.strip() for cell in row)]
    data += _peeks(source, encoding, separator, len(head))
    skip = (*range(top.row), *top.others)
    notes = []
    if any(cell.strip() for row in data for cell in row[len(top.names) :]):
        notes.append('Rows have more cells than the header; what stands beyond it was left out.')
    return TableFile(
        path, top, data, _marks(data, separator, options), encoding, separator, skip, notes=notes
    )


def _peeks(source: Source, encoding: str, separator: str, start: int) -> list[list[str]]:
    """Return some rows from places throughout the rest of a long file, the last one too."""
    rest = source.size - start
    if rest <= 0:
        return []
    wide = 2 if encoding.startswith('utf-16') else 1
    codec = 'utf-16-le' if encoding == 'utf-16' else encoding.removesuffix('-sig')
    rows = []
    step = max(rest // _PEEKS, _PEEK_BYTES)
    places = {*range(start, source.size, step), max(start, source.size - _PEEK_BYTES)}
    for place in sorted(places):
        text = source.read(place - place % wide, _PEEK_BYTES).decode(codec, errors='replace')
        # What was cut at both ends is no whole row.
        lines = text.splitlines()[1:]
        at_end = place + _PEEK_BYTES >= source.size
        rows += [cells_of(line, separator) for line in (lines if at_end else lines[:-1])[-3:]]
    return rows


def _marks(rows: list[list[str]], separator: str, options: TableOptions) -> Marks | None:
    if options.decimal == 'comma':
        return Marks(',', '.')
    if options.decimal == 'point':
        return Marks('.', ',')
    found = decimal_mark([cell for row in rows for cell in row], separator)
    if found is None:
        return None
    if separator == ';' and found == ('.', ''):
        # Whole numbers only so far: what such tables write later is a comma.
        points = any('.' in cell for row in rows for cell in row)
        return Marks('.' if points else ',')
    return Marks(*found)


@contextmanager
def _translated(path: Path) -> Iterator[None]:
    """Turn what pandas, pyarrow and openpyxl raise into sentences."""
    try:
        yield
    except (RecordingError, InputError, GeneratorExit):
        raise
    except MemoryError:
        raise RecordingError(path, 'is too large for the memory of this machine') from None
    except Exception as error:  # noqa: BLE001
        # They raise what they like for a file they do not understand.
        reason = str(error).strip().split('\n')[0][:160] or type(error).__name__
        raise RecordingError(path, f'cannot be read as a table ({reason})') from None
