# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The gain of a model with a sticking or slack plug in predicting a response.

The response is predicted one row ahead from its own past and that of the command (a linear process
with free poles and delay), and from the past of a plug that follows the command with stick band S
and slip jump J: the two-parameter stiction model of He, Wang, Pottmann and Qin, Ind. Eng. Chem.
Res. 46 (2007); J = 0 is backlash. Fitting such a Hammerstein model over a grid of S and J is the
method of Jelali, J. Process Control 18 (2008).

Differences from these papers: only earlier rows are used, because within a row the command already
depends on the response; the linear part uses means that grow longer with age, so that it predicts
oscillations and slow load changes without a plug; the gain is computed without the part of
the record that contributes most to it.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from valveflow_ros.diagnosis.kernels import stick_slip
from valveflow_ros.records import FloatArray

Spans = tuple[tuple[int, int], ...]
# Each regressor is the mean over these rows, counted back from the predicted one.
OWN: Spans = (
    (1, 1), (2, 2), (3, 3), (4, 4), (5, 6), (7, 8), (9, 12), (13, 16), (17, 24), (25, 32),
)  # fmt: skip
COMMAND: Spans = ((1, 1), (2, 2), (3, 4), (5, 8), (9, 16), (17, 32))
PLUG: Spans = COMMAND[:-1]
MEMORY = 32
_BLOCKS = 12
_GAIN_REVERSALS, _TRAVEL_REVERSALS = 3, 1
_TRAVEL_BAND = 0.2  # a plug with a smaller band is nearly equal to the command
_SHORTFALL = 0.2  # weight of the penalty for a plug that explains less than the command
_BANDS = np.geomspace(0.04, 1.0, 24)  # fractions of the span of the command
_JUMPS = (0.0, 0.3, 0.6, 0.8, 1.0)  # fractions of the band
_STARTS = (-0.8, 0.0, 0.8)  # fractions of the distance at which the plug slips
_STEPS = (0.06, 0.02)
CLEAR_JUMP_GAIN = 4.0
"""Log-likelihood by which sticking or slack must fit better than the other to be called better."""
_TINY = 1e-12


@dataclass(frozen=True, slots=True)
class Tried:
    """A plug model that was tried; band and jump are fractions of the span of the command.

    Attributes
    ----------
    gain : float
        Gain in log-likelihood over the model with the command only; 0 if the plug reverses
        fewer than three times, because a single event could look the same.
    travel : float
        Log-likelihood with the past of the plug minus that with the past of the command, each
        with the past of the response: positive if the response rests while the command moves.
        -inf for a plug that never reverses or is nearly equal to the command.
    """

    gain: float
    travel: float
    band: float
    jump: float
    start: float


@dataclass(frozen=True, slots=True)
class Evidence:
    """The results of the best plug models.

    Attributes
    ----------
    gain, travel : float
        The largest ones, as in `Tried`.
    of_command : float
        Gain in log-likelihood from the past of the command.
    band, jump : float
        Parameters of the selected plug, in the unit of the command.
    jump_gain : float
        Log-likelihood of the best plug with a jump minus that of the best one without.
    """

    gain: float
    travel: float
    of_command: float
    band: float
    jump: float
    jump_gain: float


def past(series: FloatArray, spans: Spans) -> FloatArray:
    """Return means over past rows as columns, for every row with a complete past."""
    n = len(series)
    sums = np.concatenate(([0.0], np.cumsum(series)))
    out = np.empty((n - MEMORY, len(spans)), order='F')
    for k, (a, b) in enumerate(spans):
        np.subtract(sums[MEMORY - a + 1 : n - a + 1], sums[MEMORY - b : n - b], out=out[:, k])
        out[:, k] /= b - a + 1
    return out


