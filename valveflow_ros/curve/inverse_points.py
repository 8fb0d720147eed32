"""Which points of a rising broken line a short table keeps, and what that costs."""

from __future__ import annotations

import numpy as np

from valveflow_ros.records import FloatArray


def spread(x: FloatArray, y: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Put further points on a broken line until it has ``count``; every corner stays one.

    The widest interval of x is divided first. Intervals without width are not divided.

    Parameters
    ----------
    x, y : float64 (n,)
        Corners; x does not fall.
    """
    width = np.diff(x)
    parts = np.ones(len(width), dtype=np.int64)
    for _ in range(max(0, count - len(x))):
        k = int(np.argmax(width / parts))
        if width[k] <= 0.0:
            break
        parts[k] += 1
    at = [
        np.linspace(x[k], x[k + 1], parts[k], endpoint=False) for k in range(len(width))
    ]  # fmt: skip
    new_x = np.concatenate([*at, x[-1:]])
    share = [np.arange(n) / n for n in parts.tolist()]
    new_y = np.concatenate(
        [y[k] + (y[k + 1] - y[k]) * share[k] for k in range(len(width))] + [y[-1:]]
    )
    return new_x, new_y


def thin(x: FloatArray, y: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Keep ``count`` corners, both ends among them, so that the largest error in x is least.

    The error in x is what the line through the kept corners gives too much or too little at
    the y of a corner that was left out. Exact: all choices are compared (dynamic programme).
    """
    n = len(x)
    cost = np.full((n, n), np.inf)
    for a in range(n):
        for b in range(a + 1, n):
            cost[a, b] = _error(x, y, a, b)
    best = np.full((count, n), np.inf)
    came = np.zeros((count, n), dtype=np.int64)
    best[0, 0] = 0.0
    for used in range(1, count):
        for b in range(1, n):
            worst = np.maximum(best[used - 1, :b], cost[:b, b])
            came[used, b] = int(np.argmin(worst))
            best[used, b] = worst[came[used, b]]
    used, b = int(np.argmin(best[:, n - 1])), n - 1
    kept = [b]
    while used > 0:
        b = int(came[used, b])
        kept.append(b)
        used -= 1
    index = np.array(kept[::-1])
    return x[index], y[index]


def _error(x: FloatArray, y: FloatArray, a: int, b: int) -> float:
    """Return the largest error in x at the corners between two that are kept."""
    if b == a + 1:
        return 0.0
    if y[b] == y[a]:
        return float(np.inf)
    line = x[a] + (x[b] - x[a]) * (y[a + 1 : b] - y[a]) / (y[b] - y[a])
    return float(np.max(np.abs(line - x[a + 1 : b])))
