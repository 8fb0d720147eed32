# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Causes in the flow through the valve: exponent of the pressure, unchoked flow, temperature."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from valveflow_ros.curve.regional_model import RegionalModel
from valveflow_ros.diagnosis import kernels
from valveflow_ros.diagnosis.cause import Cause, Stage, Start, Unknown, Values
from valveflow_ros.diagnosis.grids import Grids
from valveflow_ros.diagnosis.screening import Screening
from valveflow_ros.records import FloatArray
from valveflow_ros.signals.static_form import LEAST_PRESSURE_RANGE, pressure_range


def apply_exponent(
    u: FloatArray, values: Values, grids: Grids, model: RegionalModel
) -> FloatArray:
    """The exponent of the pressure differs from the one in eq. (1).

    9/8 comes from the drum boiler of Bell and Astrom, fitted to one unit; ideal choked flow
    has 1. With a true exponent m + dm the flow follows

        u_true = u (p / mean p)^dm

    With sliding pressure the curve absorbs most of this effect: only deviations of the pressure
    from its line over the load show it. If the breakpoints are at fixed openings, the flow
    itself is multiplied.
    """
    log = np.log(np.maximum(grids.pressure, 1e-6))
    return np.asarray(np.exp(values[0] * (log - grids.reference.log_pressure)))


def exponent_starts(screening: Screening) -> Sequence[Start]:
    """Try both signs: with regional dynamics, a linearised step underestimates the effect."""
    return screening.scaled(EXPONENT, (0.02,))


def exponent_sentence(values: dict[str, float]) -> str:
    """Return the sentence for the operator."""
    dm = values['dm']
    return (
        f'The flow follows the main steam pressure with an exponent that is {abs(dm):.2g} '
        f'{"larger" if dm > 0.0 else "smaller"} than the model has.'
    )


def hindered(grids: Grids) -> str:
    """Return that the pressure does not change enough; empty if it does."""
    moves = pressure_range(grids.pressure[grids.usable > 0])
    if moves >= LEAST_PRESSURE_RANGE:
        return ''
    return f'the main steam pressure moves by {100.0 * moves:.2g} % only'


EXPONENT = Cause(
    'exponent', 'nozzle', Stage.INPUT,
    (Unknown('dm', '', 0.002, -0.5, 0.5),),
    apply_exponent, exponent_starts, exponent_sentence, ('choked', 'temperature', 'curve_shape'),
    'Move the pressure by 0.5 MPa at constant load, with the temperature held.',
    hindered,
)  # fmt: skip


_CRITICAL, _LARGEST = 0.546, 0.98
_TRIED_RATIOS = (0.57, 0.61, 0.66, 0.72, 0.79, 0.87)


def _psi(ratio: FloatArray) -> FloatArray:
    share = (np.clip(ratio, _CRITICAL, _LARGEST) - _CRITICAL) / (1.0 - _CRITICAL)
    return np.asarray(np.sqrt(1.0 - share * share))


def _flow(u: FloatArray, scale: FloatArray, model: RegionalModel) -> FloatArray:
    x = np.empty(len(u))
    kernels.flow(u, scale, model.offset, model.knots, model.left, model.right, x)
    return np.maximum(x, 0.0)


def apply_choked(u: FloatArray, values: Values, grids: Grids, model: RegionalModel) -> FloatArray:
    """The flow is not choked: the pressure downstream of the valve reduces it.

    Above the critical pressure ratio r_c (0.546 for superheated steam) the flow follows an
    ellipse, psi(r) = sqrt(1 - ((r - r_c) / (1 - r_c))^2). The pressure downstream of the valve is
    proportional to the flow (Stodola), r = kappa x / p. The curve already contains the psi on the
    sliding pressure line p_s(x), so the remaining effect is

        u_true = u psi(kappa F(u) / p) / psi(kappa F(u) / p_s(F(u)))

    IEC 60534 describes the same effect for control valves with an expansion factor.
    """
    x = _flow(u, grids.scale, model)
    p = np.maximum(grids.pressure, 1e-6)
    line = np.maximum(grids.reference.pressure_level + grids.reference.pressure_slope * x, 0.1 * p)
    kappa = values[0]
    return np.asarray(_psi(kappa * x / p) / _psi(kappa * x / line))


def choked_starts(screening: Screening) -> Sequence[Start]:
    """Try sizes that reach different pressure ratios at high load."""
    grids = screening.grids
    here = grids.usable > 0
    x = _flow(grids.u[here], grids.scale[here], screening.model.base)
    top = float(np.quantile(x / np.maximum(grids.pressure[here], 1e-6), 0.98))
    if not top > 0.0:
        return []
    return screening.best(CHOKED, [(r / top,) for r in _TRIED_RATIOS])


def choked_sentence(values: dict[str, float]) -> str:
    """Return the sentence for the operator."""
    return (
        'At high load the flow through the valve is not choked: the pressure behind it, about '
        f'{values["kappa"]:.3g} MPa for every MW, throttles the flow.'
    )


CHOKED = Cause(
    'choked', 'nozzle', Stage.INPUT,
    (Unknown('kappa', 'MPa/MW', 1e-4, 0.0, 0.5),),
    apply_choked, choked_starts, choked_sentence, ('exponent', 'curve_shape'),
    'Move the pressure by 0.5 MPa once at high and once at low load.',
    hindered,
)  # fmt: skip


_LEAST_SPREAD_K = 0.1


def apply_temperature(values: Values, grids: Grids, extra: Values) -> FloatArray:
    """The main steam temperature changes; the paper assumes it constant.

    The mass flow of a turbine is m ~ p / sqrt(T_K) (cone law of Stodola and Fluegel): hotter
    steam gives less mass flow, about -0.062 %/K near 539 degC, but a larger enthalpy drop.
    The net effect is a few hundredths of a per cent of the power per kelvin.

        x = F(u) (1 + k (T - mean T))
    """
    return np.asarray(1.0 + values[0] * (grids.temperature - grids.reference.temperature_degc))


def temperature_starts(screening: Screening) -> Sequence[Start]:
    """Try the slope of the residual over T."""
    return screening.scaled(TEMPERATURE, (2e-4,))


def temperature_sentence(values: dict[str, float]) -> str:
    """Return the sentence for the operator."""
    k = 100.0 * values['k']
    return (
        f'The power {"rises" if k > 0.0 else "falls"} by {abs(k):.2g} % for every kelvin that '
        'the main steam is hotter; the model takes the temperature as constant.'
    )


def temperature_hindered(grids: Grids) -> str:
    """Return that the temperature does not change; empty if it does."""
    spread = float(np.std(grids.temperature))
    if spread >= _LEAST_SPREAD_K:
        return ''
    return f'the main steam temperature hardly changes (standard deviation {spread:.2g} K)'


TEMPERATURE = Cause(
    'temperature', 'steam', Stage.GAIN,
    (Unknown('k', '1/K', 2e-5, -0.01, 0.01),),
    apply_temperature, temperature_starts, temperature_sentence,
    ('exponent', 'gain_drift', 'diurnal'),
    'Change the main steam temperature by 3 K for an hour at constant pressure and opening.',
    temperature_hindered,
)  # fmt: skip
