# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Remove the causes of an extended model from a stream of rows.

The pipeline then receives the signals of a plant without the causes:

- a cause of the opening or of the input u is removed from the opening: V' f, where V' is the
  plug position for the measured V, so that u = V' f p^m is the input of the curve;
- a cause of the flow, gain, dynamics or measured power is removed from the power by the
  difference of two simulations, y' = y - (y_extended - y_plain), both run on that u. The
  difference depends on inputs only, so noise of y is neither amplified nor fed back;
- for a late clock the power is delayed to match its inputs: the residual of a row is then
  that of a power with an earlier time stamp.

Hence y' - plain(u') = y - extended(inputs). If both sides use another curve F, this holds up to
the product of the change of F and the size of the cause.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from valveflow_ros.curve.characteristic import HeldCause
from valveflow_ros.curve.regional_model import RegionalModel, make_taps
from valveflow_ros.diagnosis import kernels
from valveflow_ros.diagnosis.cause import FittedCause, Stage
from valveflow_ros.diagnosis.extended import Extended, ExtendedModel, acts_on_scale
from valveflow_ros.diagnosis.grids import Covariate, Grids, Reference
from valveflow_ros.errors import DataError
from valveflow_ros.monitoring.rows import Corrector
from valveflow_ros.records import (
    NS_PER_S,
    ByteArray,
    FloatArray,
    IntArray,
    Quality,
    SampleTable,
    Signal,
)
from valveflow_ros.signals.covariates import parts
from valveflow_ros.state import Memory, State, put_back

# Streaming versions of the causes with memory.
#
# Causes without memory are computed with their own ``act``. The classes here keep a state and
# use the same formulas as the catalogue.

_DRAWS = 10  # the same number of noise realisations as in the catalogue
_SEED = 20_240
_LONGEST_DELAY_S = 660.0
# What covariates do to the power changes over hours, so a missing value may be replaced by the
# last one for this long.
_KEEPS_NS = 6 * 3600 * NS_PER_S


class Valve(Protocol):
    """A cause between the position sensor and the plug."""

    def feed(self, v: FloatArray, time_ns: IntArray) -> FloatArray:
        """Return the opening in % downstream of the cause, shape (n,); NaN stays NaN."""
        ...

    def snapshot(self) -> State:
        """Return the state."""
        ...

    def restore(self, saved: State) -> None:
        """Continue from a saved state."""
        ...


class Stop(Memory):
    """A saturation, or any cause of the opening without a memory."""

    def __init__(self, active: FittedCause, reference: Reference) -> None:
        del reference
        self._active = active

    def feed(self, v: FloatArray, time_ns: IntArray) -> FloatArray:
        """Return the opening from the ``act`` of the cause."""
        del time_ns
        return np.asarray(self._active.cause.act(v, self._active.values, None), dtype=np.float64)


class Slack(Memory):
    """A backlash: the plug stays until one end of the gap reaches it."""

    REMEMBERED = ('_state',)

    def __init__(self, active: FittedCause, reference: Reference) -> None:
        del reference
        self._half = 0.5 * active.values[0]
        self._state = np.full(1, np.nan)

    def feed(self, v: FloatArray, time_ns: IntArray) -> FloatArray:
        """Follow the position; the plug position is kept over gaps."""
        del time_ns
        out = np.empty(len(v))
        kernels.play_block(v, self._half, self._state, out)
        return out


class SlowServo(Memory):
    """A rate limit, with the time between rows."""

    REMEMBERED = ('_state', '_last_ns')

    def __init__(self, active: FittedCause, reference: Reference) -> None:
        del reference
        self._rate = active.values[0]
        self._state, self._last_ns = np.full(1, np.nan), np.zeros(1, dtype=np.int64)

    def feed(self, v: FloatArray, time_ns: IntArray) -> FloatArray:
        """Follow the position; the plug continues to move during a gap."""
        out = np.empty(len(v))
        kernels.rate_limit_block(v, time_ns, self._rate, self._state, self._last_ns, out)
        return out