class PlugScore:
    """A loop scaled by the span of the command, and its prediction without a plug.

    Parameters
    ----------
    command, response : float64 (n,)
        Without missing rows; both vary.
    group : int
        Number of rows averaged to one, after the plug.

    Attributes
    ----------
    span : float
        Maximum minus minimum of the command.
    of_command : float
        As in `Evidence`.
    """

    def __init__(self, command: FloatArray, response: FloatArray, group: int = 1) -> None:
        self.span = float(np.ptp(command))
        self._command = (command - command.mean()) / self.span
        self._group = group
        y = self._means(response - response.mean())
        y /= max(float(y.std()), _TINY)
        own = np.column_stack([np.ones(len(y) - MEMORY), past(y, OWN)])
        table = np.column_stack([own, past(self._means(self._command), COMMAND)])
        table /= np.maximum(np.linalg.norm(table, axis=0), _TINY)
        self._basis, r = np.linalg.qr(table)
        self._basis[:, np.abs(np.diag(r)) < 1e-6] = 0.0
        self._target = y[MEMORY:]
        self._answers = self._basis.T @ self._target
        self._own = own.shape[1]
        self._rest = self._target - self._basis @ self._answers
        alone = self._target - self._basis[:, : self._own] @ self._answers[: self._own]
        self._alone = max(float(alone @ alone), _TINY)
        ratio = self._alone / max(float(self._rest @ self._rest), _TINY)
        self.of_command = 0.5 * len(y) * float(np.log(ratio))
        self._edges = np.linspace(0, len(self._rest), _BLOCKS + 1).astype(int)[:-1]
        self._before = np.add.reduceat(self._rest**2, self._edges)

    def _means(self, series: FloatArray) -> FloatArray:
        n = len(series) // self._group
        return np.asarray(series[: n * self._group].reshape(n, self._group).mean(axis=1))

    def plug(self, band: float, jump: float, start: float) -> FloatArray:
        """Return the path of a plug that starts at ``start`` times its slip distance."""
        away = 0.5 * start * (band + jump)
        path = np.empty(len(self._command) + 1)
        stick_slip(np.concatenate(([self._command[0] + away], self._command)), band, jump, path)
        return path[1:]

    def tried(self, band: float, jump: float, start: float) -> Tried:
        """Return the gain of a plug model."""
        path = self.plug(band, jump, start)
        moves = np.sign(np.diff(path))
        reversals = np.count_nonzero(np.diff(moves[moves != 0.0]))
        if reversals < _TRAVEL_REVERSALS:
            return Tried(0.0, -np.inf, band, jump, start)
        x = past(self._means(path), PLUG)
        x -= x.mean(axis=0)
        shadow, gram, pull = self._basis.T @ x, x.T @ x, x.T @ self._target
        gram.flat[:: len(gram) + 1] *= 1.0 + 1e-6
        gram.flat[:: len(gram) + 1] += _TINY
        k, n = self._own, len(self._rest)
        direct = pull - shadow[:k].T @ self._answers[:k]
        told = float(direct @ np.linalg.solve(gram - shadow[:k].T @ shadow[:k], direct))
        travel = -0.5 * n * float(np.log(max(1.0 - told / self._alone, _TINY))) - self.of_command
        gain = 0.0
        if reversals >= _GAIN_REVERSALS:
            extra = pull - shadow.T @ self._answers
            weights = np.linalg.solve(gram - shadow.T @ shadow, extra)
            after = self._rest - (x - self._basis @ shadow) @ weights
            gain = self._kept(after) + _SHORTFALL * min(0.0, travel)
        return Tried(gain, travel if band >= _TRAVEL_BAND else -np.inf, band, jump, start)

    def _kept(self, after: FloatArray) -> float:
        """Return the log-likelihood gain without the part of the record that gains most."""
        squares = np.add.reduceat(after**2, self._edges)
        kept = np.argsort(self._before - squares)[:-1]
        ratio = max(float(self._before[kept].sum()), _TINY) / max(
            float(squares[kept].sum()), _TINY
        )
        return float(0.5 * len(after) * (_BLOCKS - 1) / _BLOCKS * np.log(ratio))


def evidence(command: FloatArray, response: FloatArray, group: int) -> Evidence:
    """Return the best gain of plug models with any band and jump.

    Parameters
    ----------
    command, response : float64 (n,)
        Without missing rows, in any unit and direction of action; both vary.
    group : int
        Number of rows averaged to one, after the plug.

    Notes
    -----
    Sizes from command and response alone are inaccurate: moves between rows and the extremes of
    the command are not sampled, so that stiction is often classified as backlash.
    """
    loop = PlugScore(command, response, group)
    grid = [
        loop.tried(b, j * b, s) for b, j, s in itertools.product(_BANDS.tolist(), _JUMPS, _STARTS)
    ]
    slack = _moved(loop, max((p for p in grid if not p.jump), key=lambda p: p.gain))
    friction = _moved(loop, max((p for p in grid if p.jump), key=lambda p: p.gain))
    gain, travel = max(slack.gain, friction.gain), max(p.travel for p in grid)
    jump_gain = friction.gain - slack.gain
    if travel > gain:
        slack, friction = (
            max((p for p in grid if bool(p.jump) == j), key=lambda p: p.travel)
            for j in (False, True)
        )
        jump_gain = friction.travel - slack.travel
    best = friction if jump_gain > 0.0 else slack
    return Evidence(
        gain, travel, loop.of_command, best.band * loop.span, best.jump * loop.span, jump_gain
    )


def _moved(loop: PlugScore, best: Tried) -> Tried:
    """Increase the gain of a plug model by a search with decreasing steps."""
    for step in _STEPS:
        better = True
        while better:
            better = False
            for plug in _beside(best, step):
                tried = loop.tried(*plug)
                if tried.gain > best.gain + 1e-6:
                    best, better = tried, True
    return best


def _beside(p: Tried, step: float) -> list[tuple[float, float, float]]:
    """Return plugs at a distance of ``step`` times the band, with J between 0 and S."""
    d = step * p.band
    bands = [b for b in (p.band - d, p.band + d) if b <= 1.0]
    jumps = [p.jump - d, p.jump + d] if p.jump else []
    return [(b, min(p.jump, b), p.start) for b in bands] + [
        (p.band, min(max(j, 0.01 * p.band), p.band), p.start) for j in jumps
    ]
