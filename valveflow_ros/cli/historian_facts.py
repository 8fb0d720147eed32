"""What is to be told of a table that was imported."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from valveflow_ros.records import FloatArray
from valveflow_ros.report.quality import Gap

_SAMPLE = 500_000  # so many values are enough to judge a unit by


@dataclass(frozen=True, slots=True)
class SignalSource:
    """Where one signal comes from; ``low`` and ``high`` in the engine's unit.

    ``words`` counts what stands in cells in place of numbers, the most frequent
    first; ``empty`` counts cells that are empty or say so; ``ground`` says why the
    column was chosen, where that had to be found out; ``air`` what is added to a gauge
    pressure.
    """

    topic: str
    column: str
    written_unit: str
    unit: str
    low: float
    high: float
    missing: int
    constant: bool
    words: dict[str, int] = field(default_factory=dict)
    empty: int = 0
    ground: str = ''
    air: str = ''


@dataclass(frozen=True, slots=True)
class Imported:
    """A table that was understood.

    Attributes
    ----------
    sources : list of SignalSource
        In the order of `Signal`.
    rows_read, rows, duplicates : int
        Rows of the file with a readable time, those used, and those left out
        for having one that stood there before.
    period_s : float
        Median step.
    span_ns : tuple of int
        First and last time.
    gaps : list of Gap
        The longest first.
    ignored : tuple of str
        Columns that were not used.
    notes : tuple of str
        Sentences of the reader.
    time_zone : str
        The zone the times were taken to be in.
    time_words : str
        How the times are written.
    """

    path: Path
    sources: list[SignalSource]
    rows_read: int
    rows: int
    duplicates: int
    period_s: float
    span_ns: tuple[int, int]
    gaps: list[Gap]
    ignored: tuple[str, ...]
    notes: tuple[str, ...]
    time_zone: str
    time_words: str = ''

    def summary(self) -> dict[str, Any]:
        """Return everything, for a program."""
        return {
            'source': str(self.path),
            'rows': self.rows,
            'rows_read': self.rows_read,
            'duplicates': self.duplicates,
            'period_s': self.period_s,
            'start_ns': self.span_ns[0],
            'end_ns': self.span_ns[1],
            'time_zone': self.time_zone,
            'gaps': len(self.gaps),
            'signals': [asdict(source) for source in self.sources],
            'ignored': list(self.ignored),
            'notes': list(self.notes),
        }

    def as_json(self) -> str:
        """Return the summary as the text that goes into the log; the file's name only."""
        content = {**self.summary(), 'source': self.path.name}
        finite = [
            {k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in s.items()}
            for s in content['signals']
        ]
        return json.dumps({**content, 'signals': finite}, indent=2, allow_nan=False)


class Tally:
    """Range and a sample of a column that passes by in blocks."""

    def __init__(self) -> None:
        self.low = self.high = float('nan')
        self.known = 0
        self.missing = 0
        self._parts: list[FloatArray] = []
        self._stride = 1

    def add(self, values: FloatArray) -> None:
        """Count a block, values as they stand in the file."""
        finite = values[np.isfinite(values)]
        self.known += len(finite)
        self.missing += len(values) - len(finite)
        if not len(finite):
            return
        self.low = float(np.fmin(self.low, finite.min()))
        self.high = float(np.fmax(self.high, finite.max()))
        self._parts.append(finite[:: self._stride].copy())
        if sum(map(len, self._parts)) > _SAMPLE:
            self._stride *= 2
            self._parts = [np.concatenate(self._parts)[::2].copy()]

    def sample(self) -> FloatArray:
        """Return values that stand for all, the lowest and the highest among them."""
        ends = [np.array([self.low, self.high])] if self.known else []
        return np.concatenate([*self._parts, *ends]) if self._parts else np.empty(0)
