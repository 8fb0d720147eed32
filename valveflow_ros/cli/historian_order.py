"""In which order the rows of a table are taken, and which are left out."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from valveflow_ros.logs.tables.tables import order_note
from valveflow_ros.records import IntArray


@dataclass(frozen=True, slots=True)
class Ordered:
    """In which order the rows of a file are to be taken.

    Attributes
    ----------
    time_ns : int64 (n,)
        In the order of the file.
    order : int64 (m,) or None
        Rows to be taken; ``None``: all, as they stand.
    duplicates : int
        Rows left out for having a time that stood there before.
    sorted_how : str
        A sentence, if the rows had to be sorted.
    """

    time_ns: IntArray
    order: IntArray | None
    duplicates: int = 0
    sorted_how: str = ''

    @classmethod
    def of(cls, time_ns: IntArray, long: bool) -> Ordered:
        """Sort the times; of a table with a row a value no time is one too many."""
        steps = np.diff(time_ns)
        order, how = None, ''
        if (steps < 0).any():
            newest_first = bool((steps <= 0).all())
            how = '' if long else order_note(newest_first)
            order = np.arange(len(time_ns))
            if newest_first:
                order = order[::-1]
            order = order[np.argsort(time_ns[order], kind='stable')]
            steps = np.diff(time_ns[order])
        again = 0 if long else int((steps == 0).sum())
        if again:
            order = np.arange(len(time_ns)) if order is None else order
            order = order[np.r_[True, steps != 0]]
        return cls(time_ns, order, again, how)

    @property
    def rows_read(self) -> int:
        """Return how many rows have a time."""
        return len(self.time_ns)

    @property
    def rows(self) -> int:
        """Return how many rows are taken."""
        return len(self.time_ns) if self.order is None else len(self.order)

    @property
    def span_ns(self) -> tuple[int, int]:
        """Return the first and the last time."""
        return int(self.time_ns.min()), int(self.time_ns.max())

    @property
    def period_s(self) -> float:
        """Return the median step between different times, 0 if there is none."""
        steps = np.diff(self.distinct())
        return float(np.median(steps)) / 1e9 if len(steps) else 0.0

    def distinct(self) -> IntArray:
        """Return the different times in their order."""
        times = self.time_ns if self.order is None else self.time_ns[self.order]
        return times[np.r_[True, np.diff(times) > 0]]

    def blocks(self, size: int) -> Iterator[tuple[IntArray, slice | IntArray]]:
        """Yield times and rows in the order of time."""
        for start in range(0, self.rows, size):
            if self.order is None:
                part = slice(start, min(start + size, self.rows))
                yield self.time_ns[part], part
            else:
                rows = self.order[start : start + size]
                yield self.time_ns[rows], rows