class Sticking:
    """A stiction, averaged over realisations of the sensor noise.

    The catalogue takes the noise from the record; here it is the noise stored with the model.
    The realisations come from a separate random generator, row by row, so that the block size has
    no effect and a replay gives the same result. All have equal weight: the diagnosis weights
    them by the measured power (`fitting.beliefs`), which explains somewhat more, but here the
    measured power would enter its own prediction.
    """

    def __init__(self, active: FittedCause, reference: Reference) -> None:
        self._band, self._jump = active.values[0], min(active.values[1], active.values[0])
        self._noise = reference.opening_noise
        self._state = np.full(_DRAWS, np.nan)
        self._chance = np.random.default_rng(_SEED)

    def feed(self, v: FloatArray, time_ns: IntArray) -> FloatArray:
        """Return the mean position of the plug."""
        del time_ns
        out = np.empty(len(v))
        noise = self._noise * self._chance.standard_normal((len(v), _DRAWS))
        kernels.stick_slip_block(v, noise, self._band, self._jump, self._state, out)
        return out

    def snapshot(self) -> State:
        """Return the state, including that of the random generator."""
        return {'places': self._state.copy(), 'chance': self._chance.bit_generator.state}

    def restore(self, saved: State) -> None:
        """Continue from a saved state; raises `DataError` if it does not fit."""
        put_back({'places': self._state}, saved)
        self._chance.bit_generator.state = saved['chance']


class Response(Memory):
    """Regional dynamics applied to a stream of flow values."""

    REMEMBERED = ('_place', '_answer', '_past')

    def __init__(self, levels: FloatArray, taps: FloatArray, rows: int) -> None:
        self._levels, self._taps = levels, taps
        self._place, self._answer = np.zeros(2, dtype=np.int64), np.zeros(1)
        self._past = np.zeros(rows)

    @classmethod
    def of(cls, model: RegionalModel, step_s: float) -> Response:
        """Return the dynamics of a model."""
        return cls(model.levels, model.taps(step_s), int(_LONGEST_DELAY_S / step_s) + 4)

    def feed(self, x: FloatArray, begin: ByteArray) -> FloatArray:
        """Return the power in MW, NaN without data."""
        out = np.empty(len(x))
        kernels.respond_block(
            x, begin, self._levels, self._taps, self._place, self._answer, self._past, out
        )
        return out


class Reheater(Response):
    """A reheater before part of the turbine: a fraction of the power has one more lag."""

    def __init__(self, active: FittedCause, step_s: float) -> None:
        share, time_s = active.values
        super().__init__(np.empty(0), make_taps(np.array([time_s]), np.zeros(1), step_s), 3)
        self._share = share

    def feed(self, x: FloatArray, begin: ByteArray) -> FloatArray:
        """Return the measured power."""
        return np.asarray(self._share * x + (1.0 - self._share) * super().feed(x, begin))


class LateClock(Memory):
    """A series delayed by a constant time."""

    REMEMBERED = ('_place', '_past')

    def __init__(self, delay_s: float, step_s: float) -> None:
        late = delay_s / step_s
        self._whole = int(np.floor(late))
        self._part = late - self._whole
        self._place, self._past = np.zeros(2, dtype=np.int64), np.zeros(self._whole + 2)

    def feed(self, y: FloatArray, jumps: ByteArray) -> FloatArray:
        """Return the delayed series; NaN where the earlier value is unknown."""
        out = np.empty(len(y))
        kernels.delay(y, jumps, self._whole, self._part, self._place, self._past, out)
        return out


_VALVES: dict[str, Callable[[FittedCause, Reference], Valve]] = {
    'backlash': Slack,
    'stiction': Sticking,
    'rate_limit': SlowServo,
    'saturation': Stop,
}
REHEATER, CLOCK = 'reheater', 'clock'
_SHOWN = {REHEATER, CLOCK, 'output_offset_drift'}


def valves(chain: tuple[FittedCause, ...], reference: Reference) -> list[Valve]:
    """Return the streaming versions of the causes of the opening, from actuator to plug."""
    return [_VALVES[a.name](a, reference) for a in sorted(chain, key=lambda a: a.cause.order)]


def check_streams(active: tuple[FittedCause, ...]) -> None:
    """Raise if a cause has no streaming version here.

    Raises
    ------
    DataError
    """
    for a in active:
        known = {Stage.OPENING: set(_VALVES), Stage.OUTPUT: _SHOWN}.get(a.cause.stage)
        if known is not None and a.name not in known:
            raise DataError(f"The cause '{a.name}' cannot be taken out of rows as they come yet.")


