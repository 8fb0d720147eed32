"""Opens a table's file, whatever its kind, and gives its rows block by block."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from valveflow_ros.errors import InputError, RecordingError
from valveflow_ros.logs.source import Source
from valveflow_ros.logs.tables.cells import Marks
from valveflow_ros.logs.tables.layout import (
    Heading,
    cells_of,
    decimal_mark,
    encoding_of,
    heading,
    separator_of,
)
from valveflow_ros.logs.tables.refusal import AS_SEEN, TableOptions

if TYPE_CHECKING:
    import pandas as pd


# Refuses a quote that is not closed, before it swallows the rows below it.


# What a cell of Excel holds at most, in letters and in line breaks; a comment has far fewer.
LONGEST_CELL = 32_767
_MOST_BREAKS = 253


class Quotes:
    """Follows a text that passes by in pieces.

    A quote opens a cell only where the cell begins, and a doubled one within it
    stands for itself: so do pandas and most programs that write tables.

    Parameters
    ----------
    path : Path
        The file, for the sentence.
    separator : str
        What parts its cells.
    """

    def __init__(self, path: Path, separator: str) -> None:
        self._path = path
        ends = f'{re.escape(separator)}\r\n'
        # Group 1: from a quote on that is not closed in what has passed.
        self._cell = re.compile(
            rf'(?:\A|[{ends}]) *"(?:[^"]*(?:""[^"]*)*"(?!")|(.*\Z))', re.DOTALL
        )
        # A cell that is closed in its own line: nearly all are, and this is quick.
        self._closed = re.compile(rf'(?:\A|(?<=[{ends}])) *"[^"\r\n]*(?:""[^"\r\n]*)*"(?!")')
        self._rest = ''
        self._line = 1  # of the first letter of the rest

    def follow(self, text: str) -> None:
        """Look at the next piece.

        Raises
        ------
        RecordingError
            If a cell in quotes is longer than any cell is.
        """
        text = self._rest + text
        end = _last_line(text, [])
        lines, rest = text[:end], text[end:]
        long = len(rest) > LONGEST_CELL and '"' in rest
        if long or ('"' in lines and '"' in self._closed.sub('', lines)):
            end = self._looked_at(text)
        self._line += _breaks(text[:end])
        self._rest = text[end:]

    def _looked_at(self, text: str) -> int:
        """Judge cell by cell; return where the last line begins."""
        begun, cells = len(text), []
        for cell in self._cell.finditer(text):
            opened = cell.start() + cell[0].index('"')
            self._judge(text, opened, cell.end())
            # A quote that ends the piece may be the first of two.
            if cell.start(1) >= 0 or cell.end() == len(text):
                begun = opened
            else:
                cells.append((opened, cell.end()))
        # What is kept begins with a line, so that it is known where its cells begin.
        return _last_line(text[:begun], cells)

    def _judge(self, text: str, opened: int, end: int) -> None:
        breaks = _breaks(text[opened:end]) if end - opened > _MOST_BREAKS else 0
        if end - opened <= LONGEST_CELL and breaks <= _MOST_BREAKS:
            return
        line = self._line + _breaks(text[:opened])
        raise RecordingError(
            self._path,
            f'has in line {line} a quote that is not closed within {LONGEST_CELL} letters or '
            f'{_MOST_BREAKS} lines, as the text of a cell would be; close it there, or take it '
            'away',
        )


def _breaks(text: str) -> int:
    """Return how many lines end in a text; what is left of Windows' two letters counts once."""
    return text.count('\n') or text.count('\r')


def _last_line(text: str, cells: list[tuple[int, int]]) -> int:
    """Return where the last line of a text begins; breaks within cells begin none."""
    # The first of Windows' two letters waits for the second.
    end = len(text) - text.endswith('\r')
    for opened, closed in [*reversed(cells), (0, 0)]:
        found = max(text.rfind('\n', closed, end), text.rfind('\r', closed, end)) + 1
        if found:
            return found
        end = opened
    return 0


# Gives the text of a table and refuses a line or a cell that would fill the memory.

LONGEST_LINE = 1 << 20
_PIECE = 1 << 18


class Lines(io.TextIOWrapper):
    """A text that is read in pieces, none of whose lines and cells is without end.

    Parameters
    ----------
    path : Path
        The file, for the sentence.
    stream : BinaryIO
        Its bytes; closed with this.
    encoding : str
        What does not fit it is replaced.
    separator : str
        What parts the cells.
    """

    def __init__(self, path: Path, stream: BinaryIO, encoding: str, separator: str) -> None:
        super().__init__(stream, encoding=encoding, errors='replace', newline='')
        self._path = path
        self._length = 0
        self._quotes = Quotes(path, separator)

    def read(self, size: int | None = -1, /) -> str:
        """Return up to so many letters; all in one piece is more than anybody asks for.

        Raises
        ------
        RecordingError
            If a line is longer than `LONGEST_LINE` letters, or a quote is not closed.
        """
        text = super().read(_PIECE if size is None or size < 0 else min(size, _PIECE))
        ends = [place for mark in '\n\r' if (place := text.find(mark)) >= 0]
        self._length += min(ends, default=len(text))
        if self._length > LONGEST_LINE:
            raise RecordingError(
                self._path, f'has a line of more than {LONGEST_LINE} letters; no table has'
            )
        if ends:
            self._length = len(text) - 1 - max(text.rfind('\n'), text.rfind('\r'))
        self._quotes.follow(text)
        return text


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
            from valveflow_ros.logs.tables.binary import parquet_blocks, sheet_blocks

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
                from valveflow_ros.logs.tables.binary import look_at_parquet

                names, rows = look_at_parquet(path)
                blank = ('',) * len(names)
                units = heading([list(names)]).units
                return TableFile(path, Heading(0, (), names, units, blank), rows)
            if path.suffix.lower() in BOOKS or head[:4] == b'PK\x03\x04':
                return _look_at_book(path, options)
            return _look_at_text(source, path, head, options)


def _look_at_book(path: Path, options: TableOptions) -> TableFile:
    from valveflow_ros.logs.tables.binary import look_at_sheet

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
