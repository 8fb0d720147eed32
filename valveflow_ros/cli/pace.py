"""How long each part of a verb's work takes beside the others, so that a bar moves evenly.

Measured with ``benchmarks/pace.py`` on logs of one and three days. A machine twice as fast
is so in every part; it is the proportions that count.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple


class Part(NamedTuple):
    """A part of the work: the shares a verb tells within it, and the shares of the time."""

    told_from: float
    told_to: float
    from_: float
    to: float


@dataclass(frozen=True, slots=True)
class Pace:
    """Turns the shares that a verb tells into shares of its time.

    Attributes
    ----------
    parts : mapping of str to Part
        By how the sentences of the part begin; what is not in it stays as it is told.
    """

    parts: Mapping[str, Part] = field(default_factory=dict)

    def share(self, told: float, what: str) -> float:
        """Return the share of the time that has gone by when ``told`` of ``what`` is done."""
        part = next((p for name, p in self.parts.items() if what.startswith(name)), None)
        if part is None:
            return told
        width = part.told_to - part.told_from
        inside = min(max((told - part.told_from) / width, 0.0), 1.0) if width else 0.0
        return part.from_ + (part.to - part.from_) * inside


def pace_of(verb: str) -> Pace:
    """Return the pace of a verb; of one that is not known, the shares it tells."""
    return Pace(_PACES.get(verb, {}))


def _parts(*rows: tuple[str, float, float, float]) -> dict[str, Part]:
    """Return parts from rows of name, told shares, and where each begins in the time."""
    ends = [row[3] for row in rows[1:]] + [1.0]
    return {
        name: Part(told_from, told_to, begins, ends[k])
        for k, (name, told_from, told_to, begins) in enumerate(rows)
    }


_PACES: Mapping[str, Mapping[str, Part]] = {
    'identify': _parts(
        ('starting', 0.0, 0.0, 0.0),
        ('reading', 0.02, 0.02, 0.13),
        ('finding segments', 0.1, 0.5, 0.21),
        ('exact partition', 0.6, 0.6, 0.39),
        ('curve and dynamics together', 0.6, 0.6, 0.57),
        ('writing the report', 0.9, 0.9, 0.93),
    ),
    'diagnose': _parts(
        ('starting', 0.0, 0.0, 0.0),
        ('reading', 0.02, 0.02, 0.06),
        ('finding segments', 0.1, 0.5, 0.09),
        ('exact partition', 0.6, 0.6, 0.16),
        ('curve and dynamics together', 0.6, 0.6, 0.25),
        ('the record itself', 0.41, 0.41, 0.33),
        ('simulation fitted', 0.425, 0.425, 0.34),
        ('causes tried', 0.475, 0.475, 0.4),
        ('further causes tried', 0.475, 0.75, 0.4),
        ('the sealed blocks', 0.75, 0.75, 0.74),
        ('what is left', 0.8, 0.8, 0.75),
        ('how sure it is', 0.85, 0.85, 0.79),
        ('writing the report', 0.95, 0.95, 0.98),
    ),
    'validate': _parts(
        ('starting', 0.0, 0.0, 0.0),
        ('reading', 0.02, 0.02, 0.3),
        ('finding segments', 0.1, 0.5, 0.38),
        ('judging', 0.7, 0.7, 0.65),
        ('writing the report', 0.9, 0.9, 0.92),
    ),
    'compare': _parts(
        ('starting', 0.0, 0.0, 0.0),
        ('reading', 0.02, 0.02, 0.14),
        ('finding segments', 0.04, 0.4, 0.18),
        ('curve of special segments', 0.4, 0.4, 0.27),
        ('exact partition', 0.4, 0.4, 0.28),
        ('curve and dynamics together', 0.4, 0.4, 0.3),
        ('Hammerstein model: starts', 0.5, 0.5, 0.42),
        ('Hammerstein model: orders', 0.5, 0.5, 0.5),
        ('Hammerstein model: all data', 0.5, 0.5, 0.66),
        ('sparse model: derivative', 0.75, 0.75, 0.79),
        ('sparse model: weak', 0.75, 0.75, 0.84),
        ('sparse model: all data', 0.75, 0.75, 0.92),
        ('judging', 0.85, 0.85, 0.94),
        ('writing the report', 0.95, 0.95, 0.95),
    ),
}
