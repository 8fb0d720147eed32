"""How much better a plug predicts a response than the command does; see `refinery_judge`."""

from __future__ import annotations

import numpy as np

from valveflow_ros.diagnosis.kernels import stick_slip
from valveflow_ros.records import FloatArray

Spans = tuple[tuple[int, int], ...]
# Rows before the one predicted, first to last, whose mean is one regressor.
OWN: Spans = (
    (1, 1), (2, 2), (3, 3), (4, 4), (5, 6), (7, 8), (9, 12), (13, 16), (17, 24), (25, 32),
)  # fmt: skip
COMMAND: Spans = ((1, 1), (2, 2), (3, 4), (5, 8), (9, 16), (17, 32))
PLUG: Spans = COMMAND[:-1]
MEMORY = 32
_BLOCKS = 12
LEAST_REVERSALS = 3
"""A plug that turns round less often could be any single event."""
_SHORTFALL = 0.2  # what counts against a plug that explains less than the command
_TINY = 1e-12


def past(series: FloatArray, spans: Spans) -> FloatArray:
    """Return means over past rows as columns, for every row that has all of its past."""
    n = len(series)
    sums = np.concatenate(([0.0], np.cumsum(series)))
    out = np.empty((n - MEMORY, len(spans)), order='F')
    for k, (a, b) in enumerate(spans):
        np.subtract(sums[MEMORY - a + 1 : n - a + 1], sums[MEMORY - b : n - b], out=out[:, k])
        out[:, k] /= b - a + 1
    return out


class LoopScore:
    """A loop in shares of the command's span, and how well it is predicted without a plug.

    Parameters
    ----------
    command, response : float64 (n,)
        Without missing rows.
    group : int
        Rows averaged to one, behind the plug.

    Attributes
    ----------
    span : float
        Highest minus lowest command, in %.
    """

    def __init__(self, command: FloatArray, response: FloatArray, group: int) -> None:
        self.span = float(np.ptp(command))
        self.command = (command - command.mean()) / self.span
        self.group = group
        y = self._means(response - response.mean())
        y /= max(float(y.std()), _TINY)
        own = np.column_stack([np.ones(len(y) - MEMORY), past(y, OWN)])
        table = np.column_stack([own, past(self._means(self.command), COMMAND)])
        table /= np.maximum(np.linalg.norm(table, axis=0), _TINY)
        self.basis, r = np.linalg.qr(table)
        self.basis[:, np.abs(np.diag(r)) < 1e-6] = 0.0
        self.target = y[MEMORY:]
        self.answers = self.basis.T @ self.target
        self.own = own.shape[1]
        self.rest = self.target - self.basis @ self.answers
        alone = self.target - self.basis[:, : self.own] @ self.answers[: self.own]
        self.squares = (float(alone @ alone), float(self.rest @ self.rest))
        self.of_command = 0.5 * len(y) * np.log(self.squares[0] / max(self.squares[1], _TINY))
        self.edges = np.linspace(0, len(self.rest), _BLOCKS + 1).astype(int)[:-1]
        self.before = np.add.reduceat(self.rest**2, self.edges)

    def _means(self, series: FloatArray) -> FloatArray:
        n = len(series) // self.group
        return np.asarray(series[: n * self.group].reshape(n, self.group).mean(axis=1))

    def plug(self, band: float, jump: float, start: float) -> FloatArray:
        """Return where a plug goes that begins ``start`` of its slip-off pull away."""
        away = 0.5 * start * (band + jump)
        path = np.empty(len(self.command) + 1)
        stick_slip(np.concatenate(([self.command[0] + away], self.command)), band, jump, path)
        return path[1:]

    def score(self, band: float, jump: float, start: float) -> float:
        """Return the log-likelihood a plug gains, as the head of this file says.

        A plug that turns round too rarely gains nothing: it could be any single event.
        """
        path = self.plug(band, jump, start)
        moves = np.sign(np.diff(path))
        moves = moves[moves != 0.0]
        if np.count_nonzero(np.diff(moves)) < LEAST_REVERSALS:
            return 0.0
        x = past(self._means(path), PLUG)
        x -= x.mean(axis=0)
        shadow, gram, pull = self.basis.T @ x, x.T @ x, x.T @ self.target
        gram.flat[:: len(gram) + 1] *= 1.0 + 1e-6
        gram.flat[:: len(gram) + 1] += _TINY
        k, n = self.own, len(self.rest)
        direct = pull - shadow[:k].T @ self.answers[:k]
        explained = float(direct @ np.linalg.solve(gram - shadow[:k].T @ shadow[:k], direct))
        alone = -0.5 * n * np.log(max(1.0 - explained / self.squares[0], _TINY))
        extra = pull - shadow.T @ self.answers
        weights = np.linalg.solve(gram - shadow.T @ shadow, extra)
        after = self.rest - (x - self.basis @ shadow) @ weights
        after = np.add.reduceat(after**2, self.edges)
        kept = np.argsort(self.before - after)[:-1]
        share = (_BLOCKS - 1) / _BLOCKS
        ratio = max(float(self.before[kept].sum()), _TINY) / max(float(after[kept].sum()), _TINY)
        return float(
            0.5 * n * share * np.log(ratio) + _SHORTFALL * min(0.0, alone - self.of_command)
        )
