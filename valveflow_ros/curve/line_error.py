"""How far off a curve may be at one u, told from the two standard errors of its pieces."""

from __future__ import annotations

import math

import numpy as np

from valveflow_ros.curve.characteristic import Characteristic, Piece
from valveflow_ros.records import FloatArray, IntArray


def piece_error(piece: Piece, u: FloatArray) -> FloatArray:
    """Return the standard error of a piece's line at ``u`` in MW.

    Parameters
    ----------
    piece : Piece
    u : float64 (n,)
        Integrated input, % MPa^m.

    Returns
    -------
    float64 (n,)
        NaN where the slope's error is not known.

    Notes
    -----
    A line through samples with mean m and variance v of u has the error
    ``slope_stderr * sqrt((u - m)^2 + v)``. Slope and intercept errors alone do not say
    where m is (their difference is one of large numbers), so the samples are taken to be
    spread evenly over the piece: m is its middle and v a twelfth of its width squared.
    """
    u = np.asarray(u, dtype=np.float64)
    width, middle = piece.u_to - piece.u_from, 0.5 * (piece.u_from + piece.u_to)
    return np.asarray(piece.slope_stderr * np.sqrt((u - middle) ** 2 + width**2 / 12.0))


def piece_of(curve: Characteristic, u: FloatArray) -> IntArray:
    """Return the index of the piece at each ``u``; beyond the ends the outer pieces."""
    return np.asarray(np.searchsorted(curve.breakpoints[1:-1], u, side='right'))


def curve_error(curve: Characteristic, u: FloatArray) -> FloatArray:
    """Return the standard error of F(u) in MW, shape of ``u``; see `piece_error`."""
    u = np.asarray(u, dtype=np.float64)
    index = piece_of(curve, u)
    error = np.full(u.shape, math.nan)
    for k, piece in enumerate(curve.pieces):
        error[index == k] = piece_error(piece, u[index == k])
    return error
