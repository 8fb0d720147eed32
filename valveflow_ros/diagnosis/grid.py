"""From a table of samples to the grids of a `Scene`."""

from __future__ import annotations

import numpy as np

from valveflow_ros.diagnosis import kernels
from valveflow_ros.diagnosis.scene import ORDER, Reference, Scene
from valveflow_ros.diagnosis.sensor_noise import sensor_noise
from valveflow_ros.errors import TooFewSamplesError
from valveflow_ros.records import (
    NS_PER_S,
    BoolArray,
    ByteArray,
    FloatArray,
    SampleTable,
    Signal,
)

_BRIDGE_S = 30.0
_BEFORE_GAP_S = 60.0
_LEAST_MEANS = 1000
MODEL_STEP_S, ROUGH_STEP_S = 2.0, 5.0
MEAN_S = 10.0
SUB_S = 1800.0


def make_scene(
    table: SampleTable, step_s: float, exponent: float, settle_s: float, bad: BoolArray,
    rough: bool = False,
) -> Scene:  # fmt: skip
    """Put a table on the grids.

    Parameters
    ----------
    table : SampleTable
    step_s : float
        Step of the table.
    exponent : float
        Of the pressure in u, eq. (1).
    settle_s : float
        Rows this long after a gap are not scored.
    bad : bool (rows, 5)
        Values that are not believed.
    rough : bool
        With longer model rows, for looking round quickly; the scored means are the same.

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
        density = np.where(p > 0.0, p, np.nan) ** exponent

    def coarse(x: FloatArray) -> FloatArray:
        return np.asarray(x.reshape(-1, factor).mean(axis=1)) if len(x) else x

    u = coarse(v * density)
    usable = np.isfinite(u).astype(np.uint8)
    step = factor * step_s
    power, measured = _power(fine[:, Signal.GENERATED_POWER], factor * group)
    scored = measured & _settled(usable, settle_s, step).reshape(-1, group).all(axis=1)
    if int(scored.sum()) < _LEAST_MEANS:
        raise TooFewSamplesError(
            'Means of ten seconds with all signals, far enough behind a gap',
            int(scored.sum()), _LEAST_MEANS, 'A longer record would help.',
        )  # fmt: skip
    m = len(scored)
    whole = scored.copy()
    for k in range(1, ORDER + 1):
        whole[k:] &= scored[:-k]
        whole[:k] = False
    pressure, temperature = _everywhere(coarse(p)), _everywhere(coarse(t))
    return Scene(
        start_ns=int(table.time_ns[0]), fine_s=step_s, step_s=step, settle_s=settle_s,
        exponent=exponent, v=v, density=density, command=fine[:, Signal.VALVE_COMMAND],
        u=np.where(usable > 0, u, 0.0), pressure=pressure, temperature=temperature,
        time_s=np.asarray((np.arange(len(u)) + 0.5) * step - 0.5 * step_s, dtype=np.float64),
        usable=usable,
        power=np.where(scored, power, 0.0), scored=scored, whole=whole,
        sub=np.arange(m) // _sub_rows(m, step * group),
        reference=_reference(pressure, temperature, power, scored, step, v),
    )  # fmt: skip


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
    """Return the means in a sub-block: half an hour, less where a record is short."""
    span = means * mean_s
    return max(6, round(min(SUB_S, max(300.0, span / 160.0)) / mean_s))


def _on_grid(table: SampleTable, step_s: float, bad: BoolArray) -> FloatArray:
    """Return the values on an even grid, NaN where a row is missing or not believed."""
    place = np.round((table.time_ns - table.time_ns[0]) / (step_s * NS_PER_S)).astype(np.int64)
    out = np.full((int(place[-1]) + 1, table.values.shape[1]), np.nan)
    out[place] = np.where(bad, np.nan, table.values)
    return out


def _bridged(x: FloatArray, longest: int) -> FloatArray:
    """Return a series whose short gaps are filled in a straight line."""
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
    """Return a series without NaN: what is missing is taken from its neighbours."""
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
    """Return where the model has forgotten the last gap and the next one is not near."""
    out = np.empty(len(usable), dtype=np.uint8)
    kernels.settled(usable, round(settle_s / step_s), out)
    ahead = round(_BEFORE_GAP_S / step_s)
    gap = np.flatnonzero(usable == 0)
    ok = out > 0
    for back in range(1, ahead + 1) if len(gap) else ():
        ok[np.maximum(gap - back, 0)] = False
    return np.asarray(ok)
