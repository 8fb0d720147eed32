# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a trial is told, what it brings, and how that is written down."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).resolve().parents[1] / 'results'
SHOWN = 20


@dataclass(frozen=True, slots=True)
class Options:
    """How much is tried, and from which random numbers.

    Attributes
    ----------
    scale : float
        1 is the full trial, 0.1 a tenth of it.
    seed : int
        Every random number of a trial follows from it.
    folder : Path
        Scratch, removed afterwards.
    minutes : float
        How long a trial goes on that has no end of its own.
    """

    scale: float
    seed: int
    folder: Path
    minutes: float = 1.0

    def many(self, count: int, least: int = 1) -> int:
        """Return a count of the full trial at this scale."""
        return max(least, round(count * self.scale))


@dataclass(slots=True)
class Outcome:
    """What a trial brought.

    Attributes
    ----------
    counts : dict
        What does not depend on the machine.
    measured : dict
        Times and memory, which do.
    failures : list of str
        Sentences, the first few of them; `failed` counts all.
    missed : list of str
        Times that were wished for and not kept. They depend on the machine, so no trial fails by
        them, but they are told.
    """

    counts: dict[str, Any] = field(default_factory=dict)
    measured: dict[str, Any] = field(default_factory=dict)
    failures: list[str] = field(default_factory=list)
    failed: int = 0
    missed: list[str] = field(default_factory=list)
    sentence: str = ''

    def expect(self, holds: bool, sentence: str) -> None:
        """Note a failure unless ``holds``."""
        if not holds:
            self.failed += 1
            if len(self.failures) < SHOWN:
                self.failures.append(sentence)

    def wish(self, holds: bool, sentence: str) -> None:
        """Note a time that was not kept unless ``holds``."""
        if not holds:
            self.missed.append(sentence)

    def count(self, name: str, by: int = 1) -> None:
        """Add to a count."""
        self.counts[name] = self.counts.get(name, 0) + by

    def worst(self, name: str, value: float) -> None:
        """Keep the largest of a measured number."""
        self.measured[name] = max(self.measured.get(name, value), value)


Trial = Callable[[Options], Outcome]


def write_result(name: str, outcome: Outcome, options: Options, seconds: float, to: Path) -> Path:
    """Write what a trial brought beside the other results; return where."""
    content = {
        'command': f'python -m benchmarks.torture --only {name} --scale {options.scale:g} '
        f'--seed {options.seed}'
        + (f' --minutes {options.minutes:g}' if options.minutes != 1 else ''),
        'trial': name,
        'scale': options.scale,
        'seed': options.seed,
        'passed': not outcome.failed,
        'failed': outcome.failed,
        'failures': outcome.failures,
        'missed': outcome.missed,
        'counts': outcome.counts,
        'measured': {**outcome.measured, 'seconds': round(seconds, 1)},
        'sentence': outcome.sentence,
    }
    path = to / f'torture_{name}.json'
    path.write_text(json.dumps(content, indent=1) + '\n', 'utf-8')
    return path
