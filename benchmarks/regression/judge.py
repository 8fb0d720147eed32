# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Says from pairs of times whether something has become slower."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median

# Slower than so many times the base is a failure.
LIMIT = 1.25
LEAST_PAIRS = 7


@dataclass(frozen=True)
class Verdict:
    """What was found of one piece of work.

    Attributes
    ----------
    name : str
    base_s, here_s : float
        Medians of the processor's time.
    ratio : float
        Median of the pairs' ratios, new by old; a pair ran one straight after the other, so that
        both met about the same neighbours on the machine.
    low, high : float
        Quarters of the pairs lie below and above.
    slower : bool
        The ratio is above the limit.
    """

    name: str
    base_s: float
    here_s: float
    ratio: float
    low: float
    high: float
    slower: bool


def judge(
    pairs: Mapping[str, Sequence[tuple[float, float]]], limit: float = LIMIT
) -> list[Verdict]:
    """Judge every piece of work by its pairs of times, of the base and of this tree.

    Raises
    ------
    ValueError
        If one has fewer pairs than `LEAST_PAIRS`, or a time that is none.
    """
    found = []
    for name, times in pairs.items():
        if len(times) < LEAST_PAIRS:
            raise ValueError(f'{name}: {len(times)} pairs, {LEAST_PAIRS} are wanted at least')
        if not all(0.0 < seconds < float('inf') for pair in times for seconds in pair):
            raise ValueError(f'{name}: a time that is none')
        ratios = sorted(here / base for base, here in times)
        ratio = median(ratios)
        found.append(
            Verdict(
                name,
                median(base for base, _ in times),
                median(here for _, here in times),
                ratio,
                ratios[len(ratios) // 4],
                ratios[-1 - len(ratios) // 4],
                ratio > limit,
            )
        )
    return found


def table(verdicts: Sequence[Verdict]) -> str:
    """Return the verdicts as lines to read."""
    lines = [f'{"work":10} {"base":>8} {"here":>8} {"here/base":>10}   half of the pairs']
    for v in verdicts:
        lines.append(
            f'{v.name:10} {v.base_s:7.3f}s {v.here_s:7.3f}s {v.ratio:10.3f}   '
            f'{v.low:.3f} to {v.high:.3f}{"   SLOWER" if v.slower else ""}'
        )
    return '\n'.join(lines)
