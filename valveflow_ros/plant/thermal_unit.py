# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The constants of a unit with a physical model: valves, steam, boiler and turbine.

Nothing here comes from the paper. The steam flow is a power of the pressure times an area
that depends on the opening. The power is proportional to the flow minus the flow at no load
(Willans line).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from valveflow_ros.errors import InputError
from valveflow_ros.plant.unit import refuse_unless
from valveflow_ros.records import FloatArray

# Openings above 100 % do not occur; the table ends at the end of the area of a group.
_TABLE_PERCENT = 130.0
TABLE_STEP_PERCENT = 0.05


@dataclass(frozen=True, slots=True)
class SmoothArea:
    """The area of valves that move together: nearly straight sections with rounded joints."""

    knees_percent: tuple[float, ...] = (50.0, 71.0)  # openings at which the sections meet
    slopes: tuple[float, ...] = (1.0, 0.45, 0.25)  # of the sections; only their ratios matter
    rounding_percent: float = 2.0  # the opening of four fifths of a knee's change of slope

    def __post_init__(self) -> None:
        knees = self.knees_percent
        good = len(self.slopes) == len(knees) + 1 and min(self.slopes) > 0.0
        if not (good and list(knees) == sorted(knees) and 0.1 <= self.rounding_percent <= 10.0):
            raise InputError(
                'A smooth area needs rising knees, one slope above 0 more than knees, '
                'and a rounding of 0.1 to 10 %.'
            )

    def __call__(self, opening_percent: FloatArray) -> FloatArray:
        """Return the area in arbitrary units, 0 at 0 %."""
        # Each knee adds the integral of a logistic step of slope, 10 to 90 % of it in 4.4 widths.
        width = self.rounding_percent / (2.0 * np.log(9.0))
        area = self.slopes[0] * opening_percent
        for knee, before, after in zip(
            self.knees_percent, self.slopes, self.slopes[1:], strict=False
        ):
            bend = np.logaddexp(0.0, (opening_percent - knee) / width)
            area = area + (after - before) * width * (bend - np.logaddexp(0.0, -knee / width))
        return np.asarray(area)


@dataclass(frozen=True, slots=True)
class GovernorValve:
    """One of several valves that open in sequence."""

    from_percent: float  # the demand at which it begins to open
    to_percent: float  # and that at which it is fully open
    share: float  # of the whole area; only ratios matter
    bend: float = 2.2  # flattening of its area towards full lift; 0 is straight

    def lift_percent(self, demand_percent: FloatArray) -> FloatArray:
        """Return its own position, 0 to 100 %."""
        way = (demand_percent - self.from_percent) / (self.to_percent - self.from_percent)
        return np.asarray(100.0 * np.clip(way, 0.0, 1.0))

    def area(self, demand_percent: FloatArray) -> FloatArray:
        """Return its area at a demand, 0 to ``share``."""
        lift = self.lift_percent(demand_percent) / 100.0
        # The pilot opens first: the area begins with slope 0 and is straight after a tenth.
        raised = lift * lift / (lift + 0.1) * 1.1
        if self.bend == 0.0:
            return np.asarray(self.share * raised)
        shape = -np.expm1(-self.bend * raised) / -np.expm1(-self.bend)
        return np.asarray(self.share * shape)


@dataclass(frozen=True, slots=True)
class SequencedValves:
    """Three or four governor valves that open in sequence, with overlap."""

    valves: tuple[GovernorValve, ...] = (
        GovernorValve(0.0, 46.0, 0.31),
        GovernorValve(0.0, 52.0, 0.30),
        GovernorValve(38.0, 76.0, 0.25),
        GovernorValve(64.0, 100.0, 0.16),
    )

    def __post_init__(self) -> None:
        good = 1 <= len(self.valves) <= 8 and all(
            v.from_percent < v.to_percent and v.share > 0.0 and v.bend >= 0.0 for v in self.valves
        )
        if not good:
            raise InputError('A sequence needs 1 to 8 valves with a range and a share above 0.')

    def __call__(self, opening_percent: FloatArray) -> FloatArray:
        """Return the area in arbitrary units, 0 at 0 %."""
        return np.asarray(sum(valve.area(opening_percent) for valve in self.valves))


