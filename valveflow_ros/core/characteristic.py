"""The result: the flow characteristic, how sure it is, and what it was made from."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from valveflow_ros.core.model import RegionalModel
from valveflow_ros.errors import DataError
from valveflow_ros.records import FloatArray

FORMAT = 'valveflow/characteristic'
VERSION = 1


@dataclass(frozen=True, slots=True)
class Piece:
    """One line segment of eq. (2); u in % MPa^m, slope in MW per unit of u, intercept in MW."""

    u_from: float
    u_to: float
    slope: float
    intercept: float
    slope_stderr: float
    intercept_stderr: float
    samples: int


@dataclass(frozen=True, slots=True)
class RegionDynamics:
    """First-order dynamics with delay, eq. (3), between two power levels."""

    power_from: float
    power_to: float
    time_constant_s: float
    delay_s: float
    time_constant_stderr_s: float
    delay_stderr_s: float


@dataclass(frozen=True, slots=True)
class Choice:
    """How J was chosen: the rule, Omega(J) of eq. (19) and Lambda(J) of eq. (24)."""

    rule: str
    cost: dict[int, float]
    turning_angle: dict[int, float]
    note: str = ''


@dataclass(frozen=True, slots=True)
class Source:
    """The data the curve was fitted to."""

    window_start_ns: int
    window_end_ns: int
    steady: int
    slope_response: int
    samples: int
    temperature_mean_degc: float
    temperature_spread_k: float
    temperature_flag: bool


@dataclass(frozen=True, slots=True)
class ResidualStatistics:
    """What residuals of this curve look like on the data it was fitted to (MW)."""

    rmse_mw: float
    average_sd_mw: float
    average_s: float
    input_noise: float
    power_noise_mw: float


@dataclass(frozen=True, slots=True)
class Characteristic:
    """A fitted flow characteristic x = F(u)."""

    pressure_exponent: float
    pieces: tuple[Piece, ...]
    breakpoint_intervals: tuple[tuple[float, float], ...]
    choice: Choice
    source: Source
    residuals: ResidualStatistics
    dynamics: tuple[RegionDynamics, ...] = ()
    partition_pieces: tuple[Piece, ...] = ()
    notes: tuple[str, ...] = ()
    model_id: str = field(default='')

    @property
    def breakpoints(self) -> FloatArray:
        """Return the boundary point vector U of the paper, shape (J + 1,)."""
        return np.array([self.pieces[0].u_from, *(p.u_to for p in self.pieces)])

    @property
    def model(self) -> RegionalModel:
        """Return the numbers as the model that predicts."""
        slopes = np.array([p.slope for p in self.pieces])
        intercepts = np.array([p.intercept for p in self.pieces])
        knots = self.breakpoints
        return RegionalModel(
            knots=knots,
            left=slopes * knots[:-1] + intercepts,
            right=slopes * knots[1:] + intercepts,
            levels=np.array([d.power_to for d in self.dynamics[:-1]]),
            time_constants=np.array([d.time_constant_s for d in self.dynamics]),
            delays=np.array([d.delay_s for d in self.dynamics]),
        )

    def values(self) -> FloatArray:
        """Return F at the breakpoints in MW, shape (J + 1,); at a jump the mean of both ends."""
        m = self.model
        inner = 0.5 * (m.right[:-1] + m.left[1:])
        return np.concatenate([m.left[:1], inner, m.right[-1:]])

    def __call__(self, u: FloatArray) -> FloatArray:
        """Evaluate F(u) in MW, eq. (26); NaN outside the identified range.

        Nothing is known beyond the outer breakpoints, so nothing is said there.
        """
        u = np.asarray(u, dtype=np.float64)
        knots = self.breakpoints
        inside = (u >= knots[0]) & (u <= knots[-1])
        return np.where(inside, self.model.static(u), np.nan)

    def inverse(self, power_mw: FloatArray) -> FloatArray:
        """Return u = F^-1(x); NaN for a power the curve does not reach.

        Raises
        ------
        DataError
            The curve does not rise throughout, so it has no inverse.
        """
        m = self.model
        if np.any(m.slopes() <= 0.0):
            falling = int(np.argmin(m.slopes())) + 1
            raise DataError(
                f'The curve has no inverse: piece {falling} does not rise '
                f'(slope {m.slopes()[falling - 1]:.4g} MW per unit of u).'
            )
        power = np.asarray(power_mw, dtype=np.float64)
        x = np.maximum.accumulate(np.column_stack([m.left, m.right]).ravel())
        u = np.repeat(m.knots, 2)[1:-1]
        return np.where((power >= x[0]) & (power <= x[-1]), np.interp(power, x, u), np.nan)

    def with_id(self) -> Characteristic:
        """Return a copy whose `model_id` is a hash of its numbers."""
        text = json.dumps(to_json(replace(self, model_id='')), sort_keys=True)
        return replace(self, model_id=hashlib.sha256(text.encode()).hexdigest()[:12])


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
            'cost': {str(j): v for j, v in c.choice.cost.items()},
            'turning_angle': {str(j): v for j, v in c.choice.turning_angle.items()},
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
        },
        'partition': {'pieces': [_piece_json(p) for p in c.partition_pieces]},
        'notes': list(c.notes),
        'optimal': True,
    }


def _piece_from(raw: dict[str, Any]) -> Piece:
    def real(key: str) -> float:
        return math.nan if raw[key] is None else float(raw[key])

    return Piece(
        real('u_from'), real('u_to'), real('slope'), real('intercept'),
        real('slope_stderr'), real('intercept_stderr'), int(raw['samples']),
    )  # fmt: skip


def from_json(raw: object) -> Characteristic:
    """Read the content of ``characteristic.json``.

    Raises
    ------
    DataError
        It is not one, or not one this version can read.
    """
    if not isinstance(raw, dict) or raw.get('format') != FORMAT:
        raise DataError(f"This is no flow characteristic: 'format' must be '{FORMAT}'.")
    if raw.get('version') != VERSION:
        raise DataError(
            f'The characteristic has version {raw.get("version")}, this program reads {VERSION}.'
        )
    try:
        return _read(raw)
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        raise DataError(f'The characteristic is not complete: {error!r} is in the way.') from error


def _read(raw: dict[str, Any]) -> Characteristic:
    def nan_if_null(value: object) -> float:
        return math.nan if value is None else float(value)  # type: ignore[arg-type]

    pieces = tuple(_piece_from(p) for p in raw['pieces'])
    knots = np.array([pieces[0].u_from, *(p.u_to for p in pieces)])
    numbers = [*knots, *(p.slope for p in pieces), *(p.intercept for p in pieces)]
    if not (np.all(np.isfinite(numbers)) and np.all(np.diff(knots) > 0.0)):
        raise ValueError('breakpoints must increase and all numbers be finite')
    window, temperature, segments = raw['window'], raw['temperature'], raw['segments']
    residuals, selection = raw['residuals'], raw['selection']
    return Characteristic(
        pressure_exponent=float(raw['pressure_exponent']),
        pieces=pieces,
        breakpoint_intervals=tuple(
            (nan_if_null(lo), nan_if_null(hi)) for lo, hi in raw['breakpoint_intervals']
        ),
        choice=Choice(
            str(selection['rule']),
            {int(j): float(v) for j, v in selection['cost'].items()},
            {int(j): float(v) for j, v in selection['turning_angle'].items()},
            str(selection.get('note', '')),
        ),
        source=Source(
            int(window['start_ns']), int(window['end_ns']), int(segments['steady']),
            int(segments['slope_response']), int(segments['samples']),
            nan_if_null(temperature['mean_degc']), nan_if_null(temperature['spread_k']),
            bool(temperature['flag']),
        ),
        residuals=ResidualStatistics(
            float(residuals['rmse_mw']), float(residuals['average_sd_mw']),
            float(residuals['average_s']), float(residuals['input_noise']),
            float(residuals['power_noise_mw']),
        ),
        dynamics=tuple(
            RegionDynamics(
                float(d['power_from']), float(d['power_to']), float(d['time_constant_s']),
                float(d['delay_s']), nan_if_null(d.get('time_constant_stderr_s')),
                nan_if_null(d.get('delay_stderr_s')),
            )
            for d in raw['dynamics']
        ),
        partition_pieces=tuple(_piece_from(p) for p in raw.get('partition', {}).get('pieces', [])),
        notes=tuple(str(n) for n in raw.get('notes', [])),
        model_id=str(raw.get('model_id', '')),
    )  # fmt: skip
