# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The characteristic as JSON: the content of ``characteristic.json``, and its validation."""

from __future__ import annotations

import enum
import math
from dataclasses import asdict
from typing import Any

from valveflow_ros.curve.characteristic import (
    Characteristic,
    ChartDesign,
    Choice,
    FittedData,
    FormEvidence,
    HeldCause,
    OpeningsSeen,
    Piece,
    RegionDynamics,
    ResidualStatistics,
    Support,
)
from valveflow_ros.curve.json_schema import (
    DEGC,
    MOST_PIECES,
    MW,
    NS,
    Count,
    Flag,
    ListOf,
    Maybe,
    Members,
    Number,
    Text,
    U,
    checked,
    fail,
)
from valveflow_ros.errors import DataError
from valveflow_ros.records import FLOW_UNITS
from valveflow_ros.signals.static_form import AXES, INTEGRATED_INPUT, LEAST_EXPONENT, StaticForm


def held_json(held: tuple[HeldCause, ...]) -> dict[str, Any]:
    """Return the causes under their key; empty for a curve without causes."""
    found = [{'name': h.name, 'values': dict(h.values), 'sentence': h.sentence} for h in held]
    return {'held': found} if held else {}


# The name of a cause, and its values; the catalogue of causes defines which values it has.
HELD = Maybe(ListOf({'name': Text(), 'values': Members(Number(-1e12, 1e12)), 'sentence': Text()}))


def held_from(raw: object) -> tuple[HeldCause, ...]:
    """Read the causes that `held_json` wrote from an object, which may have none.

    Raises `DataError` if the content is invalid; the message names the place.
    """
    return _held(checked(raw, {'held': HELD}, _WHOLE)['held'])


def _held(found: list[dict[str, Any]] | None) -> tuple[HeldCause, ...]:
    return tuple(
        HeldCause(h['name'], tuple(h['values'].items()), h['sentence']) for h in found or ()
    )


FORMAT = 'valveflow/characteristic'
_WHOLE = 'characteristic'
VERSION = 2
_READABLE = (1, 2)


def number(value: float) -> float | None:
    """Return a number for JSON; None for NaN and infinity, which JSON does not have."""
    return float(value) if math.isfinite(value) else None


def _plain(record: Any) -> dict[str, Any]:
    """Return the fields of a dataclass; numbers that JSON does not have are None."""
    return {k: number(v) if isinstance(v, float) else v for k, v in asdict(record).items()}


def _supported_json(c: Characteristic) -> list[dict[str, Any]]:
    """Return the pieces, each with its data if these are known."""
    pieces = [_plain(p) for p in c.pieces]
    for piece, support in zip(pieces, c.support, strict=False):
        data = {**asdict(support), 'levels': list(support.levels)}
        piece['identifiable'] = data.pop('identifiable')
        piece['support'] = data
    return pieces


def _chart_json(chart: ChartDesign) -> dict[str, Any]:
    small, large = (
        {'slack': k, 'limit': h} for k, h in zip(chart.slack, chart.limit, strict=True)
    )
    return {
        'block_s': chart.block_s, 'correlation': chart.correlation,
        'innovation_mw': chart.innovation_mw, 'small': small, 'large': large,
        'run_length_days': chart.run_length_days,
    }  # fmt: skip


def _residuals_json(found: ResidualStatistics) -> dict[str, Any]:
    """Return the statistics; empty if they are unknown."""
    if not math.isfinite(found.rmse_mw):
        return {}
    told = _plain(found)
    wander_mw = told.pop('wander_mw')
    del told['chart']
    # No key if a value is unknown, so that the hash of older curves is unchanged.
    if wander_mw is not None:
        told['wander_mw'] = wander_mw
    return told if found.chart is None else {**told, 'chart': _chart_json(found.chart)}


