"""The judgement of a shift as JSON: what ``shift.json`` holds."""

from __future__ import annotations

import math
from typing import Any

from valveflow_ros.curve.shift import PieceShift, Shift

FORMAT = 'valveflow/shift'
VERSION = 1


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _piece_json(piece: PieceShift) -> dict[str, Any]:
    return {
        'u_from': _number(piece.u_from),
        'u_to': _number(piece.u_to),
        'moved': piece.moved,
        'shift_mw': _number(piece.shift_mw),
        'shift_percent': _number(piece.percent),
        'confidence': _number(piece.confidence),
        'p_value': _number(piece.p_value),
        'middle_mw': _number(piece.middle_mw),
        'middle_stderr_mw': _number(piece.error_mw),
        'low_mw': _number(piece.low_mw),
        'high_mw': _number(piece.high_mw),
        'now_mw': _number(piece.now_mw),
        'now_stderr_mw': _number(piece.now_error_mw),
        'flow_mw': _number(piece.flow_mw),
        'smallest_seen_mw': _number(piece.smallest_mw),
    }


def shift_json(shift: Shift) -> dict[str, Any]:
    """Return the content of ``shift.json``; what is not known is null."""
    return {
        'format': FORMAT,
        'version': VERSION,
        'reference_model_id': shift.reference_id,
        'model_id': shift.model_id,
        'reference_end_ns': shift.reference_ns,
        'moved': shift.moved,
        'sentence': shift.sentence,
        'since_ns': shift.since_ns or None,
        'since_low_ns': shift.since_low_ns or None,
        'since_high_ns': shift.since_high_ns or None,
        'judged_from_ns': shift.first_ns or None,
        'pieces': [_piece_json(piece) for piece in shift.pieces],
    }