# SIMD code of functions like exp needs full vectors; padded blocks give identical rounding.
_HANDFUL = 16


def covariates_of(given: ExtendedModel | None) -> dict[str, Covariate]:
    """Return the covariates that the causes of a model follow, by name."""
    if given is None:
        return {}
    own = (a.cause.covariate for a in given.model.active)
    return {**covariates_of(given.on_top_of), **{about.name: about for about in own if about}}


def corrector_of(
    given: ExtendedModel, step_s: float, covariates: tuple[str, ...] = ()
) -> Corrector:
    """Return the object that removes all causes of a model from rows ``step_s`` apart.

    Parameters
    ----------
    given : ExtendedModel
    step_s : float
    covariates : tuple of str
        Entries of the columns in `SampleTable.covariates`; see `signals.covariates`.

    Raises
    ------
    DataError
        A cause has no streaming version, or follows a covariate that the rows do not have.
    """
    own = ModelCorrector(given, step_s, covariates)
    if given.on_top_of is None:
        return own
    return ChainCorrector(corrector_of(given.on_top_of, step_s, covariates), own)


class Beside(Memory):
    """The values of the covariates that causes follow, without gaps of a few hours.

    Parameters
    ----------
    about : tuple of Covariate
    entries : tuple of str
        Entries of the columns in `SampleTable.covariates`.

    Raises
    ------
    DataError
        One has no column, or a column in another unit.
    """

    REMEMBERED = ('_last', '_last_ns')

    def __init__(self, about: tuple[Covariate, ...], entries: tuple[str, ...]) -> None:
        columns = {name: (k, unit) for k, (name, _, unit) in enumerate(map(parts, entries))}
        self._about, self._places = about, []
        for a in about:
            if a.name not in columns:
                raise DataError(
                    f"The model has the cause '{a.name}', which follows the column '{a.column}'. "
                    f"Name that column as covariate '{a.name}', or use a model without this cause."
                )
            place, unit = columns[a.name]
            if unit and a.unit and unit != a.unit:
                raise DataError(
                    f"The covariate '{a.name}' is in {unit}, but the model has it in {a.unit}."
                )
            self._places.append(place)
        self._last = np.full(len(about), np.nan)
        self._last_ns = np.zeros(len(about), dtype=np.int64)

    def feed(self, table: SampleTable) -> dict[str, tuple[Covariate, FloatArray]]:
        """Return each covariate with its values, (n,); the last one holds for up to six hours."""
        found = {}
        for k, (about, place) in enumerate(zip(self._about, self._places, strict=True)):
            assert table.covariates is not None
            times = np.concatenate([self._last_ns[k : k + 1], table.time_ns])
            values = np.concatenate([self._last[k : k + 1], table.covariates[:, place]])
            last = np.maximum.accumulate(np.where(np.isfinite(values), np.arange(len(values)), 0))
            self._last[k], self._last_ns[k] = values[last[-1]], times[last[-1]]
            old = times - times[last] > _KEEPS_NS
            found[about.name] = about, np.where(old, np.nan, values[last])[1:]
        return found


class ChainCorrector:
    """Two correctors in sequence."""

    def __init__(self, first: Corrector, second: Corrector) -> None:
        self._first, self._second = first, second

    @property
    def held(self) -> tuple[HeldCause, ...]:
        """Return the causes of both."""
        return self._first.held + self._second.held

    def correct(self, table: SampleTable) -> SampleTable:
        """Apply both corrections."""
        return self._second.correct(self._first.correct(table))

    def restart(self) -> None:
        """Forget all rows."""
        self._first.restart()
        self._second.restart()

    def snapshot(self) -> State:
        """Return the state of both."""
        return {'first': self._first.snapshot(), 'second': self._second.snapshot()}

    def restore(self, saved: State) -> None:
        """Continue from a saved state; raises `DataError` if it does not fit."""
        self._first.restore(saved['first'])
        self._second.restore(saved['second'])


