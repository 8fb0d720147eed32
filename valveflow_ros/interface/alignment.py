"""Readings of a log put together into rows; without the engine, which takes long to load."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import numpy as np

from valveflow_ros.interface import SILENT
from valveflow_ros.parameters import Settings
from valveflow_ros.records import IntArray, Readings, SampleTable
from valveflow_ros.signals.align import Aligned, Aligner

if TYPE_CHECKING:
    from valveflow_ros.monitoring.rows import Corrector

_BLOCK = 200_000  # readings between two reports of progress
Counts = dict[str, dict[str, int]]


def align(
    readings: Readings,
    settings: Settings,
    progress: Callable[[float, str], None] = SILENT,
    corrector: Corrector | None = None,
) -> tuple[SampleTable, IntArray, Counts]:
    """Return all rows, the rows before which the clock was set back, and the counts."""
    aligner = Aligner(settings)
    tables: list[SampleTable] = []
    resets: list[int] = []
    blocks = aligned_blocks(aligner, readings, progress, 'putting rows together')
    for aligned in corrected(blocks, corrector):
        resets += [sum(map(len, tables)) + int(k) for k in aligned.resets]
        tables.append(aligned.table)
    table = SampleTable.concatenate(tables)
    return table, np.array(resets, dtype=np.int64), aligner.counts()


def aligned_blocks(
    aligner: Aligner, readings: Readings, progress: Callable[[float, str], None], what: str
) -> Iterator[Aligned]:
    """Yield the rows block by block, with those that only the end closes."""
    for start in range(0, len(readings), _BLOCK):
        progress(0.1 + 0.4 * start / len(readings), what)
        yield aligner.feed(readings.part(start, min(start + _BLOCK, len(readings))))
    yield aligner.finish()


def corrected(blocks: Iterator[Aligned], corrector: Corrector | None) -> Iterator[Aligned]:
    """Yield blocks whose rows are freed of the causes of a corrector, if there is one."""
    if corrector is None:
        yield from blocks
        return
    for block in blocks:
        tables, start = [], 0
        for reset in block.resets.tolist():
            tables.append(corrector.correct(block.table.part(start, reset)))
            corrector.restart()
            start = reset
        tables.append(corrector.correct(block.table.part(start, len(block.table))))
        yield Aligned(SampleTable.concatenate(tables), block.resets)
