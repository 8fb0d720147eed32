"""The characteristic as JSON: what ``characteristic.json`` holds, and what is believed of one."""

from __future__ import annotations

import math
from typing import Any

from valveflow_ros.curve.characteristic import (
    Characteristic,
    ChartDesign,
    Choice,
    HeldCause,
    Piece,
    RegionDynamics,
    ResidualStatistics,
    Source,
    Support,
)
from valveflow_ros.curve.json_field import Field
from valveflow_ros.errors import DataError

# Causes held while a curve was fitted, as JSON.


def held_json(held: tuple[HeldCause, ...]) -> dict[str, Any]:
    """Return the causes under their key; a curve without any has no such key."""
    if not held:
        return {}
    return {
        'held': [{'name': h.name, 'values': dict(h.values), 'sentence': h.sentence} for h in held]
    }


def held_from(field: Field | None) -> tuple[HeldCause, ...]:
    """Read what `held_json` wrote.

    Raises
    ------
    DataError
        It is not that; the sentence names the place.
    """
    if field is None:
        return ()
    return tuple(
        HeldCause(
            f.key('name').text(),
            tuple((name, value.real()) for name, value in f.key('values').members()),
            f.key('sentence').text(),
        )
        for f in field.items()
    )


FORMAT = 'valveflow/characteristic'
VERSION = 1


def _number(value: float) -> float | None:
    """JSON has neither NaN nor infinity: absent is null."""
    return float(value) if math.isfinite(value) else None


def _piece_json(piece: Piece) -> dict[str, Any]:
    return {
        'u_from': piece.u_from,
        'u_to': piece.u_to,
        'slope': piece.slope,
        'intercept': piece.intercept,
        'slope_stderr': _number(piece.slope_stderr),
        'intercept_stderr': _number(piece.intercept_stderr),
        'samples': piece.samples,
    }


def _supported_json(c: Characteristic) -> list[dict[str, Any]]:
    """Return the pieces, each with what it rests on where that is known."""
    pieces = [_piece_json(p) for p in c.pieces]
    for piece, support in zip(pieces, c.support, strict=False):
        piece['identifiable'] = support.identifiable
        piece['support'] = {
            'steady': support.steady,
            'slope_response': support.slope_response,
            'samples': support.samples,
            'levels': list(support.levels),
        }
    return pieces


def _chart_json(chart: ChartDesign | None) -> dict[str, Any]:
    """Return the chart under its key; a curve without one has no such key."""
    if chart is None:
        return {}
    small, large = (
        {'slack': k, 'limit': h} for k, h in zip(chart.slack, chart.limit, strict=True)
    )
    return {
        'chart': {
            'block_s': chart.block_s,
            'correlation': chart.correlation,
            'innovation_mw': chart.innovation_mw,
            'small': small,
            'large': large,
            'run_length_days': chart.run_length_days,
        }
    }


