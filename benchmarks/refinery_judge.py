"""Whether a valve sticks, judged from its command and a process variable behind it.

Where no position is measured, the response (a flow, a level, a pressure) follows the plug
through a process that nobody knows, inside a closed loop. The response is predicted one row
ahead from its own past and the command's (a linear process with free poles and delay), and
again with the past of the plug beside them, which follows the command with stick band S and
slip jump J: the two-parameter stiction of He, Wang, Pottmann and Qin, Ind. Eng. Chem. Res. 46
(2007); J = 0 is backlash. To fit such a Hammerstein model over a grid of S and J is the method
of Jelali, J. Process Control 18 (2008).

Three things are ours. Only rows before the one predicted are used: within a row the command
already holds the response, because the controller has seen it. The linear part remembers far
back in means that grow longer with age, so that oscillations and loads that wander are
predicted without a plug: in a linear loop with Gaussian disturbances nothing predicts better
than a linear function of both pasts, whatever feedback made of them. And the gain must stay
without the stretch of the record that favours it most, and is cut down where the plug explains
less than the command it should replace.

It is a study and no part of the package: `valveflow diagnose` has the measured position and needs
no loop, and on measured loops Horch's test does better (`refinery_valves`).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from benchmarks.refinery_score import LEAST_REVERSALS, LoopScore
from valveflow_ros.errors import DataError
from valveflow_ros.records import FloatArray

_LEAST_ROWS, _LEAST_LEVELS = 110, 6
_LEAST_STEP_S = 5.0
_MOST_AT_STOP, _STOP_RUN = 0.03, 4
_BANDS = np.geomspace(0.04, 1.0, 24)  # shares of the command's span
_JUMPS = (0.0, 0.3, 0.6, 0.8, 1.0)  # shares of the band
_STARTS = (-0.8, 0.0, 0.8)  # shares of the pull at which the plug slips
_FINER = (0.06, 0.02)
# The sizes of a valve that is named are searched for more closely.
_PULLS = np.geomspace(0.025, 1.0, 120)  # shares of the span at which the plug slips
_BEHIND = (0.0, 0.2, 0.4, 0.65)  # shares of the pull that it stays behind
_CLOSE_PULLS, _CLOSE_BEHIND = np.linspace(0.98, 1.02, 7), np.linspace(-0.15, 0.15, 7)
_TRIED_FURTHER = 6
_FINEST = (0.01, 0.003)
_LEAST_JUMP = 0.1  # share of the band

LEAST_GAIN = 15.0
"""Log-likelihood asked for. Fixed on simulated loops, `refinery_valves`."""
LEAST_JUMP_GAIN = 4.0
"""By how much a jump must improve on none before backlash is called stiction. Fixed there."""


@dataclass(frozen=True, slots=True)
class LoopVerdict:
    """What command and response say of the valve.

    Attributes
    ----------
    name : str
        'stiction' or 'backlash' as in the catalogue, or empty.
    s_percent, j_percent : float
        Stick band and slip jump of the best plug in % of command; NaN if nothing was tried.
    gain : float
        Log-likelihood gained; `LEAST_GAIN` is asked for. NaN if nothing was tried.
    hindered : str
        Why the valve cannot be judged, or empty.
    sentence : str
        All this for an operator.
    """

    name: str
    s_percent: float
    j_percent: float
    gain: float
    hindered: str
    sentence: str


@dataclass(frozen=True, slots=True)
class _Plug:
    """A plug that was tried, sizes as shares of the command's span."""

    score: float
    band: float
    jump: float
    start: float


def judge_loop(command: FloatArray, response: FloatArray, step_s: float) -> LoopVerdict:
    """Say whether friction or slack lies between a command and what follows it in a loop.

    Parameters
    ----------
    command : float64 (n,)
        Controller output in %; NaN where it is missing. The longest stretch without a missing
        row is judged.
    response : float64 (n,)
        The process variable, in any unit, in the same rows.
    step_s : float
        Time between rows in s. Rows closer than 5 s are averaged after the plug has moved.

    Notes
    -----
    The jump is known less well than the band: what happens between rows is not seen, and the
    top of a command's swing is missed, so that many sticking valves are called slack.

    Raises
    ------
    DataError
        The series differ in length or are not one-dimensional, or the step is not positive.
    """
    c, y = (np.asarray(a, dtype=np.float64) for a in (command, response))
    if c.ndim != 1 or c.shape != y.shape:
        raise DataError(
            f'Command and response must be series of one length; they have {c.shape} and '
            f'{y.shape} rows.'
        )
    if not 0.0 < step_s < np.inf:
        raise DataError(f'The time between rows must be positive; it is {step_s} s.')
    rows = _longest(np.isfinite(c) & np.isfinite(y))
    group = max(1, round(_LEAST_STEP_S / step_s))
    why = _hindered(c[rows], y[rows], group)
    if why:
        return LoopVerdict('', np.nan, np.nan, np.nan, why, f'The valve cannot be judged: {why}.')
    return _concluded(LoopScore(c[rows], y[rows], group))


