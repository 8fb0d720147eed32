"""Samples in order of time with a known number of pieces, as the study of selection draws them."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks import selection_kinds as study

# The kinds that have a truth the samples can tell, and it.
KINDS = {
    kind: int(make(50, np.random.default_rng(0)).pieces)
    for kind, make in study.KINDS.items()
    if kind not in ('J=4 AR .99', 'square root', 'square')
}
SEEDS_FOR_TESTS = dict.fromkeys(KINDS, 11)


def draw(kind, n, seed, noise=1.0):
    """Return samples of a kind, with that many times its noise."""
    before = study.SD_MW
    study.SD_MW = noise * before
    try:
        return study.KINDS[kind](n, np.random.default_rng([seed, 4711]))
    finally:
        study.SD_MW = before
