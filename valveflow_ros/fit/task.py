# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The task of a fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from valveflow_ros.curve.characteristic import HeldCause, Piece
from valveflow_ros.errors import DataError, TooFewSamplesError, counted
from valveflow_ros.parameters import Settings
from valveflow_ros.records import COARSE_STEP_S, FloatArray, IntArray
from valveflow_ros.segments.window import WindowContents
from valveflow_ros.signals.static_form import StaticForm


@dataclass(frozen=True, slots=True)
class FitTask:
    """All inputs of a fit."""

    request_ns: int  # time of the last row before the request; it identifies the fit
    contents: WindowContents
    settings: Settings
    # input_noise, power_noise_mw: the segmenter's noise levels at that moment
    input_noise: float
    power_noise_mw: float
    held: tuple[HeldCause, ...] = ()  # causes that were removed from the rows
    form: StaticForm | None = None  # the form of the curve; by default it is chosen from the data
    known: StaticForm | None = None  # the form that was found from earlier data


# Windows that do not determine a curve, with advice in the messages.

_EXPLAINED_LEAST = 0.5  # minimum fraction of the power's variance that a curve must explain
_ONE_LEVEL_PERCENT = 2.0  # of opening: a smaller range is a single load with noise
_LEAST_SPREAD = 10.0  # minimum range of u, in noise sd
# The same of the opening alone. Noise alone has a range of 4.7. In means over a minute the moves
# of a lively unit count as noise: with 10, units whose valve moved by 25 % were refused.
_LEAST_MOVED = 6.0


def evaluate(pieces: tuple[Piece, ...], u: FloatArray) -> FloatArray:
    """Return the power of a curve at ``u`` in MW; at a knot that of the piece to its right."""
    inner = np.array([p.u_to for p in pieces[:-1]])
    k = np.searchsorted(inner, u, side='right')
    slopes = np.array([p.slope for p in pieces])
    return np.asarray(slopes[k] * u + np.array([p.intercept for p in pieces])[k])


def enough_samples(task: FitTask, samples: int) -> None:
    """Raise `DataError` with advice if a window does not permit a fit."""
    c = task.contents
    usable = np.isfinite(c.u) & np.isfinite(c.power_mw)
    if not usable.any():
        raise DataError('There is no row with opening, pressure and power together.')
    if np.ptp(c.u[usable]) == 0.0:
        raise DataError(
            'The integrated input never changes: a curve needs the valve at several openings.'
        )
    need = task.settings.whole('min_fit_samples')
    if samples < need:
        step_s = task.settings.real('sample_period')
        advice = 'Longer data, or calmer operation at several loads, would help.'
        what = 'Samples in steady-state and slope-response segments'
        if step_s >= COARSE_STEP_S:
            what = 'Rows in steady-state and slope-response segments'
            advice = (
                f'The table has a row every {step_s:g} s, so that is {step_s * need / 3600.0:.2g} '
                f'h of such operation. {advice}'
            )
        raise TooFewSamplesError(what, samples, need, advice)


def input_moved(task: FitTask, u: FloatArray) -> None:
    """Raise `DataError` if all samples are at one opening: they determine no slope."""
    low, high = np.quantile(u, (0.01, 0.99))
    if high - low < _LEAST_SPREAD * task.input_noise:
        raise DataError(
            f'The unit stood at one opening: in the special segments u lies between {low:.4g} and '
            f'{high:.4g}, hardly more than its noise of {task.input_noise:.2g}. A curve needs '
            'several loads.'
        )


def valve_moved(task: FitTask, rows: IntArray) -> None:
    """Raise `DataError` if only the pressure changed u.

    Such samples may fit a curve well, since power depends on the pressure. But it is no
    characteristic of the valve, and a stuck opening transmitter gives the same.
    """
    if not len(task.contents.opening_percent):
        return
    opening, u = task.contents.opening_percent[rows], task.contents.u[rows]
    known = np.isfinite(opening)
    if not known.any() or not np.median(opening[known]) > 0.0:
        return
    low, high = np.quantile(opening[known], (0.01, 0.99))
    moved_u = (high - low) * float(np.median(u[known]) / np.median(opening[known]))
    if moved_u < _LEAST_MOVED * task.input_noise:
        raise DataError(
            f'The valve did not move: in the special segments its opening lies between {low:.4g} '
            f'and {high:.4g} %, and u follows the pressure alone. Hours at several openings are '
            'needed; if the valve did move, the transmitter of its opening is dead.'
        )


def carries_a_curve(task: FitTask, rows: IntArray, pieces: int, static_mw: FloatArray) -> None:
    """Raise `DataError` if the scatter is so large that a curve would be misleading."""
    power = task.contents.power_mw[rows]
    rest = power - static_mw
    total = float(np.var(power))
    explained = 1.0 - float(np.mean(rest**2)) / total if total > 0.0 else 0.0
    if explained >= _EXPLAINED_LEAST:
        return
    opening = (
        task.contents.opening_percent[rows] if len(task.contents.opening_percent) else power[:0]
    )
    known = opening[np.isfinite(opening)]
    if len(known) and np.ptp(np.quantile(known, (0.01, 0.99))) < _ONE_LEVEL_PERCENT:
        raise DataError(
            f'The unit stood at one opening, {np.median(known):.4g} %, in all special segments. '
            'A curve needs several loads: hours at other openings would help.'
        )
    raise DataError(
        f'The power hardly follows the valve: the best curve of {counted(pieces, "piece")} '
        f'explains {100.0 * explained:.0f} % of its '
        f'variance (at least {100.0 * _EXPLAINED_LEAST:.0f} % needed). An input that is not '
        'measured moves it, or a signal is mapped wrongly.'
    )
