# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Possible faults of a unit of `valveflow_ros.plant.thermal_unit` or of its record.

Effects with the same meaning as in the paper's unit are taken from its catalogue. Effects that
change the paper's curve or its regions have no meaning here. Three more effects act on parts that
the paper's unit does not have: the steam area, the position sensor's zero, the pressure sensor.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from valveflow_ros.errors import InputError
from valveflow_ros.parameters import Parameter
from valveflow_ros.plant.effect import ONSET, Effect, Hooks, Values, effect, ramp, step
from valveflow_ros.plant.effects import catalogue
from valveflow_ros.plant.spec import EffectSpec
from valveflow_ros.plant.unit import UnitDescription
from valveflow_ros.records import FloatArray

_SHARED = (
    'backlash', 'clock', 'diurnal', 'flatline', 'gain_drift', 'gain_step', 'input_drift',
    'input_step', 'intervals', 'output_offset_drift', 'quantisation', 'rate_limit', 'saturation',
    'spikes', 'stiction', 'temperature',
)  # fmt: skip

Change = Callable[[FloatArray], FloatArray]


@dataclass(slots=True)
class ThermalHooks(Hooks):
    """The places of `Hooks`, and three more; functions of the seconds since the first row."""

    area: list[Change] = field(default_factory=list)  # factors on the steam area
    # Errors of the position sensor in %, positive if too high.
    position_zero: list[Change] = field(default_factory=list)
    pressure_factor: float = 1.0  # measured divided by true pressure

    @classmethod
    def for_run(cls, length_s: float) -> ThermalHooks:
        """Return hooks without effects; record effects read the sample period from them."""
        paper = UnitDescription()
        return cls(paper, length_s, paper.regions)


def _thermal(hooks: Hooks) -> ThermalHooks:
    if not isinstance(hooks, ThermalHooks):
        raise InputError('This effect acts on a thermal unit only; choose one with unit=...')
    return hooks


@effect(
    'The steam area belonging to an opening changes at one moment.',
    Parameter('g', 0.01, '', 'Relative change.', -0.3, 0.3),
    ONSET,
)
def area_step(values: Values, hooks: Hooks) -> None:
    """Multiply the area by 1 + g from t0 on: worn seats, a broken part, an overhaul."""
    _thermal(hooks).area.append(lambda time_s: 1.0 + values['g'] * step(time_s, values))


@effect(
    'The position sensor reads too high by a fixed or drifting amount.',
    Parameter('b_percent', 0.5, '%', 'What it reads too high at first.', -10.0, 10.0),
    Parameter('drift_percent', 0.0, '%/(10 d)', 'Change in ten days.', -10.0, 10.0),
)
def opening_offset(values: Values, hooks: Hooks) -> None:
    """Add b + d t / 10 d to the measured position; the servo controls the measured value."""
    _thermal(hooks).position_zero.append(
        lambda time_s: values['b_percent'] + values['drift_percent'] * ramp(time_s)
    )


@effect(
    'The pressure sensor reads too high by a share.',
    Parameter('g', 0.01, '', 'Relative error.', -0.2, 0.2),
)
def pressure_scale(values: Values, hooks: Hooks) -> None:
    """Multiply the measured pressure by 1 + g, for the record and for the control."""
    hooks.claim('pressure_scale')
    _thermal(hooks).pressure_factor = 1.0 + values['g']


def thermal_catalogue() -> dict[str, Effect]:
    """Return all effects of a thermal unit by name, in alphabetical order."""
    own = {effect.name: effect for effect in (area_step, opening_offset, pressure_scale)}
    return dict(sorted(({name: catalogue()[name] for name in _SHARED} | own).items()))


def thermal_effect(given: str | EffectSpec, kind: str) -> EffectSpec:
    """Return an effect from its text, after checking that it can act on a thermal unit.

    Raises `InputError` as `EffectSpec.parse`, and for one of the paper's curve or regions.
    """
    known = thermal_catalogue()
    name = given.partition(':')[0].strip() if isinstance(given, str) else given.name
    if name not in known and name in catalogue():
        raise InputError(
            f"Effect '{name}' changes the paper's curve or dynamics and has no meaning on the "
            f"unit '{kind}': use one of {', '.join(known)}."
        )
    if isinstance(given, EffectSpec):
        if name not in known:
            raise InputError(f"Effect '{name}' is unknown: use one of {', '.join(known)}.")
        return given
    return EffectSpec.parse(given, known)
