# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Causes in the response of the power: another lag at high load, the reheater, another clock."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from valveflow_ros.curve.regional_model import RegionalModel, make_taps
from valveflow_ros.diagnosis import kernels
from valveflow_ros.diagnosis.cause import (
    Cause,
    Kind,
    SentenceValues,
    Stage,
    Start,
    Unknown,
    Values,
)
from valveflow_ros.diagnosis.grids import Grids
from valveflow_ros.diagnosis.screening import Screening
from valveflow_ros.errors import short
from valveflow_ros.records import FloatArray

_TRIED_SHARES = (0.1, 0.3, 0.5, 0.7)
_TRIED_FACTORS = (0.4, 0.7, 1.5, 2.5)


def apply_region_lag(model: RegionalModel, values: Values) -> RegionalModel:
    """Above a load the unit stores more steam and responds with other dynamics than the model.

    These are the regional G_i of eq. (3): above ``level`` another time constant and delay apply.
    """
    time_s, delay_s, level = values
    keep = model.levels < level
    inside = int(keep.sum()) + 1
    return replace(
        model,
        levels=np.append(model.levels[keep], level),
        time_constants=np.append(model.time_constants[:inside], time_s),
        delays=np.append(model.delays[:inside], delay_s),
    )


def region_lag_starts(screening: Screening) -> Sequence[Start]:
    """Try other time constants above several loads, including the levels of the model."""
    grids, base = screening.grids, screening.model.base
    used = grids.usable > 0
    x = base.static(grids.u[used][::10], grids.scale[used][::10])
    levels = [*np.quantile(x, _TRIED_SHARES).tolist(), *(base.levels + 0.01).tolist()]
    grid: list[Values] = []
    for level in levels:
        own = int(np.searchsorted(base.levels, level))
        for factor in _TRIED_FACTORS:
            grid.append(
                (float(base.time_constants[own]) * factor, float(base.delays[own]), float(level))
            )
    return screening.best(REGION_LAG, grid)


def region_lag_sentence(values: SentenceValues) -> str:
    """Return the sentence; a time that is smaller than its error is reported as unknown."""
    time_s, delay_s = (
        'that is not known' if name in values.unsure else f'of {values[name]:.{digits}g} s'
        for name, digits in (('time_s', 3), ('delay_s', 2))
    )
    return (
        f'Above {short(values["level_mw"])} MW the unit answers with a time constant {time_s} and '
        f'a delay {delay_s}, unlike the model.'
    )


REGION_LAG = Cause(
    'region_lag', 'lag', Stage.DYNAMICS,
    (
        Unknown('time_s', 's', 1.0, 0.2, 3600.0),
        Unknown('delay_s', 's', 0.5, 0.0, 600.0),
        Unknown('level_mw', 'MW', 6.0, 0.0, 1e5, Kind.LINE),
    ),
    apply_region_lag, region_lag_starts, region_lag_sentence,
    ('reheater', 'backlash', 'rate_limit'),
    'Run the same ramp at two speeds: what a lag does grows with the speed.',
    of_model=True,
)  # fmt: skip


_SLOW, _SWALLOWED, _SHORTEST, _QUICK, _STEPS = (0.3, 60.0), 0.7, 0.3, 0.05, 5
_REHEATER_TRIED = tuple((alpha, t) for alpha in (0.2, 0.4, 0.7) for t in (8.0, 20.0, 60.0, 200.0))


def apply_reheater(y: FloatArray, values: Values, grids: Grids) -> FloatArray:
    """A part of the power is generated after the reheater, which fills slowly.

    The IEEE turbine models (IEEEG1, TGOV1) split the power: the fraction alpha is generated
    before the reheater without delay; the rest follows the filling of the reheater.

        y = alpha y1 + (1 - alpha) y1 / (1 + T s),  y1 = G x
    """
    alpha, time_s = values
    (tap,) = make_taps(np.array([time_s]), np.zeros(1), grids.step_s)
    out = np.empty_like(y)
    work = kernels.reheated if y.ndim == 1 else kernels.reheated_table
    work(y, grids.usable, alpha, tap, out)
    return out


