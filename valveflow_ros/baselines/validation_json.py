"""A validation as JSON: what ``validation.json`` holds."""

from __future__ import annotations

from typing import Any

from valveflow_ros.baselines.comparison_json import number, paired_json, segment_json, total_json
from valveflow_ros.baselines.validation import PieceCheck, Validation

FORMAT = 'valveflow/validation'
VERSION = 1


def _check_json(check: PieceCheck) -> dict[str, Any]:
    return {
        'u_from': check.u_from,
        'u_to': check.u_to,
        'segments': check.segments,
        'samples': check.samples,
        'mean_difference_mw': paired_json(check.test),
        'interval_mw': [number(check.low_mw), number(check.high_mw)],
    }


def to_json(v: Validation) -> dict[str, Any]:
    """Return the content of ``validation.json``, without the words."""
    j = v.judgement
    return {
        'format': FORMAT,
        'version': VERSION,
        'model_id': v.characteristic.model_id,
        'pressure_exponent': v.characteristic.pressure_exponent,
        'against_model_id': None if v.against is None else v.against.model_id,
        'verdict': v.verdict.value,
        'judged_by': v.judged_by,
        'tolerance_mw': v.tolerance_mw,
        'overall': _check_json(v.overall),
        'pieces': [_check_json(c) for c in v.pieces],
        'totals': {name: total_json(j, name) for name in v.predictions},
        'gain_over_against_mw2': None if v.gain is None else paired_json(v.gain),
        'outside_share': v.outside_share,
        'judged': {
            'segments': len(j.segments),
            'samples': j.samples,
            'samples_not_judged': j.outside,
            'samples_per_independent_value': j.widening,
        },
        'segments': [segment_json(s) for s in j.segments],
    }
