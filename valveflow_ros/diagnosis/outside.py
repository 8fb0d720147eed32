"""Causes that are found without the model of the unit: in the actuator and in the record."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from valveflow_ros.diagnosis import actuator
from valveflow_ros.diagnosis.cause import Told
from valveflow_ros.diagnosis.causes import catalogue
from valveflow_ros.diagnosis.estimate import Estimate
from valveflow_ros.diagnosis.gain import Gain, rmse
from valveflow_ros.diagnosis.quality import Fault
from valveflow_ros.diagnosis.result import NamedCause
from valveflow_ros.diagnosis.scene import Scene
from valveflow_ros.diagnosis.search import Found

_BETWEEN = 'Between the commanded and the measured opening: '
_SLACK = 'The valve follows only after a slack of {w_percent:.2g} % of opening is taken up.'


def actuator_cause(found: Found) -> tuple[NamedCause, ...]:
    """Return the fault between command and position sensor, its size in MW of power."""
    scene = found.task.scene
    fault = actuator.judge(scene)
    if fault is None or fault.name in found.model.names:
        return ()
    cause = catalogue()[fault.name]
    units = {u.name: u.unit for u in cause.unknowns}
    base = found.model.base
    x = base.static(scene.u[scene.usable > 0])
    rise = float(np.ptp(x) / max(np.ptp(scene.u[scene.usable > 0]), 1e-9))
    per_percent = rise * float(np.nanmean(scene.density))
    gain = Gain(fault.rms_before * per_percent, fault.rms_after * per_percent, fault.p_value)
    values = {k: v for k, (v, _, _) in fault.parameters.items()}
    return (
        NamedCause(
            fault.name,
            _BETWEEN
            + (_SLACK.format(**values) if 'w_percent' in values else cause.sentence(Told(values))),
            {k: Estimate(*v, units[k]) for k, v in fault.parameters.items()},
            gain,
            cause.experiment,
        ),
    )


def record_causes(
    raw: Scene | None, found: Found, wrong: tuple[Fault, ...]
) -> tuple[NamedCause, ...]:
    """Return faults of the record as causes; before: with the rows that were not believed."""
    if raw is None:
        return ()
    before = rmse(replace(found.task, scene=raw), found.model, raw.sealed_rows)
    after = rmse(found.task, found.model, found.task.scene.sealed_rows)
    gain = Gain(before, after, float('nan'))
    out = []
    for name in dict.fromkeys(f.name for f in wrong):
        mine = [f for f in wrong if f.name == name]
        parameters = {k: v for f in mine for k, v in _fault_parameters(f).items()}
        out.append(NamedCause(name, ' '.join(f.sentence for f in mine), parameters, gain))
    return tuple(out)


def _fault_parameters(fault: Fault) -> dict[str, Estimate]:
    unknown = float('nan')
    unit = 's' if fault.name == 'flatline' else fault.signal.unit
    return {
        f'{fault.signal.topic}_rows': Estimate(float(fault.rows), unknown, unknown, 'rows'),
        f'{fault.signal.topic}_size': Estimate(fault.size, unknown, unknown, unit),
    }


def notes(scene: Scene) -> tuple[str, ...]:
    """Say what could not be judged for want of a command."""
    why = actuator.hindered(scene)
    if not why:
        return ()
    return (f'Faults between command and position sensor cannot be judged: {why}.',)