def to_json(c: Characteristic) -> dict[str, Any]:
    """Return the content of ``characteristic.json``."""
    return {
        'format': FORMAT,
        'version': VERSION,
        'model_id': c.model_id,
        'pressure_exponent': c.pressure_exponent,
        'pieces': _supported_json(c),
        'breakpoint_intervals': [[_number(lo), _number(hi)] for lo, hi in c.breakpoint_intervals],
        'selection': {
            'rule': c.choice.rule,
            'cost': {str(j): _number(v) for j, v in c.choice.cost.items()},
            'turning_angle': {str(j): _number(v) for j, v in c.choice.turning_angle.items()},
            'note': c.choice.note,
            'confidence': {str(j): _number(v) for j, v in c.choice.confidence.items()},
        },
        'segments': {
            'steady': c.source.steady,
            'slope_response': c.source.slope_response,
            'samples': c.source.samples,
        },
        'window': {'start_ns': c.source.window_start_ns, 'end_ns': c.source.window_end_ns},
        'temperature': {
            'mean_degc': _number(c.source.temperature_mean_degc),
            'spread_k': _number(c.source.temperature_spread_k),
            'flag': c.source.temperature_flag,
        },
        'dynamics': [
            {
                'power_from': d.power_from,
                'power_to': d.power_to,
                'time_constant_s': d.time_constant_s,
                'delay_s': d.delay_s,
                'time_constant_stderr_s': _number(d.time_constant_stderr_s),
                'delay_stderr_s': _number(d.delay_stderr_s),
                'power_to_stderr_mw': _number(d.power_to_stderr_mw),
            }
            for d in c.dynamics
        ],
        'residuals': {
            'rmse_mw': c.residuals.rmse_mw,
            'average_sd_mw': c.residuals.average_sd_mw,
            'average_s': c.residuals.average_s,
            'input_noise': c.residuals.input_noise,
            'power_noise_mw': c.residuals.power_noise_mw,
            'width_mw': _number(c.residuals.width_mw),
            **_chart_json(c.residuals.chart),
        }
        if math.isfinite(c.residuals.rmse_mw)
        else {},
        'partition': {'pieces': [_piece_json(p) for p in c.partition_pieces]},
        'notes': list(c.notes),
        **held_json(c.held),
        'optimal': bool(c.partition_pieces),
    }


def from_json(raw: object) -> Characteristic:
    """Read the content of ``characteristic.json``.

    What DESIGN's contract names must be there; what this program adds to it may
    be missing, as in a file another program wrote.

    Raises
    ------
    DataError
        It is not one, or not one this version can read; the sentence names the place.
    """
    if not isinstance(raw, dict) or raw.get('format') != FORMAT:
        raise DataError(f"This is no flow characteristic: 'format' must be '{FORMAT}'.")
    if raw.get('version') is not VERSION:
        raise DataError(
            f'The characteristic has version {raw.get("version")}, this program reads {VERSION}.'
        )
    top = Field(raw, '')
    pieces = _pieces(top.key('pieces'))
    intervals = tuple(_interval(f) for f in top.key('breakpoint_intervals').items())
    if len(intervals) != len(pieces) - 1:
        raise top.key('breakpoint_intervals').fail(f'must have {len(pieces) - 1} entries')
    selection = top.key('selection')
    notes, partition, name = (top.may_have(n) for n in ('notes', 'partition', 'model_id'))
    note, confidence = (selection.may_have(n) for n in ('note', 'confidence'))
    return Characteristic(
        pressure_exponent=top.key('pressure_exponent').real(0.5, 2.0),
        pieces=pieces,
        breakpoint_intervals=intervals,
        choice=Choice(
            selection.key('rule').text(),
            selection.key('cost').by_pieces(),
            selection.key('turning_angle').by_pieces(),
            note.text() if note else '',
            confidence.by_pieces() if confidence else {},
        ),
        source=_source(top),
        residuals=_residuals(top.may_have('residuals')),
        dynamics=_dynamics(top.key('dynamics')),
        partition_pieces=_pieces(partition.key('pieces'), touching=False) if partition else (),
        notes=tuple(n.text() for n in notes.items()) if notes else (),
        support=_support(top.key('pieces')),
        model_id=name.text() if name else '',
        held=held_from(top.may_have('held')),
    )


def _pieces(field: Field, touching: bool = True) -> tuple[Piece, ...]:
    pieces: list[Piece] = []
    for f in field.items():
        if pieces and touching and f.key('u_from').real() != pieces[-1].u_to:
            raise f.key('u_from').fail('is not where the piece before it ends')
        piece = Piece(
            f.key('u_from').real(),
            f.key('u_to').real(),
            f.key('slope').real(),
            f.key('intercept').real(),
            f.key('slope_stderr').real_or_nan(0.0),
            f.key('intercept_stderr').real_or_nan(0.0),
            f.key('samples').whole(),
        )
        if not piece.u_from < piece.u_to:
            raise f.key('u_to').fail('is not above u_from')
        pieces.append(piece)
    if touching and not pieces:
        raise field.fail('is empty')
    return tuple(pieces)


