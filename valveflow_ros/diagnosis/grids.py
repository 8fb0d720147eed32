# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A record on the grids of the diagnosis: fine rows, model rows, scored means, blocks."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from valveflow_ros.diagnosis import kernels
from valveflow_ros.errors import TooFewSamplesError
from valveflow_ros.numerics import output_size
from valveflow_ros.records import (
    COARSE_STEP_S,
    NS_PER_S,
    BoolArray,
    ByteArray,
    FloatArray,
    SampleTable,
    Signal,
)
from valveflow_ros.signals.compression import Compression
from valveflow_ros.signals.static_form import StaticForm

DAY_S = 86_400.0
SUBS_IN_BLOCK = 8
FOLDS = 5
SEALED_FOLD = 4
ORDER = 4


@dataclass(frozen=True, slots=True)
class Reference:
    """Reference values of causes; stored with an extended model and used for other records too.

    Attributes
    ----------
    span_s : float
        Length of the record.
    temperature_degc, log_pressure : float
        Means over it.
    pressure_level, pressure_slope : float
        Straight line of the sliding pressure over the power, MPa and MPa per MW.
    opening_noise : float
        Standard deviation of the white noise of the opening, %; 0 if unknown.
    """

    span_s: float
    temperature_degc: float
    log_pressure: float
    pressure_level: float
    pressure_slope: float
    opening_noise: float = 0.0


@dataclass(frozen=True, slots=True)
class Blur:
    """Effects that sampling or compression of the record hides.

    Attributes
    ----------
    time_s : float
        Lags and delays below this value cannot be judged.
    opening_percent : float
        A backlash of the valve below this value cannot be judged.
    words : str
        The reason, as the beginning of a sentence; empty if nothing is hidden.
    compressed : bool
        True if values were held constant by compression.
    """

    time_s: float = 0.0
    opening_percent: float = 0.0
    words: str = ''
    compressed: bool = False

    def least_s(self, name: str) -> float:
        """Return the least time of a cause that can be judged; that of a clock needs half."""
        return 0.5 * self.time_s if self.compressed and name == 'clock' else self.time_s


@dataclass(frozen=True, slots=True)
class Covariate:
    """A column in addition to the signals that the power may follow.

    Attributes
    ----------
    name : str
        Name given by the user; also the name of the cause.
    column, unit : str
        Column or topic that it comes from, and its unit ('' if unknown).
    spread : float
        Standard deviation from the usual value at the load, in that unit.
    power_mw : float
        Mean of the power over the record.
    centre : tuple of float
        Mean and standard deviation of u, then of the pressure in MPa.
    surface : tuple of float
        Load over ``power_mw``: coefficients of the powers of scaled u and pressure up to 3.
    course : tuple of float
        Usual value at a load: coefficients of the powers 0 to 2 of the load.
    """

    name: str
    column: str
    unit: str
    spread: float
    power_mw: float
    centre: tuple[float, ...]
    surface: tuple[float, ...]
    course: tuple[float, ...]

    def terms(self, u: FloatArray, pressure: FloatArray, values: FloatArray) -> FloatArray:
        """Return the covariate minus its usual value, L - 1 and its square, shape (3, n).

        L is the load over ``power_mw`` at an input and a pressure in MPa.
        """
        load = _powers(u, pressure, self.centre) @ np.array(self.surface)
        usual = np.polynomial.polynomial.polyval(load, np.array(self.course))
        return np.stack([values - usual, load - 1.0, (load - 1.0) ** 2])


_CUBIC = tuple((i, j) for i in range(4) for j in range(4 - i))
COEFFICIENTS, COURSE = len(_CUBIC), 3
_FAR = 2.5  # standard deviations beyond which the surface is constant


def _powers(u: FloatArray, pressure: FloatArray, centre: tuple[float, ...]) -> FloatArray:
    """Return the powers of the scaled input and pressure, shape (n, `COEFFICIENTS`)."""
    a = np.clip((u - centre[0]) / centre[1], -_FAR, _FAR)
    b = np.clip((pressure - centre[2]) / centre[3], -_FAR, _FAR)
    return np.column_stack([a**i * b**j for i, j in _CUBIC])


@dataclass(frozen=True, slots=True)
class CovariateRows:
    """The values of a covariate on the rows of a table, (rows,); NaN if missing."""

    name: str
    column: str
    unit: str
    values: FloatArray

    @property
    def covered(self) -> float:
        """Return the share of the rows with a value."""
        return float(np.isfinite(self.values).mean())

    @property
    def few(self) -> str:
        """Return a sentence on the rows that have a value."""
        return (
            f"'{self.column}' has values for only {100.0 * self.covered:.0f} % of the rows; half "
            'of them are needed.'
        )