# Instruments: standard deviation, and smallest step, in the unit of the column.
NOISE: dict[str, float] = {
    'valve_opening_percent': 0.02,
    'main_steam_pressure_mpa': 0.006,
    'main_steam_temperature_degc': 0.1,
    'generated_power_mw': 0.12,
    'condenser_pressure_kpa': 0.01,
}
RESOLUTION: dict[str, float] = {
    'valve_opening_percent': 0.01,
    'main_steam_pressure_mpa': 0.002,
    'main_steam_temperature_degc': 0.1,
    'generated_power_mw': 0.02,
    'valve_command_percent': 0.01,
    'condenser_pressure_kpa': 0.01,
    'grid_frequency_hz': 0.001,
}

# The kinds: the law of the flow, and sliding or fixed pressure.

KINDS = {
    'choked': ('opening', True),
    'choked_fixed': ('opening', False),
    'sequence': ('sequence', True),
    'sequence_fixed': ('sequence', False),
    'integrated_input': ('integrated_input', True),
    'integrated_input_fixed': ('integrated_input', False),
}


@dataclass(frozen=True, slots=True)
class ThermalUnit:
    """A reheat unit of about 330 MW, sampled at 1 s."""

    # One of `KINDS`: 'choked' has the flow ``p^m f(V)``, 'sequence' the same with several valves,
    # 'integrated_input' the paper's ``g(V p^m)``; '_fixed' means fixed pressure.
    kind: str = 'choked'
    # f, or g over the opening at rated pressure.
    area: SmoothArea | SequencedValves = field(default_factory=SmoothArea)
    exponent: float = 1.0  # m
    rated_mw: float = 330.0  # at full flow
    no_load_mw: float = 14.0  # c of power = (rated + c) flow - c
    full_opening_percent: float = 88.0  # of full flow at rated pressure
    load_low_mw: float = 140.0  # range of the load schedule
    load_high_mw: float = 322.0
    pressure_rated_mpa: float = 16.7  # set point at and above ``slide_to_mw``
    pressure_low_mpa: float = 9.6  # at and below ``slide_from_mw``
    slide_from_mw: float = 165.0
    slide_to_mw: float = 300.0
    # Standard deviation of the set point's slow variation, in addition to that by the fire.
    pressure_wander_mpa: float = 0.25
    # Fraction of the time at which a sliding unit must have a reserve: for hours the pressure is
    # between the sliding and the rated one, so that the valve throttles.
    reserve_hours: float = 0.4
    storage_s: float = 220.0  # of full flow that would consume the boiler's pressure
    fuel_s: float = 80.0  # lags of the fire
    mill_s: float = 25.0
    # Of the pressure between drum and valve at full flow, as a fraction of the rated pressure.
    drop: float = 0.05
    actuator_s: float = 1.0  # lags
    high_pressure_s: float = 0.6
    reheater_s: float = 11.0
    high_pressure_share: float = 0.3  # of the power, generated before the reheater
    integral_s: float = 45.0  # reset time of the governor's integral action on MW
    ramp_mw_per_min: float = 6.0  # maximum rate of the set point
    agc_mw: float = 3.0  # standard deviation of the AGC's addition to the schedule
    droop: float = 0.05  # of the primary response, with its dead band
    dead_band_hz: float = 0.033
    temperature_degc: float = 538.0  # of the steam at full load
    temperature_wander_k: float = 1.8  # its random variation
    temperature_load_k: float = 4.0  # its decrease at lowest load
    # Relative change of the power per K and per kPa of condenser pressure; 0 is none.
    temperature_per_k: float = 0.0
    vacuum_per_kpa: float = -0.008
    water_degc: float = 20.0  # mean of the cooling water, the reference
    water_weather_k: float = 2.0  # its variation over days
    water_daily_k: float = 1.0  # its daily amplitude
    swing_mw: float = 0.25  # standard deviation of the power's own noise; time constant 15 s
    fire: float = 0.007  # that of the heat, as a fraction of full flow; time constant 900 s
    # Standard deviation and smallest step of the instruments, by column.
    noise: dict[str, float] = field(default_factory=lambda: dict(NOISE))
    resolution: dict[str, float] = field(default_factory=lambda: dict(RESOLUTION))

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise InputError(f"There is no unit '{self.kind}': use one of {', '.join(KINDS)}.")
        times = (self.storage_s, self.fuel_s, self.mill_s, self.actuator_s, self.high_pressure_s,
                 self.reheater_s, self.integral_s)  # fmt: skip
        checks = (
            (min(times) > 0.0, 'its times must be above 0 s'),
            (0.5 <= self.exponent <= 2.0, 'the exponent must be 0.5 to 2'),
            (self.no_load_mw >= 0.0, 'no_load_mw must be 0 or more'),
            (0.0 < self.load_low_mw < self.load_high_mw <= self.rated_mw,
             'loads must be above 0, rising, and at most rated_mw'),
            (self.load_low_mw <= self.slide_from_mw < self.slide_to_mw,
             'slide_from_mw must be load_low_mw or more and less than slide_to_mw'),
            (1.0 <= self.pressure_low_mpa <= self.pressure_rated_mpa <= 35.0,
             'pressures must be 1 to 35 MPa and the lowest not above the rated one'),
            (10.0 <= self.full_opening_percent <= 100.0, 'full_opening_percent: 10 to 100 %'),
            (0.0 <= self.reserve_hours <= 1.0, 'reserve_hours must be 0 to 1'),
            (0.0 <= self.high_pressure_share <= 1.0, 'high_pressure_share must be 0 to 1'),
            (self.ramp_mw_per_min > 0.0 and self.droop > 0.0,
             'ramp_mw_per_min and droop must be above 0'),
            (max(abs(self.temperature_per_k), abs(self.vacuum_per_kpa)) <= 0.05,
             'temperature_per_k and vacuum_per_kpa must be -0.05 to 0.05'),
        )  # fmt: skip
        refuse_unless('unit cannot be simulated', *checks)

    @property
    def form(self) -> str:
        """Return the variable of the breakpoints: 'opening', 'sequence' or 'integrated_input'."""
        return KINDS[self.kind][0]

    @property
    def on_opening(self) -> bool:
        """Return True if the area is a function of the opening only."""
        return self.form != 'integrated_input'

    def area_table(self) -> FloatArray:
        """Return the area at multiples of `TABLE_STEP_PERCENT`, 1 at the full opening."""
        opening = np.arange(0.0, _TABLE_PERCENT, TABLE_STEP_PERCENT)
        return self.area(opening) / float(self.area(np.array(self.full_opening_percent)))

    def flow(self, opening_percent: FloatArray, pressure_mpa: FloatArray) -> FloatArray:
        """Return the steady-state steam flow, as a fraction of the full flow."""
        density = (np.asarray(pressure_mpa) / self.pressure_rated_mpa) ** self.exponent
        table = self.area_table()
        known = np.arange(table.size) * TABLE_STEP_PERCENT
        if self.on_opening:
            return np.asarray(density * np.interp(opening_percent, known, table))
        return np.asarray(np.interp(np.asarray(opening_percent) * density, known, table))

    def static_power(self, opening_percent: FloatArray, pressure_mpa: FloatArray) -> FloatArray:
        """Return the steady-state power without effects, MW, at true openings and pressures (n,).

        It is that at `temperature_degc` and `water_degc`; the opening of several valves is the
        demand.
        """
        flow = self.flow(opening_percent, pressure_mpa)
        return np.asarray((self.rated_mw + self.no_load_mw) * flow - self.no_load_mw)

    def pressure_set_mpa(self, load_mw: FloatArray) -> FloatArray:
        """Return the pressure set point at a load: constant, sliding, constant."""
        ends = (self.pressure_low_mpa, self.pressure_rated_mpa)
        return np.asarray(np.interp(load_mw, (self.slide_from_mw, self.slide_to_mw), ends))

    def to_json(self) -> dict[str, Any]:
        """Return all constants of the unit."""

        def plain(value: Any) -> Any:
            if isinstance(value, dict):
                return {key: plain(inner) for key, inner in value.items()}
            return [plain(v) for v in value] if isinstance(value, tuple) else value

        return {key: plain(value) for key, value in dataclasses.asdict(self).items()}


