"""Other plausible units, so that nothing is fitted to the one unit of the paper."""

from __future__ import annotations

import numpy as np

from valveflow_ros.plant.unit import Curve, Noise, Programme, Region, UnitDescription
from valveflow_ros.records import FloatArray

_EXPONENT = 1.125
# The paper's unit, from which habits in MW and u are scaled.
_PAPER_RATED_MW = 300.0
_PAPER_LOAD_SPAN_MW = 133.5
_PAPER_U_SPAN = 1200.0


def random_unit(rng: np.random.Generator) -> UnitDescription:
    """Draw a unit of 200 to 660 MW with 2 to 6 pieces and 1 to 3 regions.

    Its curve covers what its load programme visits: an opening of 60 to 72 %
    at the lowest load and pressure, of 88 to 95 % at full load. Neighbouring
    slopes differ by a factor of 1.33 at least. Sampled at 1 or 2 s.
    """
    rated = rng.uniform(200.0, 660.0)
    pressure_low, pressure_high = rng.uniform(8.5, 11.5), rng.uniform(15.5, 17.0)
    u_low = rng.uniform(60.0, 72.0) * pressure_low**_EXPONENT
    u_full = rng.uniform(88.0, 95.0) * pressure_high**_EXPONENT
    curve = _curve(rng, rated, u_low, u_full)
    low, near_full, full = curve(u_low + np.array([0.0, 0.7, 1.0]) * (u_full - u_low))
    return UnitDescription(
        curve,
        _regions(rng, low, full),
        _noise(rng, rated),
        _programme(rng, (low, near_full, full), (pressure_low, pressure_high), u_full - u_low),
        _EXPONENT,
        float(rng.choice([1.0, 2.0])),
    )


def _curve(rng: np.random.Generator, rated: float, u_low: float, u_full: float) -> Curve:
    """Draw a continuous curve whose inner knots all lie where the unit works."""
    J = int(rng.integers(2, 7))
    widths = 0.6 / J + 0.4 * rng.dirichlet(np.full(J, 2.0))
    slopes = [1.0]
    for _ in range(J - 1):
        # Mostly flatter and flatter; now and then the next valve opens late.
        flatter = rng.random() < 0.8 and slopes[-1] > 0.08
        slopes.append(slopes[-1] * rng.uniform(*((0.4, 0.75) if flatter else (1.35, 1.8))))
    inner = np.append(0.0, np.cumsum(widths))
    rise = np.append(0.0, np.cumsum(np.array(slopes) * widths))
    knots = u_low + inner * (u_full - u_low)
    low, full = rated * rng.uniform(0.45, 0.55), rated * rng.uniform(0.95, 1.0)
    powers = low + rise / rise[-1] * (full - low)
    return _reaching_further(Curve.through(knots, powers), 0.1 * (u_full - u_low))


def _reaching_further(curve: Curve, margin: float) -> Curve:
    """Move the outermost knots outwards on their pieces: noise carries u beyond them."""
    knots: FloatArray = curve.knots.copy()
    knots[0] -= margin
    knots[-1] += margin
    return Curve(knots, curve.slopes, curve.intercepts)


def _regions(rng: np.random.Generator, low: float, full: float) -> tuple[Region, ...]:
    """Draw one to three regions, the slower the higher."""
    count = int(rng.integers(1, 4))
    inner = low + (np.arange(1, count) + rng.uniform(-0.2, 0.2, count - 1)) / count * (full - low)
    regions = []
    time_s, delay_s = rng.uniform(6.0, 15.0), rng.uniform(1.0, 4.0)
    for power_to in [*inner, np.inf]:
        regions.append(Region(float(power_to), time_s, delay_s))
        time_s, delay_s = time_s * rng.uniform(1.8, 3.0), delay_s * rng.uniform(1.2, 2.0)
    return tuple(regions)


def _noise(rng: np.random.Generator, rated: float) -> Noise:
    """Draw disturbances from half to one and a half times the paper's unit's."""
    scale = rated / _PAPER_RATED_MW
    return Noise(
        slow_mw=2.0 * scale * rng.uniform(0.5, 1.5),
        slow_time_s=rng.uniform(30.0, 120.0),
        white_mw=2.2 * scale * rng.uniform(0.5, 1.5),
        opening_percent=rng.uniform(0.01, 0.03),
        pressure_mpa=rng.uniform(0.005, 0.015),
        temperature_k=rng.uniform(0.1, 0.3),
    )


def _programme(
    rng: np.random.Generator,
    loads_mw: tuple[float, float, float],
    pressures_mpa: tuple[float, float],
    u_span: float,
) -> Programme:
    """Scale the habits of the paper's unit to another one, with other weather and grid."""
    low, near_full, full = loads_mw
    scale = (full - low) / _PAPER_LOAD_SPAN_MW
    return Programme(
        load_mean_mw=low + 68.0 * scale,
        load_daily_mw=32.0 * scale,
        load_spread_mw=50.0 * scale,
        load_low_mw=low,
        load_high_mw=full,
        full_load_from_mw=near_full,
        ramp_low_mw_per_min=2.5 * scale,
        ramp_high_mw_per_min=6.0 * scale,
        pressure_low_mpa=pressures_mpa[0],
        pressure_rise_mpa=pressures_mpa[1] - pressures_mpa[0],
        pressure_span_mw=full - low,
        pressure_wander_mpa=rng.uniform(0.15, 0.3),
        temperature_degc=rng.uniform(535.0, 542.0),
        jitter_percent=rng.uniform(0.2, 0.4),
        pulse_every_s=rng.uniform(1000.0, 2000.0),
        feedback=bool(rng.random() < 0.8),
        feedback_slope_mw=(full - low) / u_span,
        feedback_limit_u=150.0 * u_span / _PAPER_U_SPAN,
        feedback_off_above_mw=full - 4.5 * scale,
    )
