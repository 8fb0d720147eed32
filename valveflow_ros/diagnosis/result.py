"""The diagnosis as a record: verdict, causes, proof."""

from __future__ import annotations

import dataclasses
import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from valveflow_ros.curve.json_field import Field
from valveflow_ros.curve.regional_model import RegionalModel
from valveflow_ros.diagnosis.cause import Active, Estimate
from valveflow_ros.diagnosis.causes import catalogue
from valveflow_ros.diagnosis.evidence import Gain, SegmentGain
from valveflow_ros.diagnosis.extended import Extended, ExtendedModel
from valveflow_ros.diagnosis.scene import Reference
from valveflow_ros.errors import DataError
from valveflow_ros.records import FloatArray

NAMED, NOTHING, UNEXPLAINED = 'named', 'nothing', 'unexplained'


@dataclass(frozen=True, slots=True)
class NamedCause:
    """A cause with its parameters and what it is worth on sealed blocks."""

    name: str
    sentence: str
    parameters: dict[str, Estimate]
    gain: Gain
    experiment: str = ''
    not_told_apart: tuple[str, ...] = ()
    switches_s: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class Disturbance:
    """A slow wander that is no cause."""

    rms_mw: float
    time_scale_s: float


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """What the simulation gets wrong, why, and what the extended model is worth.

    Attributes
    ----------
    verdict : str
        'named', 'nothing' or 'unexplained'.
    sentence : str
        For an operator.
    causes : tuple of NamedCause
        In the order found; faults of the record come last.
    not_told_apart : tuple of str
        Causes these data cannot tell from the ones named.
    experiments : tuple of str
        What would tell them apart.
    disturbance : Disturbance or None
    unexplained_by : tuple of str
    rejected : tuple of (name, reason)
    rmse_simulation, rmse_extended, rmse_noise_floor : float
        MW, on sealed blocks.
    segments : tuple of SegmentGain
    simulation, extended : Extended
        Without and with causes, fitted to the open blocks.
    final : Extended
        With causes, fitted to everything: the model to go on with.
    reference : Reference
        What its causes count from.
    notes : tuple of str
    """

    verdict: str
    sentence: str
    causes: tuple[NamedCause, ...]
    not_told_apart: tuple[str, ...]
    experiments: tuple[str, ...]
    disturbance: Disturbance | None
    unexplained_by: tuple[str, ...]
    rejected: tuple[tuple[str, str], ...]
    rmse_simulation: float
    rmse_extended: float
    rmse_noise_floor: float
    segments: tuple[SegmentGain, ...]
    simulation: Extended
    extended: Extended
    final: Extended
    reference: Reference
    notes: tuple[str, ...] = ()


# The extended model as JSON: what ``extended_model.json`` holds, and what is believed of one.

MODEL_FORMAT, MODEL_VERSION = 'valveflow/extended_model', 1
_MOST_MODELS = 10  # on top of one another
_LONGEST_DELAY_S, _LONGEST_S = 600.0, 3600.0


def model_to_json(given: ExtendedModel) -> dict[str, Any]:
    """Return the content of ``extended_model.json``."""
    m = given.model.base
    earlier = given.on_top_of
    return {
        'format': MODEL_FORMAT,
        'version': MODEL_VERSION,
        'pressure_exponent': given.pressure_exponent,
        'start_ns': given.start_ns,
        'reference': dataclasses.asdict(given.reference),
        'curve': {'knots': m.knots.tolist(), 'left': m.left.tolist(), 'right': m.right.tolist()},
        'dynamics': {
            'levels': m.levels.tolist(), 'time_constants_s': m.time_constants.tolist(),
            'delays_s': m.delays.tolist(),
        },
        'causes': [
            {'name': a.name, 'values': a.named(), 'switches_s': list(a.extra)}
            for a in given.model.active
        ],
        **({} if earlier is None else {'on_top_of': model_to_json(earlier)}),
    }  # fmt: skip