def to_json(c: Characteristic) -> dict[str, Any]:
    """Return the content of ``characteristic.json``."""
    choice, source = c.choice, c.source
    form = {}
    if c.form is not None:
        worst = dict(zip(_WORST, map(number, c.form.worst), strict=True))
        form = {'form': {**_plain(c.form), 'worst': worst}}
    cost, angle, confidence = (
        {str(j): number(v) for j, v in by_pieces.items()}
        for by_pieces in (choice.cost, choice.turning_angle, choice.confidence)
    )
    return {
        'format': FORMAT,
        'version': VERSION,
        'model_id': c.model_id,
        'output_unit': c.output_unit,
        'axis': c.axis,
        'pressure_exponent': c.pressure_exponent,
        'pressure_scale_exponent': c.pressure_scale_exponent,
        'offset_mw': c.offset_mw,
        'reference_pressure_mpa': number(c.reference_pressure_mpa),
        **form,
        **({'openings_seen': [asdict(s) for s in c.openings_seen]} if c.openings_seen else {}),
        'pieces': _supported_json(c),
        'breakpoint_intervals': [[number(lo), number(hi)] for lo, hi in c.breakpoint_intervals],
        'selection': {
            'rule': choice.rule, 'cost': cost, 'turning_angle': angle, 'note': choice.note,
            'confidence': confidence,
        },
        'segments': {
            name: getattr(source, name) for name in ('steady', 'slope_response', 'samples')
        },
        'window': {'start_ns': source.window_start_ns, 'end_ns': source.window_end_ns},
        'temperature': {
            'mean_degc': number(source.temperature_mean_degc),
            'spread_k': number(source.temperature_spread_k),
            'flag': source.temperature_flag,
        },
        'dynamics': [_plain(d) for d in c.dynamics],
        'residuals': _residuals_json(c.residuals),
        'partition': {'pieces': [_plain(p) for p in c.partition_pieces]},
        'notes': list(c.notes),
        **held_json(c.held),
        'optimal': bool(c.partition_pieces),
    }  # fmt: skip


# A very uncertain error may be arbitrarily large.
_ERROR = Number(0.0, 1e30, null=True)
PIECE = {
    'u_from': Number(*U), 'u_to': Number(*U), 'slope': Number(-1e9, 1e9),
    'intercept': Number(-1e15, 1e15), 'slope_stderr': _ERROR,
    'intercept_stderr': _ERROR, 'samples': Count(),
}  # fmt: skip
_SUPPORT = {
    'steady': Count(), 'slope_response': Count(), 'samples': Count(),
    'levels': ListOf(Number(*U), rising=True, most=1_000_000),
}  # fmt: skip
_SUM = {'slack': Number(0.0, 1e6), 'limit': Number(1e-6, 1e9)}
_COST = Members(Number(0.0, 1e30, null=True), pieces=True)
_ANGLE = Members(Number(-360.0, 360.0, null=True), pieces=True)
_WORST = ('opening_percent', 'pressure_mpa', 'apart_mw')
_MANY_MW = Number(0.0, 1e12)
_PERHAPS_MW = Number(0.0, 1e12, null=True)
OUTPUT_UNIT = Maybe(Text(('MW', *FLOW_UNITS)))
_FORM = {
    'chosen': Text(AXES), 'told': Maybe(Flag()), 'log_likelihood_gain': Number(-1e15, 1e15),
    'rmse_mw': Maybe(_PERHAPS_MW), 'rmse_other_mw': _MANY_MW, 'other': Maybe(Text()),
    'apart_mw': Maybe(_PERHAPS_MW),
    'worst': Maybe({name: Number(-1e12, 1e12, null=True) for name in _WORST}),
    'contradicted': Maybe(Flag()),
}  # fmt: skip
_OPENING, _MPA = Number(-1e3, 1e3), Number(-100.0, 100.0)
_SEEN = {
    'pressure_from_mpa': _MPA, 'pressure_to_mpa': _MPA, 'opening_from_percent': _OPENING,
    'opening_to_percent': _OPENING, 'samples': Count(),
}  # fmt: skip
_SCHEMA = {
    'model_id': Maybe(Text()),
    'output_unit': OUTPUT_UNIT,
    'axis': Maybe(Text(AXES)),
    'pressure_exponent': Number(0.0, 2.0),
    'pressure_scale_exponent': Maybe(Number(0.0, 2.0)),
    'offset_mw': Maybe(Number(*MW)),
    'reference_pressure_mpa': Maybe(Number(1e-6, 100.0, null=True)),
    'form': Maybe(_FORM),
    'openings_seen': Maybe(ListOf(_SEEN, most=1000)),
    'pieces': ListOf(
        {**PIECE, 'identifiable': Maybe(Flag()), 'support': Maybe(_SUPPORT)}, 1, MOST_PIECES
    ),
    'breakpoint_intervals': ListOf(
        # The interval of a very uncertain breakpoint may exceed the range of the plant.
        ListOf(Number(-1e30, 1e30, null=True), 2, 2)
    ),
    'selection': {
        'rule': Text(), 'cost': _COST, 'turning_angle': _ANGLE, 'note': Maybe(Text()),
        'confidence': Maybe(Members(Number(0.0, 1.0 + 1e-9, null=True), pieces=True)),
    },
    'segments': {'steady': Count(), 'slope_response': Count(), 'samples': Count()},
    'window': Maybe({'start_ns': Count(NS), 'end_ns': Count(NS)}),
    'temperature': Maybe({
        'mean_degc': Number(*DEGC, null=True),
        'spread_k': Number(0.0, DEGC[1], null=True), 'flag': Flag(),
    }),
    'dynamics': ListOf({
        'power_from': Number(*MW), 'power_to': Number(*MW),
        'time_constant_s': Number(1e-6, 3600.0), 'delay_s': Number(0.0, 600.0),
        'time_constant_stderr_s': Maybe(_ERROR),
        'delay_stderr_s': Maybe(_ERROR),
        'power_to_stderr_mw': Maybe(_ERROR),
    }),
    'residuals': Maybe({
        'rmse_mw': Number(0.0, MW[1]), 'average_sd_mw': Number(0.0, MW[1]),
        'average_s': Number(1e-3, 1e7), 'input_noise': Number(0.0, U[1]),
        'power_noise_mw': Number(0.0, MW[1]), 'width_mw': Maybe(_ERROR),
        'wander_mw': Maybe(_ERROR),
        'chart': Maybe({
            'block_s': Number(1e-3, 864_000.0), 'correlation': Number(0.0, 0.999),
            'innovation_mw': Number(1e-12, MW[1]), 'small': _SUM, 'large': _SUM,
            'run_length_days': Number(1e-6, 1e6),
        }),
    }, or_empty=True),
    'partition': Maybe({'pieces': ListOf(PIECE, most=MOST_PIECES)}),
    'notes': Maybe(ListOf(Text())),
    'held': HELD,
    'optimal': Maybe(Flag()),
}  # fmt: skip


