"""Who is better than whom, on which terms, and what becomes of the paper's finding."""

from __future__ import annotations

import enum
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from valveflow_ros.baselines.judged import Judgement, PairedTest, Trial, over_blocks
from valveflow_ros.records import FloatArray, SegmentKind

BASELINES = ('hammerstein', 'sparse')
_BLOCK_S = 1800.0
_LEVEL = 0.05


class Terms(enum.Enum):
    """What is held against what."""

    AS_PAPER = 'as the paper'
    STATIC = 'curve against curve, steady-state segments'
    DYNAMIC = 'simulation against simulation, special segments'
    ALL_ROWS = 'simulation against simulation, all rows'


class Outcome(enum.Enum):
    """Which of two has the smaller squared error."""

    BETTER = 'better'
    WORSE = 'worse'
    OPEN = 'not told apart'


class Finding(enum.Enum):
    """What becomes of the paper's finding."""

    CONFIRMED = 'confirmed'
    CONTRADICTED = 'contradicted'
    OPEN = 'open'


@dataclass(frozen=True, slots=True)
class Pair:
    """Two predictions held against each other.

    Attributes
    ----------
    terms : Terms
    ours, theirs : str
        Names of the predictions.
    mse_ours_mw2, mse_theirs_mw2 : float
    test : PairedTest
        Of the difference of squared errors, theirs less ours, over segments or blocks.
    failed : int
        Segments or blocks in which theirs is not finite; the test leaves them out.
    judged : int
        All segments or blocks, those among them.
    """

    terms: Terms
    ours: str
    theirs: str
    mse_ours_mw2: float
    mse_theirs_mw2: float
    test: PairedTest
    failed: int = 0
    judged: int = 0

    @property
    def baseline(self) -> str:
        """Return the method it is held against."""
        return self.theirs.partition('.')[0]

    @property
    def outcome(self) -> Outcome:
        """Return who is better at the 5 % level.

        Where the test tells nothing, theirs loses only if it mostly gives no answer: a few
        segments without one are no evidence about the others.
        """
        if not self.test.zero_is_rejected(_LEVEL):
            return Outcome.BETTER if 2 * self.failed > self.judged else Outcome.OPEN
        return Outcome.BETTER if self.test.mean > 0.0 else Outcome.WORSE


def _terms(ours: str, theirs: str, names: Iterable[str]) -> list[tuple[Terms, str, str]]:
    """Return which predictions meet, those that exist."""
    wanted = [
        (Terms.AS_PAPER, f'{ours}.static', f'{theirs}.dynamic'),
        (Terms.STATIC, 'proposed.static', f'{theirs}.static'),
        (Terms.DYNAMIC, 'proposed.dynamic', f'{theirs}.dynamic'),
    ]
    known = set(names)
    return [(t, a, b) for t, a, b in wanted if a in known and b in known]


def pairs_on_segments(
    judgement: Judgement, predictions: Mapping[str, FloatArray]
) -> tuple[Pair, ...]:
    """Hold the proposed method against both others on special segments.

    As the paper does it: the static curve of the special segments against the others'
    simulations. And on equal terms: simulation against simulation, and curve against curve
    where the power rests, since on a ramp it lags behind any curve.
    """
    paper = 'paper' if 'paper.static' in predictions else 'proposed'
    met = [m for name in BASELINES for m in _terms(paper, name, predictions)]
    found = []
    for terms, ours, theirs in met:
        kind = SegmentKind.STEADY if terms is Terms.STATIC else None
        if judgement.kinds(kind):
            found.append(
                Pair(
                    terms, ours, theirs, judgement.mse(ours, kind), judgement.mse(theirs, kind),
                    judgement.gain(ours, theirs, kind), judgement.failed(theirs, kind),
                    len(judgement.kinds(kind)),
                )
            )  # fmt: skip
    return tuple(found)


def everywhere(
    trial: Trial, predictions: Mapping[str, FloatArray]
) -> tuple[dict[str, float], tuple[Pair, ...]]:
    """Judge simulations on all rows; test over blocks of half an hour.

    Returns
    -------
    dict
        Mean squared error in MW^2 of each simulation.
    tuple of Pair
    """
    names = [n for n in predictions if n.endswith('.dynamic')]
    good = trial.good
    squares = {}
    for name in names:
        with np.errstate(over='ignore', invalid='ignore'):
            squares[name] = (trial.power_mw - predictions[name])[good] ** 2
    mse = {name: float(np.mean(s)) if len(s) else float('nan') for name, s in squares.items()}
    ours = 'proposed.dynamic'
    if ours not in squares:
        return mse, ()
    block = np.flatnonzero(good) // max(1, round(_BLOCK_S / trial.step_s))
    pairs = []
    for theirs in (f'{b}.dynamic' for b in BASELINES if f'{b}.dynamic' in squares):
        test, failed = _over_blocks(squares[theirs], squares[ours], block)
        blocks = len(np.unique(block))
        pairs.append(
            Pair(Terms.ALL_ROWS, ours, theirs, mse[ours], mse[theirs], test, failed, blocks)
        )
    return mse, tuple(pairs)


def _over_blocks(
    theirs: FloatArray, ours: FloatArray, block: np.ndarray
) -> tuple[PairedTest, int]:
    counts = np.bincount(block)
    with np.errstate(over='ignore', invalid='ignore'):
        sums = np.bincount(block, weights=theirs - ours)
    there = counts > 0
    sums, counts = sums[there], counts[there]
    finite = np.isfinite(sums)
    if not finite.any():
        return over_blocks(np.empty(0)), int((~finite).sum())
    return over_blocks(sums[finite] / counts[finite].mean()), int((~finite).sum())


def finding_of(pairs: Iterable[Pair]) -> Finding:
    """Return what becomes of the finding that the proposed curve beats both others.

    Judged as the paper does, on special segments of other data. One baseline that does
    better contradicts it; both must do worse to confirm it, so both must be there.
    """
    met = [(p.baseline, p.outcome) for p in pairs if p.terms is Terms.AS_PAPER]
    outcomes = {outcome for _, outcome in met}
    if Outcome.WORSE in outcomes:
        return Finding.CONTRADICTED
    both = {name for name, _ in met} == set(BASELINES)
    return Finding.CONFIRMED if both and outcomes == {Outcome.BETTER} else Finding.OPEN