def is_model(raw: object) -> bool:
    """Tell whether JSON says of itself that it is an extended model."""
    return isinstance(raw, dict) and raw.get('format') == MODEL_FORMAT


def model_from_json(raw: object, depth: int = 0) -> ExtendedModel:
    """Read ``extended_model.json``.

    Raises
    ------
    DataError
        It is none, or not one this version can use; the sentence names the place.
    """
    if not isinstance(raw, dict) or not is_model(raw):
        raise DataError(f"This is no extended model: 'format' must be '{MODEL_FORMAT}'.")
    if raw.get('version') is not MODEL_VERSION:
        raise DataError(
            f'The extended model has version {raw.get("version")}, '
            f'this program reads {MODEL_VERSION}.'
        )
    top = Field(raw, '', 'extended model')
    if depth >= _MOST_MODELS:
        raise top.key('on_top_of').fail(f'lies more than {_MOST_MODELS} models deep')
    earlier = model_from_json(raw['on_top_of'], depth + 1) if 'on_top_of' in raw else None
    given = ExtendedModel(
        Extended(_base(top), _causes(top.key('causes'))),
        top.key('pressure_exponent').real(0.5, 2.0), top.key('start_ns').whole(),
        _reference(top.key('reference')), earlier,
    )  # fmt: skip
    if earlier is not None and earlier.pressure_exponent != given.pressure_exponent:
        raise top.key('on_top_of').fail('is a model over another input u')
    return given


def _numbers(field: Field, low: float = -np.inf, high: float = np.inf) -> FloatArray:
    return np.array([f.real(low, high) for f in field.items()], dtype=np.float64)


def _base(top: Field) -> RegionalModel:
    """Read curve and dynamics, and refuse what could not be run."""
    curve, dynamics = top.key('curve'), top.key('dynamics')
    knots, left, right = (_numbers(curve.key(k)) for k in ('knots', 'left', 'right'))
    if not len(left) == len(right) == len(knots) - 1 >= 1:
        raise curve.fail('must have one knot more than values at left and right ends')
    if not np.all(np.diff(knots) > 0.0):
        raise curve.key('knots').fail('do not rise')
    levels = _numbers(dynamics.key('levels'))
    times = _numbers(dynamics.key('time_constants_s'), 1e-6, _LONGEST_S)
    delays = _numbers(dynamics.key('delays_s'), 0.0, _LONGEST_DELAY_S)
    if not len(times) == len(delays) == len(levels) + 1:
        raise dynamics.fail('must have one level less than time constants and delays')
    if not np.all(np.diff(levels) > 0.0):
        raise dynamics.key('levels').fail('do not rise')
    return RegionalModel(knots, left, right, levels, times, delays)


def _reference(field: Field) -> Reference:
    """Read what causes count from; the noise of the opening may be missing."""
    span, level = field.key('span_s'), field.key('pressure_level')
    noise = field.may_have('opening_noise')
    return Reference(
        span.real(1.0), field.key('temperature_degc').real(), field.key('log_pressure').real(),
        level.real(), field.key('pressure_slope').real(), noise.real(0.0) if noise else 0.0,
    )  # fmt: skip


def _causes(field: Field) -> tuple[Active, ...]:
    found = tuple(_cause(f) for f in field.items())
    names = [a.name for a in found]
    if len(set(names)) < len(names):
        raise field.fail('names a cause twice')
    return found


def _cause(field: Field) -> Active:
    name = field.key('name').text()
    cause = catalogue().get(name)
    if cause is None:
        raise field.key('name').fail('is no cause of the catalogue')
    values = field.key('values')
    numbers = tuple(values.key(u.name).real(u.low, u.high) for u in cause.unknowns)
    switches = tuple(_numbers(field.key('switches_s')).tolist())
    if any(b <= a for a, b in itertools.pairwise(switches)):
        raise field.key('switches_s').fail('do not rise')
    return Active(cause, numbers, switches)


# The diagnosis as JSON: ``diagnosis.json``.

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
