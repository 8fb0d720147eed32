"""The extended model as JSON: what ``extended_model.json`` holds, and what is believed of one."""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any

import numpy as np

from valveflow_ros.curve.json_field import Field
from valveflow_ros.curve.model import RegionalModel
from valveflow_ros.diagnosis.cause import Active
from valveflow_ros.diagnosis.causes import catalogue
from valveflow_ros.diagnosis.extended import Extended
from valveflow_ros.diagnosis.extended_model import ExtendedModel
from valveflow_ros.diagnosis.scene import Reference
from valveflow_ros.errors import DataError
from valveflow_ros.records import FloatArray

FORMAT, VERSION = 'valveflow/extended_model', 1
_MOST_MODELS = 10  # on top of one another
_LONGEST_DELAY_S, _LONGEST_S = 600.0, 3600.0


def to_json(given: ExtendedModel) -> dict[str, Any]:
    """Return the content of ``extended_model.json``."""
    m = given.model.base
    earlier = given.on_top_of
    return {
        'format': FORMAT,
        'version': VERSION,
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
        **({} if earlier is None else {'on_top_of': to_json(earlier)}),
    }  # fmt: skip


def is_model(raw: object) -> bool:
    """Tell whether JSON says of itself that it is an extended model."""
    return isinstance(raw, dict) and raw.get('format') == FORMAT


def from_json(raw: object, depth: int = 0) -> ExtendedModel:
    """Read ``extended_model.json``.

    Raises
    ------
    DataError
        It is none, or not one this version can use; the sentence names the place.
    """
    if not isinstance(raw, dict) or not is_model(raw):
        raise DataError(f"This is no extended model: 'format' must be '{FORMAT}'.")
    if raw.get('version') is not VERSION:
        raise DataError(
            f'The extended model has version {raw.get("version")}, this program reads {VERSION}.'
        )
    top = Field(raw, '', 'extended model')
    if depth >= _MOST_MODELS:
        raise top.key('on_top_of').fail(f'lies more than {_MOST_MODELS} models deep')
    earlier = from_json(raw['on_top_of'], depth + 1) if 'on_top_of' in raw else None
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


def model_json(
    model: Extended, pressure_exponent: float, start_ns: int, reference: Reference,
    on_top_of: ExtendedModel | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Return the content of ``extended_model.json`` from its parts.

    ``start_ns`` is the time that drifts and onsets count from.
    """
    return to_json(ExtendedModel(model, pressure_exponent, start_ns, reference, on_top_of))


def model_from_json(raw: object) -> tuple[Extended, float, int, Reference]:
    """Read ``extended_model.json``; return model, pressure exponent, the time of its zero, means.

    Raises
    ------
    DataError
        It is none, or not one this version can use.
    """
    given = from_json(raw)
    return given.model, given.pressure_exponent, given.start_ns, given.reference
