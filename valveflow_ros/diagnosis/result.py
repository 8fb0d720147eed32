# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The diagnosis as a record: verdict, causes, evidence."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from valveflow_ros.curve.characteristic_json import OUTPUT_UNIT, form_of
from valveflow_ros.curve.json_schema import (
    DEGC,
    MOST_PIECES,
    MW,
    NS,
    Count,
    ListOf,
    Maybe,
    Members,
    Number,
    Text,
    U,
    checked,
    fail,
)
from valveflow_ros.curve.regional_model import RegionalModel
from valveflow_ros.diagnosis.cause import Estimate, FittedCause
from valveflow_ros.diagnosis.causes import TO_DO, catalogue
from valveflow_ros.diagnosis.causes.covariate import covariate_cause
from valveflow_ros.diagnosis.evidence import Gain, SegmentGain
from valveflow_ros.diagnosis.extended import Extended, ExtendedModel
from valveflow_ros.diagnosis.grids import COEFFICIENTS, COURSE, MEAN_S, Covariate, Reference
from valveflow_ros.errors import DataError
from valveflow_ros.signals.static_form import AXES, OPENING, StaticForm
from valveflow_ros.signals.units import in_unit

NAMED, NOTHING, UNEXPLAINED = 'named', 'nothing', 'unexplained'


@dataclass(frozen=True, slots=True)
class NamedCause:
    """A cause with its parameters and its gain on the sealed (test) blocks.

    ``meaning`` gives the effect in MW at full load; empty if unknown.
    """

    name: str
    sentence: str
    parameters: dict[str, Estimate]
    gain: Gain
    experiment: str = ''
    not_told_apart: tuple[str, ...] = ()
    switches_s: tuple[float, ...] = ()
    meaning: str = ''

    @property
    def to_do(self) -> str:
        """Return the action for the operator; empty for a covariate."""
        told = TO_DO.get(self.name, '')
        for name, e in self.parameters.items():
            told = told.replace(f'`{name}`', f'{name} = {e.value:.4g} {e.unit}'.rstrip())
        return told.replace('`', '')


@dataclass(frozen=True, slots=True)
class Disturbance:
    """A slow disturbance of the power that is not a cause.

    Attributes
    ----------
    rms_mw, time_scale_s : float
        Its root mean square and its time scale.
    drift_mw : float or None
        Root mean square about its mean over the record, for a disturbance over many hours
        and days; see `slow.drift`.
    shape : str
        Description of the shape of the change in time, if it has one; see `slow.courses`.
    """

    rms_mw: float
    time_scale_s: float
    drift_mw: float | None = None
    shape: str = ''

    @property
    def sentence(self) -> str:
        """Return it as a sentence for an operator."""
        hours = self.time_scale_s / 3600.0
        if self.shape:
            return (
                f'The power changes in time (mean over the loads seen): {self.shape}. Which cause '
                'makes it is not known.'
            )
        if self.drift_mw is not None:
            length = 'days' if hours >= _DAYS_FROM_H else 'hours'
            return (
                f'The power varies slowly over {length}, by about {self.drift_mw:.2g} MW on '
                'average, for a reason that these signals do not show.'
            )
        return (
            f'The power varies slowly, by about {self.rms_mw:.2g} MW on average '
            f'over {hours:.2g} h, for a reason that these signals do not show.'
        )