def from_json(raw: object) -> Characteristic:
    """Read the content of ``characteristic.json``.

    The keys of the specified format are required; keys that this program adds may be missing, as
    in a file of another program. Raises `DataError` if it is invalid, or of an unsupported
    version; the message names the place.
    """
    if not isinstance(raw, dict) or raw.get('format') != FORMAT:
        raise DataError(f"This is no flow characteristic: 'format' must be '{FORMAT}'.")
    if not any(raw.get('version') is readable for readable in _READABLE):
        raise DataError(
            f'The characteristic has version {raw.get("version")!r:.20}, this program reads '
            f'{" and ".join(map(str, _READABLE))}.'
        )
    top = checked(raw, _SCHEMA, _WHOLE)
    form = form_of(top, _WHOLE)
    check_pieces(top['pieces'], _WHOLE, 'pieces', Joint.SAME)
    partition = top['partition'] or {'pieces': []}
    check_pieces(partition['pieces'], _WHOLE, 'partition.pieces', Joint.FREE)
    _check_intervals(top)
    _check_order(top)
    choice, source, window, temperature = (
        top['selection'], top['segments'], top['window'], top['temperature'],
    )  # fmt: skip
    window = window or {'start_ns': 0, 'end_ns': 0}
    temperature = temperature or {'mean_degc': math.nan, 'spread_k': math.nan, 'flag': False}
    pressure = top['reference_pressure_mpa']
    return Characteristic(
        # With breakpoints at fixed openings u is V, whatever exponent another program wrote.
        pressure_exponent=form.input_exponent,
        pieces=tuple(map(_piece, top['pieces'])),
        breakpoint_intervals=tuple((low, high) for low, high in top['breakpoint_intervals']),
        choice=Choice(
            choice['rule'], choice['cost'], choice['turning_angle'], choice['note'] or '',
            choice['confidence'] or {},
        ),
        source=FittedData(
            window['start_ns'], window['end_ns'], source['steady'], source['slope_response'],
            source['samples'], temperature['mean_degc'], temperature['spread_k'],
            temperature['flag'],
        ),
        residuals=_residuals(top['residuals']),
        dynamics=tuple(
            RegionDynamics(**{k: math.nan if v is None else v for k, v in region.items()})
            for region in top['dynamics']
        ),
        partition_pieces=tuple(map(_piece, partition['pieces'])),
        notes=tuple(top['notes'] or ()),
        support=_support(top['pieces']),
        model_id=top['model_id'] or '',
        held=_held(top['held']),
        axis=form.axis,
        pressure_scale_exponent=form.scale_exponent,
        offset_mw=top['offset_mw'] or 0.0,
        reference_pressure_mpa=math.nan if pressure is None else pressure,
        form=_form(top['form']),
        output_unit=top['output_unit'] or 'MW',
        openings_seen=tuple(OpeningsSeen(**seen) for seen in top['openings_seen'] or ()),
    )  # fmt: skip