class ModelCorrector(Memory):
    """Remove the causes of one extended model from rows.

    Parameters
    ----------
    given : ExtendedModel
    step_s : float
        Step of the rows.
    covariates : tuple of str
        Entries of the columns in `SampleTable.covariates`.

    Notes
    -----
    Outside the record of the model, a drift continues in a straight line, a step stays, a daily
    cycle repeats, and ``intervals`` keep the state of their last switch, because later ones are
    unknown. Before the record a drift is extrapolated backwards.

    After a gap the responses begin in equilibrium, as in the simulation; the plug keeps its
    position. The power of a late clock is unknown for the duration of the delay, and that of a
    row without a covariate once its last value is six hours old.

    Raises
    ------
    DataError
        A cause has no streaming version, or follows a covariate that the rows do not have.
    """

    REMEMBERED = ('_temperature', '_follows')

    def __init__(
        self, given: ExtendedModel, step_s: float, covariates: tuple[str, ...] = ()
    ) -> None:
        check_streams(given.model.active)
        self._given, self._step_s = given, step_s
        own = tuple(a.cause.covariate for a in given.model.active if a.cause.covariate)
        self._covariates = own, covariates
        self._model = given.model
        self.held = replace(given, on_top_of=None).held
        self._inputs = self._model.at(Stage.INPUT)
        on_scale = [a for a in self._inputs if acts_on_scale(a, given.form)]
        self._flows, self._gains = self._model.at(Stage.FLOW), self._model.at(Stage.GAIN)
        self._shown = sorted(
            (a for a in self._model.at(Stage.OUTPUT) if a.name != CLOCK),
            key=lambda a: a.cause.order,
        )
        differs = (
            *on_scale,
            *self._flows,
            *self._gains,
            *self._shown,
            *self._model.at(Stage.DYNAMICS),
        )
        self._differs = bool(differs)
        self.restart()

    def restart(self) -> None:
        """Forget all rows."""
        reference, step = self._given.reference, self._step_s
        self._valves = valves(self._model.at(Stage.OPENING), reference)
        self._plain = Response.of(self._model.base, step)
        self._extended = Response.of(self._model.regional, step)
        self._reheaters = {a.name: Reheater(a, step) for a in self._shown if a.name == REHEATER}
        late = [a.values[0] for a in self._model.active if a.name == CLOCK]
        self._clock = LateClock(sum(late), step) if late else None
        self._beside = Beside(*self._covariates)
        self._temperature = np.array([reference.temperature_degc])
        self._follows = np.array([np.iinfo(np.int64).min // 2, kernels.NO_DATA], dtype=np.int64)

    def snapshot(self) -> State:
        """Return the state."""
        return {
            **super().snapshot(),
            'parts': [part.snapshot() for part in self._parts()],
            'causes': self._causes(),
        }

    def restore(self, saved: State) -> None:
        """Continue from a saved state; raises `DataError` if it does not fit."""
        if saved['causes'] != self._causes():
            raise DataError('The saved state was made with another model_file.')
        super().restore(saved)
        for part, given in zip(self._parts(), saved['parts'], strict=True):
            part.restore(given)

    def _causes(self) -> list[Any]:
        """Return an identifier of the removed causes and values; a state must match it."""
        base = self._model.base
        curve = [base.knots.tolist(), base.left.tolist(), base.right.tolist()]
        return [curve, *([a.name, list(a.values), list(a.extra)] for a in self._model.active)]

    def _parts(self) -> list[Valve | Memory]:
        clock = [] if self._clock is None else [self._clock]
        beside = [self._beside] if self._covariates[0] else []
        return [
            *self._valves, self._plain, self._extended, *self._reheaters.values(), *clock, *beside,
        ]  # fmt: skip

    def correct(self, table: SampleTable) -> SampleTable:
        """Return the rows without the causes."""
        if not self._model.active or not len(table):
            return table
        opening = table.column(Signal.VALVE_OPENING).copy()
        for valve in self._valves:
            opening = valve.feed(opening, table.time_ns)
        grids = self._scene(table, opening)
        factor, scale = np.ones(len(grids.u)), grids.scale
        u = grids.u
        for a in self._inputs:
            part = a.cause.act(u, a.values, grids, self._model.base)
            if acts_on_scale(a, grids.form):
                scale = scale * part
            else:
                u, factor = u * part, factor * part
        for _, values in grids.covariates.values():
            u = np.where(np.isfinite(values), u, np.nan)
        n = len(table)
        jumps, begin = self._beginnings(table.time_ns, u[:n])
        power = table.column(Signal.GENERATED_POWER).copy()
        if self._clock is not None:
            power = self._clock.feed(power, jumps)
        if self._differs:
            power -= self._difference(grids, u, scale, begin)[:n]
        return _with(table, opening * factor[:n], power)

    def _scene(self, table: SampleTable, opening: FloatArray) -> Grids:
        """Return the rows as grids for causes without memory, padded to full vectors."""
        pressure = np.ascontiguousarray(table.column(Signal.MAIN_STEAM_PRESSURE))
        u, scale = self._given.form.of_rows(opening, pressure)
        scale = np.ones(len(u)) if scale is None else scale
        temperature = np.empty(len(table))
        kernels.filled(
            np.ascontiguousarray(table.column(Signal.MAIN_STEAM_TEMPERATURE)),
            self._temperature, temperature,
        )  # fmt: skip
        time_s = (table.time_ns - self._given.start_ns) / NS_PER_S
        columns = (opening, pressure, u, scale, temperature, time_s)
        v, p, u, scale, temperature, time_s = (_padded(c) for c in columns)
        none = np.zeros(len(u), dtype=bool)
        return Grids(
            start_ns=self._given.start_ns, fine_s=self._step_s, step_s=self._step_s,
            settle_s=0.0, form=self._given.form, v=v, density=np.ones(len(u)),
            command=v, u=u, scale=scale, pressure=p, temperature=temperature, time_s=time_s,
            usable=np.isfinite(u).astype(np.uint8), power=np.zeros(len(u)), scored=none,
            whole=none, sub=np.zeros(len(u), dtype=np.int64), reference=self._given.reference,
            covariates={
                name: (about, _padded(values))
                for name, (about, values) in self._beside.feed(table).items()
            },
        )  # fmt: skip

    def _beginnings(self, time_ns: IntArray, u: FloatArray) -> tuple[ByteArray, ByteArray]:
        jumps = np.empty(len(u), dtype=np.uint8)
        begin = np.empty(len(u), dtype=np.uint8)
        gap_ns = round(1.5 * self._step_s * NS_PER_S)
        kernels.beginnings(time_ns, u, gap_ns, self._follows, jumps, begin)
        return jumps, begin

    def _difference(
        self, grids: Grids, u: FloatArray, scale: FloatArray, begin: ByteArray
    ) -> FloatArray:
        """Return the power of the extended model minus that of the plain one, MW."""
        n = len(begin)
        plain, x = _flow(self._model, u, grids.scale), _flow(self._model, u, scale)
        for a in self._flows:
            x += a.cause.act(u, a.values, grids)
        for a in self._gains:
            x *= a.cause.act(a.values, grids, a.extra)
        y = np.full(len(u), np.nan)
        y[:n] = self._extended.feed(x[:n], begin)
        for a in self._shown:
            y = self._show(a, y, grids, begin)
        y[:n] -= self._plain.feed(plain[:n], begin)
        return y

    def _show(self, a: FittedCause, y: FloatArray, grids: Grids, begin: ByteArray) -> FloatArray:
        if a.name not in self._reheaters:
            return np.asarray(a.cause.act(y, a.values, grids))
        out = y.copy()
        out[: len(begin)] = self._reheaters[a.name].feed(y[: len(begin)], begin)
        return out


def _flow(model: Extended, u: FloatArray, scale: FloatArray) -> FloatArray:
    """Return the flow without causes in MW."""
    x = np.empty(len(u))
    m = model.base
    kernels.flow(u, scale, m.offset, m.knots, m.left, m.right, x)
    return x


def _padded(x: FloatArray) -> FloatArray:
    """Return a copy padded with its last value to full vectors."""
    return np.concatenate([x, np.full(-len(x) % _HANDFUL, x[-1])])


def _with(table: SampleTable, opening: FloatArray, power: FloatArray) -> SampleTable:
    """Return the rows with another opening and power."""
    values, quality = table.values.copy(), table.quality.copy()
    for signal, column in ((Signal.VALVE_OPENING, opening), (Signal.GENERATED_POWER, power)):
        values[:, signal] = column
        quality[~np.isfinite(column), signal] = Quality.BAD
        values[~np.isfinite(column), signal] = np.nan
    return SampleTable(table.time_ns, values, quality, table.covariates)