LEAST_COVERED = 0.5  # of the rows must have a value of a covariate


@dataclass(frozen=True, slots=True)
class Grids:
    """All measurements as arrays for the model and the statistics.

    Attributes
    ----------
    start_ns, fine_s, step_s : int, float, float
        Time of the first row, step of the fine rows and of the model rows.
    form : StaticForm
    v, density : float64 (nn,)
        Opening in % and p^q on the fine grid, NaN if missing.
    command : float64 (nn,)
        Commanded opening in %, NaN if missing.
    u, pressure, temperature, time_s : float64 (n,)
        Model rows: V p^q, MPa, degC, seconds since the first row.
    scale : float64 (n,)
        Model rows: p^e.
    usable : uint8 (n,)
    power : float64 (m,)
        Scored means of the power in MW; 0 where not scored.
    scored : bool (m,)
        Means with power whose inputs have settled.
    whole : bool (m,)
        Scored, with enough earlier means for whitening.
    sub : int64 (m,)
        Sub-block of each mean. Sub-blocks form blocks; the sealed blocks are the test data.
    reference : Reference
    blur : Blur
    covariates : dict
        Covariate by name, with its values on the model rows, shape (n,); gaps are interpolated.
    """

    start_ns: int
    fine_s: float
    step_s: float
    settle_s: float
    form: StaticForm
    v: FloatArray
    density: FloatArray
    command: FloatArray
    u: FloatArray
    scale: FloatArray
    pressure: FloatArray
    temperature: FloatArray
    time_s: FloatArray
    usable: ByteArray
    power: FloatArray
    scored: BoolArray
    whole: BoolArray
    sub: np.ndarray
    reference: Reference
    blur: Blur = field(default_factory=Blur)
    cache: dict[object, FloatArray] = field(default_factory=dict)
    covariates: dict[str, tuple[Covariate, FloatArray]] = field(default_factory=dict)

    @property
    def group(self) -> int:
        """Return the number of model rows in a scored mean."""
        return len(self.u) // len(self.power)

    @property
    def size(self) -> float:
        """Return the output range relative to a unit of 300 MW; see `output_size`."""
        return output_size(self.power)

    @property
    def mean_s(self) -> float:
        """Return the length of a scored mean."""
        return self.group * self.step_s

    @property
    def subs(self) -> int:
        """Return the number of sub-blocks."""
        return int(self.sub[-1]) + 1

    @property
    def block_of_sub(self) -> np.ndarray:
        """Return the block of each sub-block, shape (subs,)."""
        return np.arange(self.subs) // SUBS_IN_BLOCK

    @property
    def fold_of_sub(self) -> np.ndarray:
        """Return the fold of each sub-block; `SEALED_FOLD` is the test fold."""
        return self.block_of_sub % FOLDS

    @property
    def days(self) -> float:
        """Return the time from first to last row in days."""
        return float(len(self.u) * self.step_s / DAY_S)

    @property
    def open_rows(self) -> BoolArray:
        """Return the whole means outside the sealed blocks (training data), shape (m,)."""
        return np.asarray(self.whole & (self.fold_of_sub[self.sub] != SEALED_FOLD))

    @property
    def sealed_rows(self) -> BoolArray:
        """Return the whole means inside the sealed blocks (test data), shape (m,)."""
        return np.asarray(self.whole & (self.fold_of_sub[self.sub] == SEALED_FOLD))

    @property
    def sub_middle_s(self) -> FloatArray:
        """Return the middle of each sub-block, seconds since the first row."""
        count = np.bincount(self.sub, minlength=self.subs)
        ends = np.cumsum(count) * self.mean_s
        return np.asarray(ends - 0.5 * count * self.mean_s)

    def clock_s(self, time_s: FloatArray) -> FloatArray:
        """Return times since the first row as seconds since a midnight UTC."""
        first = self.start_ns % (int(DAY_S) * NS_PER_S) / NS_PER_S
        return np.asarray(np.mod(time_s + first, DAY_S))

    def means(self, rows: FloatArray) -> FloatArray:
        """Return means of model rows over the scored means, (n,) to (m,) or (n, k) to (m, k)."""
        if rows.ndim == 2:
            return np.asarray(rows.reshape(-1, self.group, rows.shape[1]).mean(axis=1))
        out = np.empty(len(self.power))
        kernels.means(rows, self.group, out)
        return out

    def coarse(self, fine: FloatArray) -> FloatArray:
        """Return means of fine rows over the model rows, (nn,) to (n,)."""
        out = np.empty(len(self.u))
        kernels.means(fine, len(fine) // len(self.u), out)
        return out


# The noise of the position sensor, estimated while the opening varies.

_KEPT = 0.8  # fraction of the increments without moves of the frequency control
_OF_NORMAL = 0.4377  # mean square of that fraction relative to all, for a normal distribution
_PARTS, _LEAST_ROWS = 12, 50


def sensor_noise(v: FloatArray) -> float:
    """Return an upper estimate of the sd of the white noise of a position, in its own unit.

    Rows at a distance of h differ by D(h) = E (v[t + h] - v[t])^2. White noise adds twice its
    variance to D at every h > 0; a parabola through D(1), D(2), D(3), extrapolated to h = 0, gives
    this part. It is computed on parts of the record, and the standard error of their mean is
    added: simulated paths with zero noise would all be identical.

    Parameters
    ----------
    v : float64 (n,)
        Positions at a constant step, NaN if missing.
    """
    parts = [p for p in np.array_split(v, _PARTS) if np.isfinite(p).sum() >= _LEAST_ROWS]
    if not parts:
        return 0.0
    lifts = np.array([_lift(p) for p in parts])
    error = float(lifts.std()) / np.sqrt(max(len(lifts) - 1, 1))
    return float(np.sqrt(max(float(lifts.mean()) + error, 0.0) / 2.0))


def _lift(v: FloatArray) -> float:
    """Return twice the variance of the noise, estimated from one part; it may be negative."""
    lifted = []
    for h in (1, 2, 3):
        apart = np.abs(v[h:] - v[:-h])
        apart = apart[np.isfinite(apart)]
        if not len(apart):
            return 0.0
        # A fixed number, not all below a limit: in a rounded record thousands equal the limit.
        count = max(1, round(_KEPT * len(apart)))
        kept = np.partition(apart, count - 1)[:count]
        lifted.append(float(np.mean(kept**2)) / _OF_NORMAL)
    return 3.0 * lifted[0] - 3.0 * lifted[1] + lifted[2]


# Effects hidden by sampling and compression.

_STEPS_HIDDEN = 1.0  # lags shorter than this many steps of a coarse table
_MOVES_HIDDEN = 3.0  # a backlash below this many typical moves of the opening within a row
_BANDS_HIDDEN = 4.0  # or this many dead bands


def blur_of(v: FloatArray, step_s: float, compression: Compression | None) -> Blur:
    """Return what this step or compression of a record hides.

    Parameters
    ----------
    v : float64 (n,)
        Opening in %, row by row.
    """
    if compression is not None:
        # Lags show in the power: its values must be closer together than they last.
        power = compression.updates.get(Signal.GENERATED_POWER)
        interval_s = compression.interval_s if power is None else power.interval_s
        opening = compression.updates.get(Signal.VALVE_OPENING)
        band = 0.0 if opening is None else _BANDS_HIDDEN * opening.dead_band
        return Blur(
            max(interval_s, step_s if step_s >= COARSE_STEP_S else 0.0),
            max(band, _usual_move(v)),
            'cannot be judged: values of the power in this compressed log are typically '
            f'{interval_s:.0f} s apart, which hides',
            True,
        )  # fmt: skip
    if step_s < COARSE_STEP_S:
        return Blur()
    return Blur(
        _STEPS_HIDDEN * step_s, _usual_move(v),
        f'cannot be judged at this sampling: rows {step_s:g} s apart hide',
    )  # fmt: skip


def _usual_move(v: FloatArray) -> float:
    moves = np.abs(np.diff(v))
    moves = moves[np.isfinite(moves)]
    return _MOVES_HIDDEN * float(np.quantile(moves, 0.9)) if len(moves) else 0.0


# Conversion of a table of samples to `Grids`.

_BRIDGE_S = 30.0
_BEFORE_GAP_S = 60.0
_LEAST_MEANS = 1000
MODEL_STEP_S, ROUGH_STEP_S = 2.0, 5.0
MEAN_S = 10.0
SUB_S = 1800.0


def make_grids(
    table: SampleTable, step_s: float, form: StaticForm, settle_s: float, bad: BoolArray,
    rough: bool = False, compression: Compression | None = None,
    covariates: tuple[CovariateRows, ...] = (),
) -> Grids:  # fmt: skip
    """Put a table on the grids.

    Parameters
    ----------
    table : SampleTable
    step_s : float
        Step of the table.
    exponent : float
        Exponent of the pressure in u, eq. (1).
    settle_s : float
        Rows this long after a gap are not scored.
    bad : bool (rows, 5)
        Invalid values.
    rough : bool
        Use longer model rows, for faster screening; the scored means are the same.
    compression : Compression, optional
        How the record was compressed, if it was.
    covariates : tuple of CovariateRows
        Covariates on the rows of the table.

    Raises
    ------
    TooFewSamplesError
        Too little of the record can be scored.
    """
    fine = _on_grid(table, step_s, bad)
    factor = max(1, round(MODEL_STEP_S / step_s))
    group = max(1, round(MEAN_S / (factor * step_s)))
    if rough:
        factor, group = _longer(factor, group, step_s)
    rows = len(fine) // (factor * group) * factor * group
    fine = fine[:rows]
    v, p, t = (
        _bridged(fine[:, s], round(_BRIDGE_S / step_s))
        for s in (Signal.VALVE_OPENING, Signal.MAIN_STEAM_PRESSURE, Signal.MAIN_STEAM_TEMPERATURE)
    )
    with np.errstate(invalid='ignore'):
        positive = np.where(p > 0.0, p, np.nan)
        # If p is unknown, its power and u are unknown too.
        density = np.where(np.isfinite(positive), positive**form.input_exponent, np.nan)

    def coarse(x: FloatArray) -> FloatArray:
        return np.asarray(x.reshape(-1, factor).mean(axis=1)) if len(x) else x

    u = coarse(v * density)
    usable = np.isfinite(u).astype(np.uint8)
    step = factor * step_s
    power, measured = _power(fine[:, Signal.GENERATED_POWER], factor * group)
    scored = measured & _settled(usable, settle_s, step).reshape(-1, group).all(axis=1)
    if int(scored.sum()) < _LEAST_MEANS:
        raise TooFewSamplesError(
            ('Means of ten seconds' if step_s <= MEAN_S else 'Rows')
            + ' with all signals, far enough behind a gap',
            int(scored.sum()), _LEAST_MEANS, 'A longer record would help.',
        )  # fmt: skip
    m = len(scored)
    whole = scored.copy()
    for k in range(1, ORDER + 1):
        whole[k:] &= scored[:-k]
        whole[:k] = False
    pressure, temperature = _everywhere(coarse(p)), _everywhere(coarse(t))
    return Grids(
        start_ns=int(table.time_ns[0]), fine_s=step_s, step_s=step, settle_s=settle_s,
        form=form, v=v, density=density, command=fine[:, Signal.VALVE_COMMAND],
        u=np.where(usable > 0, u, 0.0),
        scale=np.where(usable > 0, coarse(positive**form.scale_exponent), 1.0),
        pressure=pressure, temperature=temperature,
        time_s=np.asarray((np.arange(len(u)) + 0.5) * step - 0.5 * step_s, dtype=np.float64),
        usable=usable,
        power=np.where(scored, power, 0.0), scored=scored, whole=whole,
        sub=np.arange(m) // _sub_rows(m, step * group),
        reference=_reference(pressure, temperature, power, scored, step, v),
        blur=blur_of(v, step_s, compression),
        covariates={
            c.name: _covariate(
                c, coarse(_everywhere(_spread(table, step_s, c.values)[:rows])), u, pressure,
                np.where(scored, power, np.nan),
            )
            for c in covariates
        },
    )  # fmt: skip


def _covariate(
    rows: CovariateRows, values: FloatArray, u: FloatArray, pressure: FloatArray, power: FloatArray
) -> tuple[Covariate, FloatArray]:
    """Return a covariate with its usual value at each load, and its values.

    The load is a smooth function of u and pressure, so it contains no noise of the power. Rows are
    weighted by the load, because the cause multiplies by it.
    """
    a, b, c = (x.reshape(len(power), -1).mean(axis=1) for x in (u, pressure, values))
    here = np.isfinite(power) & np.isfinite(a)
    a, b, c, y = a[here], b[here], c[here], power[here]
    centre = float(a.mean()), float(a.std()) or 1.0, float(b.mean()), float(b.std()) or 1.0
    usual_mw = max(float(y.mean()), 1e-3)
    powers = _powers(a, b, centre)
    surface = np.linalg.lstsq(powers, y / usual_mw, rcond=1e-9)[0]
    load = powers @ surface
    course = np.linalg.lstsq(
        np.vander(load, COURSE, increasing=True) * load[:, None], c * load, rcond=1e-9
    )[0]
    about = Covariate(
        rows.name, rows.column, rows.unit, 0.0, usual_mw, centre, tuple(surface.tolist()),
        tuple(course.tolist()),
    )  # fmt: skip
    return replace(about, spread=float(about.terms(a, b, c)[0].std())), values


def _reference(
    pressure: FloatArray, temperature: FloatArray, power: FloatArray, scored: BoolArray,
    step_s: float, opening: FloatArray,
) -> Reference:  # fmt: skip
    """Return the means of a record and its line of sliding pressure."""
    means = pressure.reshape(len(power), -1).mean(axis=1)[scored]
    slope, level = np.polyfit(power[scored], means, 1) if np.ptp(power[scored]) else (0.0, 1.0)
    log = np.log(np.maximum(pressure, 1e-6))
    return Reference(
        len(pressure) * step_s, float(temperature.mean()), float(log.mean()), float(level),
        float(slope), sensor_noise(opening),
    )  # fmt: skip


def _longer(factor: int, group: int, step_s: float) -> tuple[int, int]:
    """Return the longest model rows that divide a scored mean and are not above the limit."""
    rows = factor * group
    fits = [d for d in range(1, rows + 1) if rows % d == 0 and d * step_s <= ROUGH_STEP_S]
    longest = max([factor, *fits])
    return longest, rows // longest


def _sub_rows(means: int, mean_s: float) -> int:
    """Return the number of means in a sub-block: half an hour, less in a short record."""
    span = means * mean_s
    return max(6, round(min(SUB_S, max(300.0, span / 160.0)) / mean_s))


def _on_grid(table: SampleTable, step_s: float, bad: BoolArray) -> FloatArray:
    """Return the values on an even grid, NaN where a row is missing or invalid."""
    return _spread(table, step_s, np.where(bad, np.nan, table.values))


def _spread(table: SampleTable, step_s: float, values: FloatArray) -> FloatArray:
    """Return values of the rows of a table, (rows, ...), on the even grid of its times."""
    place = np.round((table.time_ns - table.time_ns[0]) / (step_s * NS_PER_S)).astype(np.int64)
    out = np.full((int(place[-1]) + 1, *values.shape[1:]), np.nan)
    out[place] = values
    return out


def _bridged(x: FloatArray, longest: int) -> FloatArray:
    """Return a series whose short gaps are filled by linear interpolation."""
    good = np.isfinite(x)
    if good.all() or not good.any():
        return x
    at = np.flatnonzero(good)
    out = np.interp(np.arange(len(x)), at, x[at])
    index = np.arange(len(x))
    before = np.maximum.accumulate(np.where(good, index, -1))
    after = np.minimum.accumulate(np.where(good, index, len(x))[::-1])[::-1]
    out[(after - before > longest + 1) | (before < 0) | (after >= len(x))] = np.nan
    out[good] = x[good]
    return np.asarray(out)


def _everywhere(x: FloatArray) -> FloatArray:
    """Return a series without NaN: missing values are interpolated."""
    good = np.flatnonzero(np.isfinite(x))
    return np.interp(np.arange(len(x)), good, x[good]) if len(good) else np.zeros(len(x))


def _power(power: FloatArray, rows: int) -> tuple[FloatArray, BoolArray]:
    """Return means of the power over ``rows`` and where at least half of them were measured."""
    table = power.reshape(-1, rows)
    good = np.isfinite(table)
    count = good.sum(axis=1)
    mean = np.where(good, table, 0.0).sum(axis=1) / np.maximum(count, 1)
    return np.asarray(mean), np.asarray(2 * count >= max(rows, 1))


def _settled(usable: ByteArray, settle_s: float, step_s: float) -> BoolArray:
    """Return where the effect of the last gap has decayed and the next gap is not near."""
    out = np.empty(len(usable), dtype=np.uint8)
    kernels.settled(usable, round(settle_s / step_s), out)
    ahead = round(_BEFORE_GAP_S / step_s)
    gap = np.flatnonzero(usable == 0)
    ok = out > 0
    for back in range(1, ahead + 1) if len(gap) else ():
        ok[np.maximum(gap - back, 0)] = False
    return np.asarray(ok)