def _longest(good: np.ndarray) -> slice:
    """Return the longest run of rows that are all good."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], good.astype(np.int8), [0]))))
    if not len(edges):
        return slice(0, 0)
    k = int(np.argmax(edges[1::2] - edges[::2]))
    return slice(int(edges[2 * k]), int(edges[2 * k + 1]))


def _hindered(c: FloatArray, y: FloatArray, group: int) -> str:
    if len(c) < _LEAST_ROWS * group:
        return (
            f'there are {len(c)} rows with command and response in one piece, '
            f'{_LEAST_ROWS * group} are needed'
        )
    for series, name in ((c, 'command'), (y, 'response')):
        levels = len(np.unique(series))
        if levels < _LEAST_LEVELS:
            return f'the {name} hardly moves, it has {levels} different values'
    share = max(_at_stop(c, float(c.min())), _at_stop(c, float(c.max())))
    if share > _MOST_AT_STOP:
        return f'the command rests at its end {100 * share:.0f} % of the time'
    return ''


def _at_stop(c: FloatArray, end: float) -> float:
    """Return the share of rows in long rests at an end; a rounded command rests anywhere."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], (c == end).astype(np.int8), [0]))))
    runs = edges[1::2] - edges[::2]
    coarse = len(np.unique(c)) < len(c) // 10
    return 0.0 if coarse else float(runs[runs >= _STOP_RUN].sum()) / len(c)


def _grid(jumps: tuple[float, ...]) -> Iterator[tuple[float, float, float]]:
    return itertools.product(_BANDS.tolist(), jumps, _STARTS)


def _best(loop: LoopScore, jumps: tuple[float, ...]) -> _Plug:
    """Return the best plug of the grid, moved on in steps that shrink."""
    best = max(
        (_Plug(loop.score(b, j * b, s), b, j * b, s) for b, j, s in _grid(jumps)),
        key=lambda p: p.score,
    )
    return _moved(loop, best, any(jumps), _FINER)


def _moved(loop: LoopScore, best: _Plug, jumping: bool, steps: tuple[float, ...]) -> _Plug:
    """Move a plug uphill."""
    for step in steps:
        better = True
        while better:
            better = False
            for plug in _beside(best, step, jumping):
                score = loop.score(*plug)
                if score > best.score + 1e-6:
                    best, better = _Plug(score, *plug), True
    return best


def _beside(p: _Plug, step: float, jumping: bool) -> list[tuple[float, float, float]]:
    """Return plugs a step of the band away, J kept within 0 and S."""
    d = step * p.band
    bands = [p.band - d, p.band + d]
    jumps = [p.jump - d, p.jump + d] if jumping else []
    return [(b, min(p.jump, b), p.start) for b in bands if b <= 1.0] + [
        (p.band, min(max(j, 0.0), p.band), p.start) for j in jumps
    ]


def _of_pull(loop: LoopScore, pull: float, behind: float, start: float) -> _Plug:
    """Score a plug that slips at a pull (S + J)/2 and stays a share of it, (S - J)/2, behind."""
    band, jump = pull * (1.0 + behind), pull * (1.0 - behind)
    return _Plug(loop.score(band, jump, start), band, jump, start)


def _sharper(loop: LoopScore, best: _Plug) -> _Plug:
    """Search again for a jumping plug.

    A slip in a wrong row spoils the prediction whatever else is right, and when it comes
    depends on the pull alone: the truth is a needle that a coarse grid passes by.
    """
    grid = itertools.product(_PULLS.tolist(), _BEHIND, (best.start,))
    ranked = sorted((_of_pull(loop, *g) for g in grid), key=lambda p: -p.score)
    for p in ranked[:_TRIED_FURTHER]:
        pull, behind = 0.5 * (p.band + p.jump), (p.band - p.jump) / (p.band + p.jump)
        for up, more in itertools.product(_CLOSE_PULLS.tolist(), _CLOSE_BEHIND.tolist()):
            close = _of_pull(loop, pull * up, min(max(behind + more, 0.0), 1.0), p.start)
            best = max(best, close, key=lambda q: q.score)
    return _moved(loop, best, True, _FINEST)


def _concluded(loop: LoopScore) -> LoopVerdict:
    slack, friction = _best(loop, _JUMPS[:1]), _best(loop, _JUMPS[1:])
    best = max(slack, friction, key=lambda p: p.score)
    gain, asked = (
        best.score,
        f'gain in log-likelihood {best.score:.1f}, {LEAST_GAIN:.0f} asked for',
    )
    if gain < LEAST_GAIN:
        return LoopVerdict(
            '', best.band * loop.span, best.jump * loop.span, gain, '',
            f'No friction or slack shows: none predicts the response better than the command does '
            f'({asked}). One at which the valve turns round fewer than {LEAST_REVERSALS} times in '
            'the record would not show.',
        )  # fmt: skip
    slack, friction = _moved(loop, slack, False, _FINEST), _sharper(loop, friction)
    jumps = friction.score - slack.score >= LEAST_JUMP_GAIN
    jumps = jumps and friction.jump >= _LEAST_JUMP * friction.band
    best = friction if jumps else slack
    s, j = best.band * loop.span, best.jump * loop.span
    words = (
        f'The valve sticks and slips: stick band {s:.2g} %, slip jump {j:.2g} %'
        if jumps
        else f'The valve moves with slack: {s:.2g} %'
    )
    name = 'stiction' if jumps else 'backlash'
    return LoopVerdict(name, s, j, gain, '', f'{words} of the command ({asked}).')