def form_of(top: dict[str, Any], whole: str, inside: str = '') -> StaticForm:
    """Return the form that a model's keys specify, and refuse keys that do not suit the axis.

    Raises `DataError` if one does not; the message names the key, which is ``inside`` another one.
    """
    axis = top['axis'] or INTEGRATED_INPUT
    scale, offset = top['pressure_scale_exponent'] or 0.0, top['offset_mw'] or 0.0
    if axis == INTEGRATED_INPUT:
        if not top['pressure_exponent'] >= LEAST_EXPONENT:
            raise fail(whole, f'{inside}pressure_exponent', f'is below {LEAST_EXPONENT:g}')
        for name, value in (('pressure_scale_exponent', scale), ('offset_mw', offset)):
            if value != 0.0:
                problem = f'is {value:g}, but must be 0 for the axis integrated_input'
                raise fail(whole, f'{inside}{name}', problem)
        return StaticForm(axis, top['pressure_exponent'])
    if not scale >= LEAST_EXPONENT:
        problem = f'is below {LEAST_EXPONENT:g}'
        raise fail(whole, f'{inside}pressure_scale_exponent', problem)
    return StaticForm(axis, scale)


def _form(found: dict[str, Any] | None) -> FormEvidence | None:
    if found is None:
        return None
    nan = math.nan
    unknown = {
        'told': False, 'rmse_mw': nan, 'other': '', 'apart_mw': nan,
        'worst': dict.fromkeys(_WORST, nan), 'contradicted': False,
    }  # fmt: skip
    known = {**unknown, **{k: v for k, v in found.items() if v is not None}}
    return FormEvidence(**{**known, 'worst': tuple(known['worst'].values())})


def _piece(found: dict[str, Any]) -> Piece:
    return Piece(**{name: found[name] for name in PIECE})


def _support(pieces: list[dict[str, Any]]) -> tuple[Support, ...]:
    """Return the data of the pieces; empty unless every piece has them."""
    if any(p['support'] is None or p['identifiable'] is None for p in pieces):
        return ()
    return tuple(
        Support(**{**p['support'], 'levels': tuple(p['support']['levels'])},
                identifiable=p['identifiable'])
        for p in pieces
    )  # fmt: skip


def _residuals(found: dict[str, Any] | None) -> ResidualStatistics:
    if found is None:
        return ResidualStatistics(math.nan, math.nan, math.nan, math.nan, math.nan)
    chart = found['chart']
    if chart is not None:
        sums = chart.pop('small'), chart.pop('large')
        slack, limit = ((sums[0][name], sums[1][name]) for name in ('slack', 'limit'))
        chart = ChartDesign(**chart, slack=slack, limit=limit)
    unknown = {k: math.nan for k in ('width_mw', 'wander_mw') if found[k] is None}
    return ResidualStatistics(**{**found, **unknown, 'chart': chart})


class Joint(enum.Enum):
    """The condition at each joint of two lines."""

    SAME = 'same number'
    NEARLY = 'but for rounding'
    FREE = 'not before the one before begins'


def check_pieces(pieces: list[dict[str, Any]], whole: str, path: str, joint: Joint) -> None:
    """Refuse lines that are not in sequence, or have values that no plant has.

    Raises `DataError` for such lines; the message names the place.
    """
    for k, piece in enumerate(pieces):
        begin, before = piece['u_from'], pieces[k - 1] if k else None
        follows = (
            before is None
            or {
                Joint.SAME: begin == before['u_to'],
                Joint.NEARLY: math.isclose(begin, before['u_to'], rel_tol=1e-9),
                Joint.FREE: begin > before['u_from'],
            }[joint]
        )
        if not follows:
            raise fail(whole, f'{path}[{k}].u_from', 'is not where the piece before it ends')
        if not begin < piece['u_to']:
            raise fail(whole, f'{path}[{k}].u_to', 'is not above u_from')
        for end in ('u_from', 'u_to'):
            power = piece['slope'] * piece[end] + piece['intercept']
            if not MW[0] <= power <= MW[1]:
                raise fail(whole, f'{path}[{k}]', f'leads to {power:g} MW at {end}')


def _check_intervals(top: dict[str, Any]) -> None:
    pieces, intervals = top['pieces'], top['breakpoint_intervals']
    if len(intervals) != len(pieces) - 1:
        raise fail(_WHOLE, 'breakpoint_intervals', "must have one entry less than 'pieces'")
    for k, (low, high) in enumerate(intervals):
        # Comparisons with NaN (unknown) are false.
        if low > pieces[k]['u_to'] or high < pieces[k]['u_to']:
            raise fail(_WHOLE, f'breakpoint_intervals[{k}]', 'does not hold its breakpoint')


def _check_order(top: dict[str, Any]) -> None:
    window, dynamics = top['window'], top['dynamics']
    if window and window['end_ns'] < window['start_ns']:
        raise fail(_WHOLE, 'window.end_ns', 'is before start_ns')
    for k, region in enumerate(dynamics):
        if not region['power_from'] < region['power_to']:
            raise fail(_WHOLE, f'dynamics[{k}].power_to', 'is not above power_from')
        if k and region['power_from'] != dynamics[k - 1]['power_to']:
            raise fail(
                _WHOLE, f'dynamics[{k}].power_from', 'is not where the region before it ends'
            )
