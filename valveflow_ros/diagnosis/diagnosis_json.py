"""The diagnosis and the extended model as JSON: ``diagnosis.json``, ``extended_model.json``."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from valveflow_ros.core.model import RegionalModel
from valveflow_ros.diagnosis.catalogue import catalogue
from valveflow_ros.diagnosis.cause import Active
from valveflow_ros.diagnosis.extended import Extended
from valveflow_ros.diagnosis.result import Diagnosis, NamedCause
from valveflow_ros.diagnosis.scene import Reference
from valveflow_ros.errors import DataError

FORMAT, VERSION = 'valveflow/diagnosis', 1
MODEL_FORMAT, MODEL_VERSION = 'valveflow/extended_model', 1


def _number(value: float) -> float | None:
    """JSON has neither NaN nor infinity: absent is null."""
    return float(value) if math.isfinite(value) else None


def _cause(c: NamedCause) -> dict[str, Any]:
    return {
        'name': c.name,
        'sentence': c.sentence,
        'parameters': {
            key: {
                'value': _number(e.value), 'low': _number(e.low), 'high': _number(e.high),
                'unit': e.unit,
            }
            for key, e in c.parameters.items()
        },
        'gain': {
            'rmse_before': _number(c.gain.rmse_before),
            'rmse_after': _number(c.gain.rmse_after),
            'reduction': _number(c.gain.reduction),
            'p_value': _number(c.gain.p_value),
        },
        'experiment': c.experiment,
        'not_told_apart': list(c.not_told_apart),
    }  # fmt: skip


def to_json(d: Diagnosis) -> dict[str, Any]:
    """Return the content of ``diagnosis.json``."""
    return {
        'format': FORMAT,
        'version': VERSION,
        'verdict': d.verdict,
        'sentence': d.sentence,
        'causes': [_cause(c) for c in d.causes],
        'not_told_apart': list(d.not_told_apart),
        'experiments': list(d.experiments),
        'disturbance': {
            'rms_mw': d.disturbance.rms_mw, 'time_scale_s': d.disturbance.time_scale_s,
        }
        if d.disturbance
        else None,
        'unexplained_by': list(d.unexplained_by),
        'rejected': [{'name': name, 'reason': reason} for name, reason in d.rejected],
        'rmse_simulation': _number(d.rmse_simulation),
        'rmse_extended': _number(d.rmse_extended),
        'rmse_noise_floor': _number(d.rmse_noise_floor),
        'segments': [
            {
                'number': s.number, 'start_ns': s.start_ns, 'end_ns': s.end_ns,
                'rmse_before': s.rmse_before, 'rmse_after': s.rmse_after,
            }
            for s in d.segments
        ],
        'notes': list(d.notes),
    }  # fmt: skip


def model_json(
    model: Extended, pressure_exponent: float, start_ns: int, reference: Reference
) -> dict[str, Any]:
    """Return the content of ``extended_model.json``.

    ``start_ns`` is the time that drifts and onsets count from.
    """
    m = model.base
    return {
        'format': MODEL_FORMAT,
        'version': MODEL_VERSION,
        'pressure_exponent': pressure_exponent,
        'start_ns': start_ns,
        'reference': dataclasses.asdict(reference),
        'curve': {'knots': m.knots.tolist(), 'left': m.left.tolist(), 'right': m.right.tolist()},
        'dynamics': {
            'levels': m.levels.tolist(), 'time_constants_s': m.time_constants.tolist(),
            'delays_s': m.delays.tolist(),
        },
        'causes': [
            {'name': a.name, 'values': a.named(), 'switches_s': list(a.extra)}
            for a in model.active
        ],
    }  # fmt: skip


def model_from_json(raw: object) -> tuple[Extended, float, int, Reference]:
    """Read ``extended_model.json``; return model, pressure exponent, the time of its zero, means.

    Raises
    ------
    DataError
        It is none, or not one this version knows.
    """
    if not isinstance(raw, dict) or raw.get('format') != MODEL_FORMAT:
        raise DataError(f"This is no extended model: 'format' must be '{MODEL_FORMAT}'.")
    if raw.get('version') != MODEL_VERSION:
        raise DataError(
            f'The extended model has version {raw.get("version")}, this program reads '
            f'{MODEL_VERSION}.'
        )
    try:
        curve, dynamics = raw['curve'], raw['dynamics']
        numbers = [
            np.array([float(x) for x in part])
            for part in (
                curve['knots'], curve['left'], curve['right'], dynamics['levels'],
                dynamics['time_constants_s'], dynamics['delays_s'],
            )
        ]  # fmt: skip
        active = tuple(_active(c) for c in raw['causes'])
        return (
            Extended(RegionalModel(*numbers), active), float(raw['pressure_exponent']),
            int(raw['start_ns']), Reference(**raw['reference']),
        )  # fmt: skip
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f'The extended model cannot be used: {error!r}.') from None


def _active(raw: dict[str, Any]) -> Active:
    cause = catalogue()[raw['name']]
    values = tuple(float(raw['values'][u.name]) for u in cause.unknowns)
    return Active(cause, values, tuple(float(s) for s in raw['switches_s']))