def reheater_starts(screening: Screening) -> Sequence[Start]:
    """Try several fractions and time constants; also fit the whole model with a faster base.

    The lag of the plain model contains much of the reheater lag; linearised steps cannot leave it.
    """
    base = screening.model.base
    alpha, time_s = _SLOW
    less = _SWALLOWED * (1.0 - alpha) * time_s
    quicker = np.maximum(base.time_constants - less, _SHORTEST * base.time_constants)
    # Or the reheater causes the whole lag, as in a unit with a fast valve and steam chest.
    whole = float(np.median(base.time_constants + base.delays)) / (1.0 - alpha)
    quick = np.full(base.regions, max(_QUICK * whole, screening.grids.step_s))
    fitted = [
        screening.fitted(REHEATER, _SLOW, replace(base, time_constants=quicker)),
        screening.fitted(
            REHEATER, (alpha, whole),
            replace(base, time_constants=quick, delays=np.zeros(base.regions)),
        ),
    ]  # fmt: skip
    return [
        *screening.best(REHEATER, list(_REHEATER_TRIED), keep=1),
        *(start for start in fitted if start.gain > 0.0),
    ]


def reheater_sentence(values: dict[str, float]) -> str:
    """Return the sentence for the operator."""
    return (
        f'Only {100.0 * values["alpha"]:.0f} % of the power follows the valve at once. The rest '
        f'follows through the reheater, with a time constant of {values["time_s"]:.3g} s.'
    )


REHEATER = Cause(
    'reheater', 'lag', Stage.OUTPUT,
    (
        # Values with equal (1 - alpha) T look nearly the same, so a normal interval is too narrow.
        Unknown('alpha', '', 0.03, 0.0, 1.0, Kind.ROUGH),
        # A reheater fills within seconds to a minute; a memory of hours has another reason.
        Unknown('time_s', 's', 1.0, 0.5, 300.0, Kind.ROUGH),
    ),
    apply_reheater, reheater_starts, reheater_sentence, ('clock', 'region_lag', 'rate_limit'),
    'Steps of the opening at constant pressure, power logged every second: two slopes in the '
    'answer are a reheater.',
    order=1,
)  # fmt: skip


# Between valve and generator only the steam chest must fill: 3 to 10 s in the paper.
_LONGEST_DELAY_S = 15.0
_TRIED_S = (3.0, 6.0, 10.0, 16.0, 25.0, 40.0)


def apply_clock(y: FloatArray, values: Values, grids: Grids) -> FloatArray:
    """The power has time stamps of another clock, so that the response precedes its cause.

        y in the row of time t was measured at t + d,  d > 0

    A power stamped too late is equivalent to a longer delay and cannot be detected. Of a power
    stamped too early only the part beyond the shortest delay is visible: ``d_s`` is that part, and
    the upper end of its interval is raised by the longest possible delay of a unit.
    """
    part, whole = np.modf(values[0] / grids.step_s)

    def ahead(rows: int) -> FloatArray:
        rows = min(rows, len(y))
        return np.concatenate([y[rows:], np.repeat(y[-1:], rows, axis=0)])

    out, after = ahead(int(whole)), ahead(int(whole) + 1)
    out *= 1.0 - part
    after *= part
    out += after
    return out


def clock_starts(screening: Screening) -> Sequence[Start]:
    """Try several offsets."""
    return screening.best(CLOCK, [(d,) for d in _TRIED_S], keep=2)


def clock_sentence(values: dict[str, float]) -> str:
    """Return the sentence for the operator."""
    return (
        f'The power answers before the valve moves: its time stamps are about '
        f'{values["d_s"]:.2g} s early against those of the opening, more if the unit has a delay.'
    )


CLOCK = Cause(
    'clock', 'lag', Stage.OUTPUT,
    (Unknown('d_s', 's', 0.5, 0.0, 60.0, concealed=_LONGEST_DELAY_S),),
    apply_clock, clock_starts, clock_sentence, ('reheater', 'region_lag'),
    'Compare the clocks of both loggers, or record both signals with one of them.',
    order=2,
)  # fmt: skip
