"""What the report of a comparison is made from."""

from __future__ import annotations

from dataclasses import dataclass

from valveflow_ros.baselines.comparison import Comparison
from valveflow_ros.segments.window import WindowContents

# In the order in which they are told; the names of the numbers, and those for people.
METHODS = ('paper', 'proposed', 'hammerstein', 'sparse')
LABELS = {
    'paper': "the paper's curve of special segments",
    'proposed': 'valveflow',
    'hammerstein': 'Hammerstein',
    'sparse': 'sparse (SINDy)',
}
# In a legend there is little room.
LEGEND = {**LABELS, 'paper': "the paper's curve"}
PREDICTIONS = {
    'paper.static': "the paper's curve",
    'proposed.static': 'valveflow, curve',
    'hammerstein.static': 'Hammerstein, curve',
    'sparse.static': 'sparse, curve',
    'proposed.dynamic': 'valveflow, simulated',
    'hammerstein.dynamic': 'Hammerstein, simulated',
    'sparse.dynamic': 'sparse, simulated',
}


@dataclass(frozen=True, slots=True)
class Compared:
    """A comparison and the data it came from.

    Attributes
    ----------
    source, other : str
        Names of the logs: learnt from, and judged on.
    held_out : bool
        Both are the same log, cut in two.
    result : Comparison
    learnt, judged : WindowContents
    notes : tuple of str
        Sentences about how the data were read.
    """

    source: str
    other: str
    held_out: bool
    result: Comparison
    learnt: WindowContents
    judged: WindowContents
    notes: tuple[str, ...] = ()

    @property
    def predictions(self) -> tuple[str, ...]:
        """Return the names of the predictions that there are, in the order of the tables."""
        return tuple(name for name in PREDICTIONS if name in self.result.predictions)
