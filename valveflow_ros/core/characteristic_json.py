"""The characteristic as JSON: what ``characteristic.json`` holds, and what is believed of one."""

from __future__ import annotations

import math
from typing import Any

from valveflow_ros.core.characteristic import (
    Characteristic,
    Choice,
    Piece,
    RegionDynamics,
    ResidualStatistics,
    Source,
)
from valveflow_ros.errors import DataError

FORMAT = 'valveflow/characteristic'
VERSION = 1

_LARGEST = 1e30  # no number of a plant is larger; products of two still are finite


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


def to_json(c: Characteristic) -> dict[str, Any]:
    """Return the content of ``characteristic.json``."""
    return {
        'format': FORMAT,
        'version': VERSION,
        'model_id': c.model_id,
        'pressure_exponent': c.pressure_exponent,
        'pieces': [_piece_json(p) for p in c.pieces],
        'breakpoint_intervals': [[_number(lo), _number(hi)] for lo, hi in c.breakpoint_intervals],
        'selection': {
            'rule': c.choice.rule,
            'cost': {str(j): _number(v) for j, v in c.choice.cost.items()},
            'turning_angle': {str(j): _number(v) for j, v in c.choice.turning_angle.items()},
            'note': c.choice.note,
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
            }
            for d in c.dynamics
        ],
        'residuals': {
            'rmse_mw': c.residuals.rmse_mw,
            'average_sd_mw': c.residuals.average_sd_mw,
            'average_s': c.residuals.average_s,
            'input_noise': c.residuals.input_noise,
            'power_noise_mw': c.residuals.power_noise_mw,
        }
        if math.isfinite(c.residuals.rmse_mw)
        else {},
        'partition': {'pieces': [_piece_json(p) for p in c.partition_pieces]},
        'notes': list(c.notes),
        'optimal': True,
    }


class _Field:
    """A place in the JSON that knows its path, so that an error can name it."""

    def __init__(self, value: object, path: str) -> None:
        self._value = value
        self._path = path

    def fail(self, problem: str) -> DataError:
        return DataError(f"The characteristic cannot be used: '{self._path}' {problem}.")

    def key(self, name: str) -> _Field:
        path = f'{self._path}.{name}' if self._path else name
        if not isinstance(self._value, dict):
            raise self.fail('is not an object')
        if name not in self._value:
            raise _Field(None, path).fail('is missing')
        return _Field(self._value[name], path)

    def may_have(self, name: str) -> _Field | None:
        present = isinstance(self._value, dict) and name in self._value
        return self.key(name) if present else None

    def items(self) -> list[_Field]:
        if not isinstance(self._value, list):
            raise self.fail('is not a list')
        return [_Field(v, f'{self._path}[{k}]') for k, v in enumerate(self._value)]

    def real(self, low: float = -math.inf, high: float = math.inf) -> float:
        value = self._value
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.fail('is not a number')
        if not low <= value <= high or abs(value) > _LARGEST:
            raise self.fail('is out of range')
        return float(value)

    def real_or_nan(self, low: float = -math.inf) -> float:
        return math.nan if self._value is None else self.real(low)

    def whole(self) -> int:
        value = self._value
        if isinstance(value, bool) or not isinstance(value, int) or value < 0:
            raise self.fail('is not a count')
        return value

    def flag(self) -> bool:
        if not isinstance(self._value, bool):
            raise self.fail('is neither true nor false')
        return self._value

    def text(self) -> str:
        if not isinstance(self._value, str):
            raise self.fail('is not a text')
        return self._value

    def by_pieces(self) -> dict[int, float]:
        if not isinstance(self._value, dict):
            raise self.fail('is not an object')
        table = {}
        for name in self._value:
            if not (isinstance(name, str) and name.isdecimal()):
                raise self.fail('has a key that is no number of pieces')
            table[int(name)] = self.key(name).real_or_nan()
        return table


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
    top = _Field(raw, '')
    pieces = _pieces(top.key('pieces'))
    intervals = tuple(_interval(f) for f in top.key('breakpoint_intervals').items())
    if len(intervals) != len(pieces) - 1:
        raise top.key('breakpoint_intervals').fail(f'must have {len(pieces) - 1} entries')
    selection = top.key('selection')
    notes, partition, name = (top.may_have(n) for n in ('notes', 'partition', 'model_id'))
    note = selection.may_have('note')
    return Characteristic(
        pressure_exponent=top.key('pressure_exponent').real(0.5, 2.0),
        pieces=pieces,
        breakpoint_intervals=intervals,
        choice=Choice(
            selection.key('rule').text(),
            selection.key('cost').by_pieces(),
            selection.key('turning_angle').by_pieces(),
            note.text() if note else '',
        ),
        source=_source(top),
        residuals=_residuals(top.may_have('residuals')),
        dynamics=_dynamics(top.key('dynamics')),
        partition_pieces=_pieces(partition.key('pieces'), touching=False) if partition else (),
        notes=tuple(n.text() for n in notes.items()) if notes else (),
        model_id=name.text() if name else '',
    )


def _pieces(field: _Field, touching: bool = True) -> tuple[Piece, ...]:
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


def _interval(field: _Field) -> tuple[float, float]:
    ends = field.items()
    if len(ends) != 2:
        raise field.fail('must be a lower and an upper end')
    return ends[0].real_or_nan(), ends[1].real_or_nan()


def _source(top: _Field) -> Source:
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


def _residuals(field: _Field | None) -> ResidualStatistics:
    names = ('rmse_mw', 'average_sd_mw', 'average_s', 'input_noise', 'power_noise_mw')
    if field is None or not field.may_have('rmse_mw'):
        return ResidualStatistics(*(math.nan for _ in names))
    return ResidualStatistics(*(field.key(name).real(0.0) for name in names))


def _dynamics(field: _Field) -> tuple[RegionDynamics, ...]:
    regions: list[RegionDynamics] = []
    for f in field.items():
        t_error, d_error = f.may_have('time_constant_stderr_s'), f.may_have('delay_stderr_s')
        region = RegionDynamics(
            f.key('power_from').real(),
            f.key('power_to').real(),
            f.key('time_constant_s').real(1e-6, 3600.0),
            f.key('delay_s').real(0.0, 600.0),
            t_error.real_or_nan(0.0) if t_error else math.nan,
            d_error.real_or_nan(0.0) if d_error else math.nan,
        )
        if regions and not region.power_to > regions[-1].power_to:
            raise f.key('power_to').fail('does not lie above the region before')
        regions.append(region)
    return tuple(regions)