_DAYS_FROM_H = 8.0  # a disturbance with a longer memory continues from day to day


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """The errors of the simulation, their causes and the gain of the extended model.

    Attributes
    ----------
    verdict : str
        'named', 'nothing' or 'unexplained'.
    sentence : str
        For an operator.
    causes : tuple of NamedCause
        In the order found; faults of the record come last.
    not_told_apart : tuple of str
        Causes that these data cannot distinguish from the named ones.
    experiments : tuple of str
        Experiments that would distinguish them.
    disturbance : Disturbance or None
    unexplained_by : tuple of str
    rejected : tuple of (name, reason)
    rmse_simulation, rmse_extended, rmse_noise_floor : float
        MW, RMSE on sealed blocks of means over ``mean_s``.
    segments : tuple of SegmentGain
    simulation, extended : Extended
        Without and with causes, fitted to the open blocks.
    final : Extended
        With causes, fitted to all blocks: the model for further use.
    reference : Reference
        Reference values of its causes.
    notes : tuple of str
    mean_s : float
    unexplained_mw : float
        Root mean square of what ``unexplained_by`` explains, without the time.
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
    mean_s: float = MEAN_S
    unexplained_mw: float = 0.0

    def measured_in(self, unit: str) -> Diagnosis:
        """Return the same numbers and sentences in ``unit`` of the output."""
        causes = tuple(
            dataclasses.replace(
                c, sentence=in_unit(c.sentence, unit), experiment=in_unit(c.experiment, unit),
                meaning=in_unit(c.meaning, unit),
                parameters={
                    key: dataclasses.replace(e, unit=in_unit(e.unit, unit))
                    for key, e in c.parameters.items()
                },
            )
            for c in self.causes
        )  # fmt: skip
        return dataclasses.replace(
            self, causes=causes, sentence=in_unit(self.sentence, unit),
            experiments=tuple(in_unit(one, unit) for one in self.experiments),
            rejected=tuple((name, in_unit(why, unit)) for name, why in self.rejected),
            notes=tuple(in_unit(note, unit) for note in self.notes),
        )  # fmt: skip


# The extended model as JSON: content and validation of ``extended_model.json``.

MODEL_FORMAT, MODEL_VERSION = 'valveflow/extended_model', 2
# Version 1 used the mean over the record as their origin, hence another curve.
_COUNTED_OTHERWISE = ('curve_step', 'gain_step', 'input_step')
_MOST_MODELS = 10  # largest number of models on top of each other
_WHOLE = 'extended model'


def model_to_json(given: ExtendedModel) -> dict[str, Any]:
    """Return the content of ``extended_model.json``."""
    m = given.model.base
    earlier = given.on_top_of
    return {
        'format': MODEL_FORMAT,
        'version': MODEL_VERSION,
        **({} if given.output_unit == 'MW' else {'output_unit': given.output_unit}),
        'pressure_exponent': given.pressure_exponent,
        **_form_json(given),
        'start_ns': given.start_ns,
        'reference': dataclasses.asdict(given.reference),
        'curve': {'knots': m.knots.tolist(), 'left': m.left.tolist(), 'right': m.right.tolist()},
        'dynamics': {
            'levels': m.levels.tolist(), 'time_constants_s': m.time_constants.tolist(),
            'delays_s': m.delays.tolist(),
        },
        'causes': [
            {
                'name': a.name, 'values': a.named(), 'switches_s': list(a.extra),
                **({} if a.cause.covariate is None else
                   {'covariate': _covariate_json(a.cause.covariate)}),
            }
            for a in given.model.active
        ],
        **({} if earlier is None else {'on_top_of': model_to_json(earlier)}),
    }  # fmt: skip


def _form_json(given: ExtendedModel) -> dict[str, Any]:
    """Return the entries for the form; none for the form of the paper."""
    if not given.form.scaled:
        return {}
    return {
        'axis': given.form.axis,
        'pressure_scale_exponent': given.form.scale_exponent,
        'offset_mw': given.model.base.offset,
    }


def _covariate_json(about: Covariate) -> dict[str, Any]:
    fields = dataclasses.asdict(about)
    del fields['name']
    return {k: list(v) if isinstance(v, tuple) else v for k, v in fields.items()}


def is_model(raw: object) -> bool:
    """Return True if the JSON declares itself an extended model."""
    return isinstance(raw, dict) and raw.get('format') == MODEL_FORMAT


_TIME = Number(-4e7, 4e7)  # seconds from the start of the model, more than 400 days
_SCHEMA = {
    'output_unit': OUTPUT_UNIT,
    'axis': Maybe(Text(AXES)),
    'pressure_exponent': Number(0.0, 2.0),
    'pressure_scale_exponent': Maybe(Number(0.0, 2.0)),
    'offset_mw': Maybe(Number(*MW)),
    'start_ns': Count(NS),
    'reference': {
        'span_s': Number(1.0, 4e7), 'temperature_degc': Number(*DEGC),
        'log_pressure': Number(-20.0, 10.0), 'pressure_level': Number(-1e6, 1e6),
        'pressure_slope': Number(-1e6, 1e6), 'opening_noise': Maybe(Number(0.0, 100.0)),
    },
    'curve': {
        'knots': ListOf(Number(*U), most=MOST_PIECES, rising=True),
        'left': ListOf(Number(*MW)), 'right': ListOf(Number(*MW)),
    },
    'dynamics': {
        'levels': ListOf(Number(*MW), rising=True),
        'time_constants_s': ListOf(Number(1e-6, 3600.0)), 'delays_s': ListOf(Number(0.0, 600.0)),
    },
    'causes': ListOf({
        'name': Text(), 'values': Members(Number(-1e12, 1e12)),
        'switches_s': ListOf(_TIME, rising=True),
        'covariate': Maybe({
            'column': Text(), 'unit': Text(), 'spread': Number(1e-12, 1e12),
            'power_mw': Number(1e-3, MW[1]), 'centre': ListOf(Number(-1e12, 1e12), 4, 4),
            'surface': ListOf(Number(-1e12, 1e12), COEFFICIENTS, COEFFICIENTS),
            'course': ListOf(Number(-1e12, 1e12), COURSE, COURSE),
        }),
    }),
}  # fmt: skip


def model_from_json(raw: object, depth: int = 0) -> ExtendedModel:
    """Read ``extended_model.json``.

    Raises
    ------
    DataError
        The content is invalid or not supported by this version; the message names the entry.
    """
    path = '.'.join(['on_top_of'] * depth)
    inside = f'{path}.' if path else ''
    if not isinstance(raw, dict) or not is_model(raw):
        raise DataError(f"This is no extended model: '{inside}format' must be '{MODEL_FORMAT}'.")
    if raw.get('version') not in (1, MODEL_VERSION) or isinstance(raw['version'], bool):
        where = f" in '{path}'" if path else ''
        raise DataError(
            f'The extended model has version {repr(raw.get("version"))[:20]}{where}, '
            f'this program reads 1 and {MODEL_VERSION}.'
        )
    if depth >= _MOST_MODELS:
        raise fail(_WHOLE, path, f'lies more than {_MOST_MODELS} models deep')
    top = checked(raw, _SCHEMA, _WHOLE, path)
    steps = [cause['name'] for cause in top['causes'] if cause['name'] in _COUNTED_OTHERWISE]
    if raw['version'] < MODEL_VERSION and steps:
        raise DataError(
            f'The extended model has version {raw["version"]}, which counts {steps[0]} in another '
            'way than this program. Make it anew from the log: valveflow diagnose LOG -o DIR.'
        )
    earlier = model_from_json(raw['on_top_of'], depth + 1) if 'on_top_of' in raw else None
    reference = top['reference']
    noise = reference.pop('opening_noise') or 0.0
    form = form_of(top, _WHOLE, inside)
    given = ExtendedModel(
        Extended(_base(top, inside), _causes(top['causes'], f'{inside}causes', form)),
        form, top['start_ns'], Reference(**reference, opening_noise=noise),
        earlier, top['output_unit'] or 'MW',
    )  # fmt: skip
    if earlier is not None and earlier.form != given.form:
        raise fail(_WHOLE, f'{inside}on_top_of', 'is a model over another input u')
    return given


def _base(top: dict[str, Any], inside: str) -> RegionalModel:
    """Return curve and dynamics; raise if they cannot be simulated."""
    knots, left, right = (np.array(top['curve'][k]) for k in ('knots', 'left', 'right'))
    if not len(left) == len(right) == len(knots) - 1 >= 1:
        problem = 'must have one knot more than values at left and right ends'
        raise fail(_WHOLE, f'{inside}curve', problem)
    levels, times, delays = (
        np.array(top['dynamics'][k]) for k in ('levels', 'time_constants_s', 'delays_s')
    )
    if not len(times) == len(delays) == len(levels) + 1:
        problem = 'must have one level less than time constants and delays'
        raise fail(_WHOLE, f'{inside}dynamics', problem)
    offset = top['offset_mw'] or 0.0 if top['axis'] == OPENING else None
    return RegionalModel(knots, left, right, levels, times, delays, offset)


def _causes(found: list[dict[str, Any]], path: str, form: StaticForm) -> tuple[FittedCause, ...]:
    names = [cause['name'] for cause in found]
    if len(set(names)) < len(names):
        raise fail(_WHOLE, path, 'names a cause twice')
    return tuple(_cause(cause, f'{path}[{k}]', form) for k, cause in enumerate(found))


def _cause(found: dict[str, Any], path: str, form: StaticForm) -> FittedCause:
    cause = catalogue().get(found['name'])
    if cause is None and (about := found['covariate']):
        given: dict[str, Any] = {
            k: tuple(v) if isinstance(v, list) else v for k, v in about.items()
        }
        if min(given['centre'][1], given['centre'][3]) <= 0.0:
            raise fail(_WHOLE, f'{path}.covariate.centre', 'has a spread that is not positive')
        cause = covariate_cause(Covariate(found['name'], **given))
    if cause is None:
        raise fail(_WHOLE, f'{path}.name', 'is no cause of the catalogue')
    cause = cause.on(form)
    schema = {u.name: Number(u.low, u.high) for u in cause.unknowns}
    values = checked(found['values'], schema, _WHOLE, f'{path}.values')
    return FittedCause(cause, tuple(values.values()), tuple(found['switches_s']))


# The diagnosis as JSON: ``diagnosis.json``.

FORMAT, VERSION = 'valveflow/diagnosis', 1


def _number(value: float) -> float | None:
    """Return None for NaN and infinity, which JSON does not have."""
    return float(value) if math.isfinite(value) else None


def cause_json(c: NamedCause) -> dict[str, Any]:
    """Return a cause; its parameters are numbers, and a time includes its origin."""
    return {
        'name': c.name,
        'sentence': c.sentence,
        'meaning': c.meaning,
        'to_do': c.to_do,
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
            'drift_mw': d.disturbance.drift_mw, 'shape': d.disturbance.shape,
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
