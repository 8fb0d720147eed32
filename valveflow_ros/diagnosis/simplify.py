"""The plain simulation: few distinct pieces.

A curve found by prediction error has as many knees as pay. A shallow one is no valve point
but part of a shape, and would hide `curve_shape` inside the model.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from valveflow_ros.curve.model import RegionalModel

SHALLOW = 0.2  # change of slope relative to the larger one
_JUMP_MW = 0.01


def simplified(model: RegionalModel) -> RegionalModel:
    """Return the curve without its shallow knees, the shallowest first; jumps stay."""
    while model.pieces > 1:
        slopes = model.slopes()
        larger = np.maximum(np.abs(slopes[1:]), np.abs(slopes[:-1]))
        bend = np.abs(np.diff(slopes)) / np.maximum(larger, 1e-12)
        bend[np.abs(model.left[1:] - model.right[:-1]) > _JUMP_MW] = np.inf
        weakest = int(np.argmin(bend))
        if bend[weakest] >= SHALLOW:
            return model
        model = without_knot(model, weakest + 1)
    return model


def without_knot(model: RegionalModel, knot: int) -> RegionalModel:
    """Return the curve with the two pieces at an inner knot made one."""
    return replace(
        model,
        knots=np.delete(model.knots, knot),
        left=np.delete(model.left, knot),
        right=np.delete(model.right, knot - 1),
    )
