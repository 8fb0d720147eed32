"""From readings to rows, with a progress bar on the way."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from valveflow_ros.monitoring.rows import Corrector
from valveflow_ros.parameters import Settings
from valveflow_ros.records import IntArray, Readings, SampleTable
from valveflow_ros.signals.align import Aligned, Aligner

Progress = Callable[[float, str], None]
_BLOCK = 200_000  # readings between two looks at the progress bar


def quiet(_share: float, _what: str) -> None:
    """Show no progress."""


def align(
    readings: Readings,
    settings: Settings,
    progress: Progress = quiet,
    corrector: Corrector | None = None,
) -> tuple[SampleTable, IntArray, dict[str, dict[str, int]]]:
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
    aligner: Aligner, readings: Readings, progress: Progress, what: str
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
