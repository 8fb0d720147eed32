# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Validation of a characteristic on the special segments of other data."""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from valveflow_ros.baselines.comparison import fields_json, judged_json, totals_json
from valveflow_ros.baselines.judged import (
    Judgement,
    OtherData,
    PairedTest,
    Trial,
    dynamic,
    judge,
    trial_of,
)
from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.curve.characteristic_json import number
from valveflow_ros.fit.model_form import Misfit, find_misfit
from valveflow_ros.records import FloatArray
from valveflow_ros.signals.static_form import pressure_of

CURVE, SIMULATED = 'curve', 'simulated'
OTHER = 'against.'
_LEVEL = 0.05

FORMAT = 'valveflow/validation'
VERSION = 1


class Verdict(enum.Enum):
    """The result of a validation."""

    HOLDS = 'holds'
    OFF = 'off'
    OPEN = 'open'


@dataclass(frozen=True, slots=True)
class PieceCheck:
    """The mean of measured minus predicted power on one piece of the curve.

    The test is over segments, allowing for correlation between them. The interval of the mean is
    that at 95 % confidence for all pieces together; NaN if unknown.
    """

    u_from: float
    u_to: float
    segments: int
    samples: int
    test: PairedTest
    low_mw: float
    high_mw: float

    def within(self, tolerance_mw: float) -> bool:
        """Return True if the interval of the mean is within the tolerance."""
        return -tolerance_mw <= self.low_mw and self.high_mw <= tolerance_mw

    def beyond(self, tolerance_mw: float) -> bool:
        """Return True if the interval of the mean is outside the tolerance."""
        return self.low_mw > tolerance_mw or self.high_mw < -tolerance_mw


@dataclass(frozen=True, slots=True)
class Validation:
    """The data and results of a validation.

    Attributes
    ----------
    judged_by : str
        The prediction used for the verdict: the simulation if the dynamics are known,
        else the curve.
    outside_share : float
        Fraction of the special samples with u outside the range of the curve.
    misfit : Misfit or None
        The error of the curve that repeats at the same openings and pressures.
    gain : PairedTest or None
        Squared error of ``against`` minus that of this curve, MW^2.
    """

    characteristic: Characteristic
    against: Characteristic | None
    judged_by: str
    tolerance_mw: float
    trial: Trial
    predictions: Mapping[str, FloatArray]
    judgement: Judgement
    outside_share: float
    overall: PieceCheck
    pieces: tuple[PieceCheck, ...]
    verdict: Verdict
    gain: PairedTest | None
    misfit: Misfit | None = None

    @property
    def misfit_beyond(self) -> Misfit | None:
        """Return the misfit if it exceeds the tolerance."""
        return self.misfit if self.misfit and self.misfit.rms_mw > self.tolerance_mw else None


def validate(
    characteristic: Characteristic, other: OtherData, tolerance_mw: float,
    against: Characteristic | None = None,
) -> Validation:  # fmt: skip
    """Compare a characteristic with data that were not used to fit it.

    Parameters
    ----------
    tolerance_mw : float
        A mean difference below this is ignored.
    against : Characteristic, optional
        Another curve; the result says which is better.

    Raises
    ------
    DataError
        No special segment can be used, or the two curves have different inputs.
    """
    data = other.on_axis(characteristic.static_form)
    trial = trial_of(data, characteristic)
    outside = _outside(trial, characteristic)
    predictions = _predictions(characteristic, data, trial)
    by = SIMULATED if SIMULATED in predictions else CURVE
    theirs: dict[str, FloatArray] = {}
    if against is not None:
        theirs_data = other.on_axis(against.static_form)
        theirs_trial = trial_of(theirs_data, against)
        trial = replace(trial, good=trial.good & theirs_trial.good)
        theirs = _predictions(against, theirs_data, theirs_trial)
        predictions |= {OTHER + name: values for name, values in theirs.items()}
    judgement = judge(trial, predictions)
    checks = _checks(characteristic, trial, judgement, by)
    theirs_by = OTHER + (SIMULATED if SIMULATED in theirs else CURVE)
    gain = judgement.gain(by, theirs_by) if theirs else None
    found = Validation(
        characteristic, against, by, tolerance_mw, trial, predictions, judgement, outside,
        checks[0], checks[1:], _verdict(checks, tolerance_mw), gain,
        _misfit(other, trial, predictions[CURVE]),
    )  # fmt: skip
    return replace(found, verdict=Verdict.OFF) if found.misfit_beyond else found


