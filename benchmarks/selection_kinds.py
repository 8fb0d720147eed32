"""Samples with a known number of pieces, as a unit would write them: in order of time.

The unit dwells at one load, drifts a little about it, and goes to the next: forty
dwells of the same length, spread over the range of u and visited in random order.
Where the noise is independent the order does not matter; where it is not, a dwell
shares its error, and a rule that counts samples counts too many.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Random = np.random.Generator

LOW, HIGH = 1000.0, 2400.0
SD_MW = 3.0
_DWELLS = 40


class Sampled(NamedTuple):
    """u and y in order of time, and the true number of pieces (0: a smooth curve)."""

    u: Array
    y: Array
    pieces: int


def broken_line(knots: list[float], slopes: list[float], start_mw: float = 140.0) -> Curve:
    """Return the continuous curve with inner ``knots`` and ``slopes``."""
    corners = np.array([LOW, *knots])
    values = start_mw + np.concatenate(
        [[0.0], np.cumsum(np.array(slopes[:-1]) * np.diff(corners))]
    )

    def curve(u: Array) -> Array:
        k = np.searchsorted(np.array(knots), u, side='right')
        return np.asarray(values[k] + np.array(slopes)[k] * (u - corners[k]))

    return curve


Curve = Callable[[Array], Array]

STRAIGHT = broken_line([], [0.12])
TWO = broken_line([1700.0], [0.20, 0.06])
THREE = broken_line([1450.0, 1930.0], [0.22, 0.12, 0.03])
FOUR = broken_line([1250.0, 1600.0, 1900.0], [0.24, 0.18, 0.09, 0.01])
SIX = broken_line([1230.0, 1460.0, 1700.0, 1930.0, 2170.0], [0.26, 0.14, 0.24, 0.10, 0.20, 0.02])
WEAK = broken_line([1350.0, 1700.0, 2050.0], [0.20, 0.17, 0.13, 0.11])


def openings(n: int, r: Random) -> Array:
    """Return u in order of time, dwell by dwell, in steps of 0.1."""
    step = (HIGH - LOW) / _DWELLS
    levels = LOW + step * (r.permutation(_DWELLS) + r.uniform(0.0, 1.0, _DWELLS))
    dwell = np.minimum(np.arange(n) * _DWELLS // n, _DWELLS - 1)
    u = levels[dwell] + r.uniform(-0.75 * step, 0.75 * step, n)
    return np.round(np.clip(u, LOW, HIGH), 1)


def autoregressive(n: int, r: Random, root: float) -> Array:
    """Return a stationary AR(1) of variance 1."""
    drive = r.normal(size=n)
    out = np.empty(n)
    out[0] = drive[0]
    gain = np.sqrt(1.0 - root * root)
    for t in range(1, n):
        out[t] = root * out[t - 1] + gain * drive[t]
    return out


def _kind(
    curve: Curve, pieces: int, noise: Callable[[Array, Random], Array]
) -> Callable[[int, Random], Sampled]:
    def make(n: int, r: Random) -> Sampled:
        u = openings(n, r)
        return Sampled(u, curve(u) + SD_MW * noise(u, r), pieces)

    return make


def _independent(u: Array, r: Random) -> Array:
    return r.normal(size=len(u))


def _correlated(root: float) -> Callable[[Array, Random], Array]:
    return lambda u, r: autoregressive(len(u), r, root)


def _uneven(u: Array, r: Random) -> Array:
    """Noise that grows threefold along u."""
    return np.asarray((0.5 + (u - LOW) / (HIGH - LOW)) * r.normal(size=len(u)))


def _heavy(u: Array, r: Random) -> Array:
    return r.standard_t(3, len(u))


def _sweep(n: int, r: Random) -> Sampled:
    """One slow ramp through the whole range, so that neighbours in time are neighbours in u."""
    u = np.sort(np.round(r.uniform(LOW, HIGH, n), 1))
    return Sampled(u, FOUR(u) + SD_MW * autoregressive(n, r, 0.9), 4)


def _jumps(n: int, r: Random) -> Sampled:
    """Three pieces that do not join."""
    u = openings(n, r)
    return Sampled(
        u, THREE(u) + 6.0 * (u > 1450.0) - 5.0 * (u > 1930.0) + SD_MW * _independent(u, r), 3
    )


def _share(u: Array) -> Array:
    return np.asarray((u - LOW) / (HIGH - LOW))


# The ten kinds that the rule is judged on, the smooth ones, and three harder ones.
KINDS: dict[str, Callable[[int, Random], Sampled]] = {
    'J=1 independent': _kind(STRAIGHT, 1, _independent),
    'J=1 AR .9': _kind(STRAIGHT, 1, _correlated(0.9)),
    'J=2 independent': _kind(TWO, 2, _independent),
    'J=3 independent': _kind(THREE, 3, _independent),
    'J=4 independent': _kind(FOUR, 4, _independent),
    'J=6 independent': _kind(SIX, 6, _independent),
    'J=4 uneven noise': _kind(FOUR, 4, _uneven),
    'J=4 t3': _kind(FOUR, 4, _heavy),
    'J=4 AR .9': _kind(FOUR, 4, _correlated(0.9)),
    'J=4 AR .99': _kind(FOUR, 4, _correlated(0.99)),
    'J=4 weak knees': _kind(WEAK, 4, _independent),
    'square root': _kind(lambda u: 100.0 * np.sqrt(_share(u)), 0, _independent),
    'square': _kind(lambda u: 100.0 * _share(u) ** 2, 0, _independent),
    'J=1 t3': _kind(STRAIGHT, 1, _heavy),
    'J=4 AR .9, one sweep': _sweep,
    'J=3 with jumps': _jumps,
}


def random_truth(n: int, r: Random) -> Sampled:
    """Return samples of a random curve with random noise, for judging confidence.

    One to six pieces, knees of any strength from hardly visible to plain, noise
    independent or correlated, normal or heavy-tailed.
    """
    pieces = int(r.integers(1, 7))
    inner = LOW + (HIGH - LOW) * np.cumsum(0.5 / pieces + 0.5 * r.dirichlet(np.full(pieces, 2.0)))
    bends = (
        r.choice([-1.0, 1.0], pieces - 1)
        * np.geomspace(0.015, 0.15, 201)[r.integers(0, 201, pieces - 1)]
    )
    slopes = 0.12 + np.concatenate([[0.0], np.cumsum(bends)])
    curve = broken_line(inner[:-1].tolist(), slopes.tolist())
    u = openings(n, r)
    root = float(r.choice([0.0, 0.5, 0.9]))
    noise = autoregressive(n, r, root) if r.random() < 0.7 else r.standard_t(4, n)
    return Sampled(u, curve(u) + r.uniform(1.0, 4.0) * noise, pieces)
