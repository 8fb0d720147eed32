"""The diagnosis as JSON: ``diagnosis.json``."""

from __future__ import annotations

import math
from typing import Any

from valveflow_ros.diagnosis.model_json import model_from_json, model_json
from valveflow_ros.diagnosis.result import Diagnosis, NamedCause

__all__ = ['model_from_json', 'model_json', 'to_json']

FORMAT, VERSION = 'valveflow/diagnosis', 1


def _number(value: float) -> float | None:
    """JSON has neither NaN nor infinity: absent is null."""
    return float(value) if math.isfinite(value) else None


def cause_json(c: NamedCause) -> dict[str, Any]:
    """Return a cause; its parameters stay numbers, a time says what it counts from."""
    return {
        'name': c.name,
        'sentence': c.sentence,
        'parameters': {
            key: {
                'value': _number(e.value), 'low': _number(e.low), 'high': _number(e.high),
                'unit': e.full_unit, **({} if e.origin_ns is None else {'origin_ns': e.origin_ns}),
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
        'causes': [cause_json(c) for c in d.causes],
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