def _misfit(other: OtherData, trial: Trial, predicted: FloatArray) -> Misfit | None:
    """Return the repeated error of the static curve; None if the openings are unknown."""
    opening = other.opening_percent
    if opening is None:
        return None
    pressure = pressure_of(other.samples.u, opening, other.exponent)
    power = np.where(trial.good, trial.power_mw, np.nan)
    return find_misfit(
        opening, pressure, power - predicted, power, trial.spans[:, :2], trial.step_s
    )


def _predictions(
    characteristic: Characteristic, other: OtherData, trial: Trial
) -> dict[str, FloatArray]:
    scale = 1.0 if other.samples.scale is None else other.samples.scale
    found = {CURVE: characteristic.model.static(trial.u, scale)}
    if characteristic.dynamics:
        found[SIMULATED] = dynamic(characteristic, other.samples)
    return found


def _outside(trial: Trial, characteristic: Characteristic) -> float:
    """Return the fraction of special samples beyond the ends of the curve."""
    if not len(trial.spans):
        return 0.0
    u = np.concatenate([trial.u[a:b] for a, b, _ in trial.spans])
    low, high = characteristic.breakpoints[0], characteristic.breakpoints[-1]
    return float(np.mean((u < low) | (u > high)))


def _checks(
    characteristic: Characteristic, trial: Trial, judgement: Judgement, by: str
) -> tuple[PieceCheck, ...]:
    """Return the check over all data, and one for each piece."""
    knots = characteristic.breakpoints
    last = len(knots) - 1
    middle = [float(trial.u[s.rows].mean()) for s in judgement.segments]
    piece = np.clip(np.searchsorted(knots, middle, side='right') - 1, 0, last - 1)
    found: list[PieceCheck] = []
    for first, end in ((0, last), *((k, k + 1) for k in range(last))):
        whole = not found
        mine = tuple(
            s for s, p in zip(judgement.segments, piece, strict=True) if whole or p == first
        )
        test = replace(judgement, segments=mine).bias(by)
        # The confidence level is that of all pieces together.
        low, high = test.interval(_LEVEL if whole else _LEVEL / last)
        samples = sum(len(s.rows) for s in mine)
        found.append(PieceCheck(
            float(knots[first]), float(knots[end]), len(mine), samples, test, low, high
        ))  # fmt: skip
    return tuple(found)


def _verdict(checks: tuple[PieceCheck, ...], tolerance_mw: float) -> Verdict:
    """Return the verdict: off if a mean is outside the tolerance, holds if all are within it.

    A piece without segments is ignored. A piece with a single segment, or with an interval
    that crosses the tolerance, leaves the verdict open.
    """
    seen = [c for c in checks if c.segments]
    if any(c.beyond(tolerance_mw) for c in seen):
        return Verdict.OFF
    return Verdict.HOLDS if all(c.within(tolerance_mw) for c in seen) else Verdict.OPEN


def to_json(v: Validation) -> dict[str, Any]:
    """Return the content of ``validation.json``, without the texts."""
    overall, *pieces = (
        {
            'u_from': c.u_from,
            'u_to': c.u_to,
            'segments': c.segments,
            'samples': c.samples,
            'mean_difference_mw': fields_json(c.test),
            'interval_mw': [number(c.low_mw), number(c.high_mw)],
        }
        for c in (v.overall, *v.pieces)
    )
    return {
        'format': FORMAT,
        'version': VERSION,
        'model_id': v.characteristic.model_id,
        'pressure_exponent': v.characteristic.pressure_exponent,
        'against_model_id': None if v.against is None else v.against.model_id,
        'verdict': v.verdict.value,
        'judged_by': v.judged_by,
        'tolerance_mw': v.tolerance_mw,
        'overall': overall,
        'misfit': None if v.misfit is None else dataclasses.asdict(v.misfit),
        'pieces': pieces,
        'totals': totals_json(v.judgement, v.predictions),
        'gain_over_against_mw2': None if v.gain is None else fields_json(v.gain),
        'outside_share': v.outside_share,
        **judged_json(v.judgement),
    }
