# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The true curve of a simulated plant, and the error of a curve (Table IV of the paper)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from valveflow_ros.curve.characteristic_json import PIECE, Joint, check_pieces
from valveflow_ros.curve.json_schema import MOST_PIECES, ListOf, Maybe, Number, checked
from valveflow_ros.errors import DataError
from valveflow_ros.records import FloatArray

_PLACES = 2000


@dataclass(frozen=True, slots=True)
class Line:
    """A piecewise-linear curve."""

    knots: FloatArray  # (J + 1,)
    slopes: FloatArray  # (J,)
    intercepts: FloatArray  # (J,)

    def __call__(self, u: FloatArray) -> FloatArray:
        """Evaluate F; the outer pieces are extended."""
        k = np.searchsorted(self.knots[1:-1], u, side='right')
        return np.asarray(self.slopes[k] * u + self.intercepts[k])


@dataclass(frozen=True, slots=True)
class Truth(Line):
    """The true curve over V p^pressure_exponent."""

    pressure_exponent: float


@dataclass(frozen=True, slots=True)
class CurveError:
    """The error of a curve relative to the true one, between two inputs."""

    rmse_mw: float
    largest_mw: float
    known: float  # fraction of the range in which the curve is defined; the errors refer to it
    slope: float = math.nan  # largest errors of the parameters, if the number of pieces is right
    knee: float = math.nan
    intercept: float = math.nan


_LINE = 'u_from', 'u_to', 'slope', 'intercept'
_SCHEMA = {
    'pressure_exponent': Maybe(Number(0.5, 2.0)),
    'pieces': ListOf({name: PIECE[name] for name in _LINE}, 1, MOST_PIECES),
}


def read_truth(raw: object) -> Truth:
    """Read a truth written by ``valveflow simulate --truth``, or a characteristic.

    Raises
    ------
    DataError
        It is neither; the message names the place.
    """
    if not isinstance(raw, dict) or not isinstance(raw.get('pieces'), list) or not raw['pieces']:
        raise DataError(
            "This is no truth of a plant of the paper's kind: it must hold a list 'pieces'."
        )
    top = checked(raw, _SCHEMA, 'truth')
    check_pieces(top['pieces'], 'truth', 'pieces', Joint.NEARLY)
    table = np.array([list(piece.values()) for piece in top['pieces']])
    exponent = top['pressure_exponent'] or 1.125
    return Truth(np.append(table[:, 0], table[-1, 1]), table[:, 2], table[:, 3], exponent)


def curve_error(
    curve: Callable[[FloatArray], FloatArray], truth: Truth, u_from: float, u_to: float
) -> CurveError:
    """Return the error of ``curve`` relative to the truth at equally spaced inputs.

    A `Line` with as many pieces as the truth is also compared piece by piece.
    """
    u = np.linspace(u_from, u_to, _PLACES)
    found = curve(u)
    known = np.isfinite(found)
    if not known.any():
        return CurveError(math.nan, math.nan, 0.0)
    off = found[known] - truth(u[known])
    parameters = [math.nan] * 3
    if isinstance(curve, Line) and len(curve.slopes) == len(truth.slopes):
        parameters = [
            float(np.abs(ours - theirs).max(initial=0.0))
            for ours, theirs in (
                (curve.slopes, truth.slopes),
                (curve.knots[1:-1], truth.knots[1:-1]),
                (curve.intercepts, truth.intercepts),
            )
        ]
    return CurveError(
        float(np.sqrt(np.mean(off**2))), float(np.abs(off).max()), float(known.mean()), *parameters
    )