def random_unit(kind: str, number: int) -> ThermalUnit:
    """Draw a unit of a kind; the same number gives the same unit.

    The breakpoints are in the valve's range of operation, the pressure of a sliding unit is
    between 7 and 18 MPa, and the valve has a reserve at full load. Raises `InputError` for an
    unknown kind, or a number below 0.
    """
    if kind not in KINDS:
        raise InputError(f"There is no unit '{kind}': use one of {', '.join(KINDS)}.")
    if number < 0:
        raise InputError(f'The number of a unit must be 0 or more, not {number}.')
    rng = np.random.default_rng([number, list(KINDS).index(kind)])
    form, sliding = KINDS[kind]
    area = _sequence(rng) if form == 'sequence' else _smooth(rng, sliding)
    rated, c = rng.uniform(320.0, 335.0), rng.uniform(8.0, 22.0)
    exponent, top = rng.uniform(1.0, 1.13), rng.uniform(16.2, 17.2)
    low, full = rng.uniform(132.0, 155.0), rng.uniform(84.0, 90.0)
    slide_from = max(low, rng.uniform(0.42, 0.54) * rated)
    slide_to = rng.uniform(0.86, 0.94) * rated
    lowest = top
    if sliding:
        # Fraction of the full area that is open at the lower end of the sliding range.
        open_share = rng.uniform(0.74, 0.9) if form == 'sequence' else rng.uniform(0.8, 0.94)
        flow = (slide_from + c) / (rated + c)
        lowest = max(7.0, top * (flow / open_share) ** (1.0 / exponent))
    return ThermalUnit(
        kind=kind, area=area, exponent=exponent, rated_mw=rated, no_load_mw=c,
        full_opening_percent=full, load_low_mw=low,
        load_high_mw=rng.uniform(0.96, 0.98) * rated,
        pressure_rated_mpa=top, pressure_low_mpa=lowest,
        slide_from_mw=slide_from, slide_to_mw=slide_to,
        pressure_wander_mpa=rng.uniform(0.18, 0.32) if sliding else rng.uniform(0.06, 0.15),
        reserve_hours=rng.uniform(0.2, 0.6),
        # Half of the units have a drum; once-through boilers store less and respond faster.
        storage_s=rng.uniform(180.0, 300.0) if rng.random() < 0.5 else rng.uniform(110.0, 150.0),
        fuel_s=rng.uniform(60.0, 110.0), mill_s=rng.uniform(15.0, 35.0),
        drop=rng.uniform(0.03, 0.07), actuator_s=rng.uniform(0.6, 1.4),
        high_pressure_s=rng.uniform(0.5, 1.0), reheater_s=rng.uniform(8.0, 15.0),
        high_pressure_share=rng.uniform(0.26, 0.34), integral_s=rng.uniform(35.0, 70.0),
        ramp_mw_per_min=rng.uniform(4.5, 7.5), agc_mw=rng.uniform(2.0, 4.5),
        droop=rng.uniform(0.045, 0.06), dead_band_hz=float(rng.choice([0.02, 0.033])),
        temperature_degc=rng.uniform(535.0, 541.0), temperature_wander_k=rng.uniform(1.2, 2.4),
        temperature_load_k=rng.uniform(2.0, 7.0), vacuum_per_kpa=-rng.uniform(0.006, 0.01),
        water_degc=rng.uniform(16.0, 24.0), water_weather_k=rng.uniform(1.5, 2.5),
        water_daily_k=rng.uniform(0.6, 1.5), swing_mw=rng.uniform(0.15, 0.4),
    )  # fmt: skip


