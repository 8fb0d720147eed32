"""Does a characteristic hold on other data? Judged on their special segments."""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from valveflow_ros.baselines.comparison import number, paired_json, segment_json, total_json
from valveflow_ros.baselines.judged import (
    JudgedSegment,
    Judgement,
    OtherData,
    PairedTest,
    Trial,
    dynamic,
    judge,
    trial_of,
)
from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.errors import DataError
from valveflow_ros.records import FloatArray

CURVE, SIMULATED = 'curve', 'simulated'
OTHER = 'against.'
_LEVEL = 0.05


class Verdict(enum.Enum):
    """What the data say of the curve."""

    HOLDS = 'holds'
    OFF = 'off'
    OPEN = 'open'


@dataclass(frozen=True, slots=True)
class PieceCheck:
    """The mean of measured minus predicted power on one piece of the curve.

    Attributes
    ----------
    u_from, u_to : float
    segments, samples : int
    test : PairedTest
        Over segments, allowing for correlation between them.
    low_mw, high_mw : float
        In which the mean lies with 95 % confidence, all pieces together; NaN if not known.
    """

    u_from: float
    u_to: float
    segments: int
    samples: int
    test: PairedTest
    low_mw: float
    high_mw: float


@dataclass(frozen=True, slots=True)
class Validation:
    """What came out.

    Attributes
    ----------
    characteristic : Characteristic
    against : Characteristic or None
    judged_by : str
        The prediction the verdict stands on: the simulation where the dynamics are known,
        else the curve.
    tolerance_mw : float
    trial : Trial
    predictions : mapping of float64 (n,)
    judgement : Judgement
    outside_share : float
        Share of the special samples whose u the curve is not known for.
    overall : PieceCheck
    pieces : tuple of PieceCheck
    verdict : Verdict
    gain : PairedTest or None
        Squared error of ``against`` less that of this one, MW^2.
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


def validate(
    characteristic: Characteristic,
    other: OtherData,
    tolerance_mw: float,
    against: Characteristic | None = None,
) -> Validation:
    """Hold a characteristic against data it has not seen.

    Parameters
    ----------
    characteristic : Characteristic
    other : OtherData
    tolerance_mw : float
        A mean difference that does not matter.
    against : Characteristic, optional
        Another curve, to see which is better.

    Raises
    ------
    DataError
        No special segment can be judged, or the two curves are over different inputs.
    """
    trial = trial_of(other, characteristic)
    outside = _outside(trial, characteristic)
    predictions = _predictions(characteristic, other, trial)
    if against is not None:
        _same_input(characteristic, against)
        trial = replace(trial, good=trial.good & trial_of(other, against).good)
        theirs = _predictions(against, other, trial)
        predictions |= {OTHER + name: values for name, values in theirs.items()}
    judgement = judge(trial, predictions)
    by = SIMULATED if SIMULATED in predictions else CURVE
    checks = _checks(characteristic, trial, judgement, by)
    gain = None
    if against is not None:
        theirs_by = OTHER + (SIMULATED if OTHER + SIMULATED in predictions else CURVE)
        gain = judgement.gain(by, theirs_by)
    return Validation(
        characteristic, against, by, tolerance_mw, trial, predictions, judgement, outside,
        checks[0], checks[1:], _verdict(checks, tolerance_mw), gain,
    )  # fmt: skip


def _predictions(
    characteristic: Characteristic, other: OtherData, trial: Trial
) -> dict[str, FloatArray]:
    found = {CURVE: characteristic.model.static(trial.u)}
    if characteristic.dynamics:
        found[SIMULATED] = dynamic(characteristic, other.samples)
    return found


def _same_input(ours: Characteristic, theirs: Characteristic) -> None:
    if abs(ours.pressure_exponent - theirs.pressure_exponent) > 1e-9:
        raise DataError(
            f'The two characteristics are curves over different inputs, V p^'
            f'{ours.pressure_exponent:g} and V p^{theirs.pressure_exponent:g}: they cannot be '
            'held against each other.'
        )


def _outside(trial: Trial, characteristic: Characteristic) -> float:
    """Return the share of special samples beyond the ends of the curve."""
    if not len(trial.spans):
        return 0.0
    u = np.concatenate([trial.u[a:b] for a, b, _ in trial.spans])
    low, high = characteristic.breakpoints[0], characteristic.breakpoints[-1]
    return float(np.mean((u < low) | (u > high)))


def _checks(
    characteristic: Characteristic, trial: Trial, judgement: Judgement, by: str
) -> tuple[PieceCheck, ...]:
    """Return the check over everything, then one for each piece."""
    knots = characteristic.breakpoints
    level = _LEVEL / len(characteristic.pieces)
    middle = [float(trial.u[s.rows].mean()) for s in judgement.segments]
    piece = np.clip(np.searchsorted(knots, middle, side='right') - 1, 0, len(knots) - 2)
    found = [_check(float(knots[0]), float(knots[-1]), judgement.segments, by, judgement, _LEVEL)]
    for k in range(len(knots) - 1):
        mine = tuple(s for s, p in zip(judgement.segments, piece, strict=True) if p == k)
        ends = float(knots[k]), float(knots[k + 1])
        found.append(_check(*ends, mine, by, judgement, level))
    return tuple(found)


def _check(
    u_from: float, u_to: float, segments: tuple[JudgedSegment, ...], by: str,
    judgement: Judgement, level: float,
) -> PieceCheck:  # fmt: skip
    test = replace(judgement, segments=segments).bias(by)
    samples = sum(len(s.rows) for s in segments)
    return PieceCheck(u_from, u_to, len(segments), samples, test, *test.interval(level))


def _verdict(checks: tuple[PieceCheck, ...], tolerance_mw: float) -> Verdict:
    """Off where a mean is surely beyond the tolerance, holding where all are surely within it.

    A piece without segments says nothing, and does not hinder; one with a single segment, or
    whose interval reaches beyond the tolerance, leaves it open.
    """
    seen = [c for c in checks if c.segments]
    if any(c.low_mw > tolerance_mw or c.high_mw < -tolerance_mw for c in seen):
        return Verdict.OFF
    within = all(-tolerance_mw <= c.low_mw and c.high_mw <= tolerance_mw for c in seen)
    return Verdict.HOLDS if within else Verdict.OPEN


# A validation as JSON: what ``validation.json`` holds.

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