def _support(field: Field) -> tuple[Support, ...]:
    """Return what the pieces rest on; empty unless every piece says so."""
    found: list[Support] = []
    for piece in field.items():
        judged, support = piece.may_have('identifiable'), piece.may_have('support')
        if judged is None or support is None:
            return ()
        found.append(
            Support(
                support.key('steady').whole(),
                support.key('slope_response').whole(),
                support.key('samples').whole(),
                tuple(level.real() for level in support.key('levels').items()),
                judged.flag(),
            )
        )
    return tuple(found)


def _interval(field: Field) -> tuple[float, float]:
    ends = field.items()
    if len(ends) != 2:
        raise field.fail('must be a lower and an upper end')
    return ends[0].real_or_nan(), ends[1].real_or_nan()


def _source(top: Field) -> Source:
    segments, window, temperature = (
        top.key('segments'),
        top.may_have('window'),
        top.may_have('temperature'),
    )
    return Source(
        window_start_ns=window.key('start_ns').whole() if window else 0,
        window_end_ns=window.key('end_ns').whole() if window else 0,
        steady=segments.key('steady').whole(),
        slope_response=segments.key('slope_response').whole(),
        samples=segments.key('samples').whole(),
        temperature_mean_degc=temperature.key('mean_degc').real_or_nan()
        if temperature
        else math.nan,
        temperature_spread_k=temperature.key('spread_k').real_or_nan(0.0)
        if temperature
        else math.nan,
        temperature_flag=temperature.key('flag').flag() if temperature else False,
    )


def _residuals(field: Field | None) -> ResidualStatistics:
    names = ('rmse_mw', 'average_sd_mw', 'average_s', 'input_noise', 'power_noise_mw')
    if field is None or not field.may_have('rmse_mw'):
        return ResidualStatistics(math.nan, math.nan, math.nan, math.nan, math.nan)
    width, chart = field.may_have('width_mw'), field.may_have('chart')
    rmse, average_sd, average, noise, power_noise = (field.key(n).real(0.0) for n in names)
    return ResidualStatistics(
        rmse,
        average_sd,
        average,
        noise,
        power_noise,
        width.real_or_nan(0.0) if width else math.nan,
        _chart(chart) if chart else None,
    )


def _chart(field: Field) -> ChartDesign:
    sums = field.key('small'), field.key('large')
    return ChartDesign(
        block_s=field.key('block_s').real(1e-3),
        correlation=field.key('correlation').real(0.0, 0.999),
        innovation_mw=field.key('innovation_mw').real(1e-12),
        slack=(sums[0].key('slack').real(0.0), sums[1].key('slack').real(0.0)),
        limit=(sums[0].key('limit').real(1e-6), sums[1].key('limit').real(1e-6)),
        run_length_days=field.key('run_length_days').real(0.0),
    )


def _dynamics(field: Field) -> tuple[RegionDynamics, ...]:
    regions: list[RegionDynamics] = []
    for f in field.items():
        t_error, d_error = f.may_have('time_constant_stderr_s'), f.may_have('delay_stderr_s')
        level = f.may_have('power_to_stderr_mw')
        region = RegionDynamics(
            f.key('power_from').real(),
            f.key('power_to').real(),
            f.key('time_constant_s').real(1e-6, 3600.0),
            f.key('delay_s').real(0.0, 600.0),
            t_error.real_or_nan(0.0) if t_error else math.nan,
            d_error.real_or_nan(0.0) if d_error else math.nan,
            level.real_or_nan(0.0) if level else math.nan,
        )
        if regions and not region.power_to > regions[-1].power_to:
            raise f.key('power_to').fail('does not lie above the region before')
        regions.append(region)
    return tuple(regions)