def _smooth(rng: np.random.Generator, sliding: bool) -> SmoothArea:
    """Draw three sections whose slopes fall by a factor of 1.6 to 2.6 from one to the next."""
    # With fixed pressure the valve has a wider range, from much smaller openings.
    first = rng.uniform(44.0, 54.0) if sliding else rng.uniform(34.0, 48.0)
    second = first + rng.uniform(17.0, 23.0)
    slopes = 1.0 / np.append(1.0, np.cumprod(rng.uniform(1.6, 2.6, 2)))
    return SmoothArea((first, second), tuple(slopes.tolist()), rng.uniform(1.0, 3.0))


def _sequence(rng: np.random.Generator) -> SequencedValves:
    """Draw three or four valves; each begins to open before the last one is fully open."""
    count = int(rng.integers(3, 5))
    ends = np.array([50.0, 76.0, 100.0]) + rng.uniform(-4.0, 4.0, 3) * (1.0, 1.0, 0.0)
    overlaps = rng.uniform(6.0, 14.0, 2)
    starts = np.array([0.0, ends[0] - overlaps[0], ends[1] - overlaps[1]])
    shares = np.array([0.60, 0.25, 0.16]) * rng.uniform(0.9, 1.1, 3)
    bends = rng.uniform(1.6, 2.8, 3)
    rows = list(zip(starts, ends, shares, bends, strict=True))
    if count == 4:
        # Two slightly different valves open together first.
        start, end, share, bend = rows[0]
        later = end + rng.uniform(2.0, 6.0)
        rows[:1] = [(start, end, share / 2.0, bend), (start, later, share / 2.0, bend)]
    return SequencedValves(tuple(GovernorValve(*(float(x) for x in row)) for row in rows))


_OPTIONS = ('number', 'vacuum_per_kpa', 'temperature_per_k')


def unit_of(text: str) -> ThermalUnit:
    """Read ``KIND`` or ``KIND:key=value,...``.

    Keys are ``number`` (the number of the unit for `random_unit`, default 0), ``vacuum_per_kpa``
    and ``temperature_per_k``. Raises `InputError` for an unknown kind or key, or a value that is
    no number or out of range.
    """
    kind, _, rest = text.strip().partition(':')
    given = assignments(rest, f"Unit '{kind}'", _OPTIONS)
    number = given.pop('number', 0.0)
    if number != number // 1:
        raise InputError(f"Unit '{kind}': number must be a whole number, not {number:g}.")
    return dataclasses.replace(random_unit(kind, int(number)), **given)  # type: ignore[arg-type]


def assignments(text: str, what: str, known: tuple[str, ...]) -> dict[str, float]:
    """Return the numbers of ``key=value,...``; raises `InputError` naming ``what``."""
    found: dict[str, float] = {}
    for part in text.split(',') if text.strip() else []:
        key, _, word = (piece.strip() for piece in part.partition('='))
        if key not in known:
            raise InputError(f"{what} has no option '{key}': it has {', '.join(known)}.")
        try:
            value = float(word)
        except ValueError:
            raise InputError(f"{what}: {key} must be a number, not '{word}'.") from None
        if not np.isfinite(value):
            raise InputError(f'{what}: {key} must be a finite number, not {word}.')
        if key in found:
            raise InputError(f'{what}: {key} is given twice.')
        found[key] = value
    return found
