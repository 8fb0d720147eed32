# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Data types used in all packages: signals, qualities, readings, samples, segments.

Records are frozen and slotted; arrays inside them are never changed after their
creation. Names contain the units; times are int64 nanoseconds since the Unix
epoch.
"""

from __future__ import annotations

import enum
import math
import re
import zoneinfo
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import timedelta, timezone, tzinfo
from typing import Any

import numpy as np
from numpy.typing import NDArray

from valveflow_ros.errors import InputError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
ByteArray = NDArray[np.uint8]
BoolArray = NDArray[np.bool_]

NS_PER_S = 1_000_000_000
# Rows as far apart or farther hide times shorter than their step; messages count them in rows.
COARSE_STEP_S = 20.0


class Signal(enum.IntEnum):
    """The five inputs, in the order of the columns of tables."""

    VALVE_OPENING = 0
    MAIN_STEAM_PRESSURE = 1
    MAIN_STEAM_TEMPERATURE = 2
    GENERATED_POWER = 3
    VALVE_COMMAND = 4


class Quality(enum.IntEnum):
    """The quality of a value; `logs.names.qualities` converts the codes of messages."""

    GOOD = 0
    UNCERTAIN = 1
    BAD = 2


# An output that is a flow keeps its unit: no factor converts tonnes to megawatts, and the engine
# needs no specific unit. Values named ``_mw`` or described as MW then have this unit.
FLOW_UNITS = (
    't/h', 'kg/h', 'kg/s', 'm3/h', 'Nm3/h', 'l/s', 'l/min', 'klb/h', 'lb/h', 'gpm', 'scfm',
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class SignalInfo:
    """The external names of a signal and its unit in the engine."""

    signal: Signal
    topic: str
    column: str
    unit: str
    required: bool


SIGNALS: tuple[SignalInfo, ...] = (
    SignalInfo(Signal.VALVE_OPENING, 'valve_opening', 'valve_opening_percent', '%', True),
    SignalInfo(
        Signal.MAIN_STEAM_PRESSURE, 'main_steam_pressure', 'main_steam_pressure_mpa', 'MPa', True
    ),
    SignalInfo(
        Signal.MAIN_STEAM_TEMPERATURE,
        'main_steam_temperature',
        'main_steam_temperature_degc',
        'degC',
        True,
    ),
    SignalInfo(Signal.GENERATED_POWER, 'generated_power', 'generated_power_mw', 'MW', True),
    SignalInfo(Signal.VALVE_COMMAND, 'valve_command', 'valve_command_percent', '%', False),
)
N_SIGNALS = len(SIGNALS)


@dataclass(frozen=True, slots=True)
class Readings:
    """Single values as they arrived, in order of arrival.

    Attributes
    ----------
    time_ns : int64 (n,)
        The value's own time, nanoseconds since the Unix epoch.
    signal : int8 (n,)
        The `Signal` of the value.
    value : float64 (n,)
        In the engine's unit (%, MPa absolute, degC, MW); NaN means bad.
    quality : uint8 (n,)
        The `Quality` given by the sender; `GOOD` if the sender gives none.
    """

    time_ns: IntArray
    signal: NDArray[np.int8]
    value: FloatArray
    quality: ByteArray

    def __len__(self) -> int:
        """Return the number of readings."""
        return len(self.time_ns)

    @classmethod
    def of(cls, rows: list[tuple[int, int, float, int]]) -> Readings:
        """Create readings from rows ``(time_ns, signal, value, quality)``."""
        return cls(
            np.array([r[0] for r in rows], dtype=np.int64),
            np.array([r[1] for r in rows], dtype=np.int8),
            np.array([r[2] for r in rows], dtype=np.float64),
            np.array([r[3] for r in rows], dtype=np.uint8),
        )

    def part(self, start: int, end: int) -> Readings:
        """Return the readings ``[start, end)`` without copying."""
        cut = slice(start, end)
        return Readings(self.time_ns[cut], self.signal[cut], self.value[cut], self.quality[cut])

    def by_signal(self) -> dict[int, Readings]:
        """Return the readings by signal, in their order, without empty signals."""
        found = {}
        for info in SIGNALS:
            mine = np.flatnonzero(self.signal == info.signal)
            if len(mine):
                found[int(info.signal)] = Readings(
                    self.time_ns[mine], self.signal[mine], self.value[mine], self.quality[mine]
                )
        return found


@dataclass(frozen=True, slots=True)
class SampleTable:
    """Rows on one time grid, the only form of data for the engine.

    Attributes
    ----------
    time_ns : int64 (n,)
        Strictly increasing.
    values : float64 (n, 5)
        Columns in the order of `Signal`, engine units; NaN if there is no usable value.
    quality : uint8 (n, 5)
        A `Quality` per value; `BAD` if and only if the value is NaN.
    covariates : float64 (n, k) or None
        Values of further columns in the order in which the user named them, NaN if there is none;
        None without such columns.
    """

    time_ns: IntArray
    values: FloatArray
    quality: ByteArray
    covariates: FloatArray | None = None

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.time_ns)

    def column(self, signal: Signal) -> FloatArray:
        """Return one signal's values, shape (n,)."""
        return self.values[:, signal]

    def part(self, start: int, end: int) -> SampleTable:
        """Return the rows ``[start, end)`` without copying."""
        cut = slice(start, end)
        beside = None if self.covariates is None else self.covariates[cut]
        return SampleTable(self.time_ns[cut], self.values[cut], self.quality[cut], beside)

    def take(self, rows: IntArray) -> SampleTable:
        """Return copies of some rows."""
        beside = None if self.covariates is None else self.covariates[rows]
        return SampleTable(self.time_ns[rows], self.values[rows], self.quality[rows], beside)

    @classmethod
    def from_columns(
        cls,
        time_ns: IntArray,
        columns: dict[Signal, FloatArray],
        quality: dict[Signal, ByteArray] | None = None,
    ) -> SampleTable:
        """Create a table from one array per signal; other signals are NaN and `BAD`."""
        n = len(time_ns)
        values = np.full((n, N_SIGNALS), np.nan)
        codes = np.full((n, N_SIGNALS), int(Quality.BAD), dtype=np.uint8)
        for signal, column in columns.items():
            values[:, signal] = column
            codes[:, signal] = Quality.GOOD
            if quality is not None and signal in quality:
                codes[:, signal] = quality[signal]
        codes[~np.isfinite(values)] = Quality.BAD
        values[codes == Quality.BAD] = np.nan
        return cls(np.asarray(time_ns, dtype=np.int64), values, codes)

    @classmethod
    def concatenate(cls, tables: list[SampleTable]) -> SampleTable:
        """Join consecutive tables."""
        if not tables:
            return cls.from_columns(np.empty(0, dtype=np.int64), {})
        beside = [t.covariates for t in tables if t.covariates is not None]
        return cls(
            np.concatenate([t.time_ns for t in tables]),
            np.concatenate([t.values for t in tables]),
            np.concatenate([t.quality for t in tables]),
            np.concatenate(beside) if beside else None,
        )


def table_to_readings(table: SampleTable) -> Readings:
    """Convert rows into single readings, row by row.

    The optional signal of a row comes first, so that it is present when the
    required ones are complete. NaN in an optional column is left out (the
    signal is absent); NaN in a required column is kept as a reading of bad
    quality.
    """
    n = len(table)
    order = np.array(sorted(range(N_SIGNALS), key=lambda s: SIGNALS[s].required), dtype=np.int8)
    time_ns = np.repeat(table.time_ns, N_SIGNALS)
    signal = np.tile(order, n)
    value = table.values[:, order].ravel()
    quality = table.quality[:, order].ravel()
    required = np.array([info.required for info in SIGNALS])
    keep = np.isfinite(value) | required[signal]
    return Readings(time_ns[keep], signal[keep], value[keep], quality[keep])


class SegmentKind(enum.IntEnum):
    """The two kinds of special segments (Section III.A of the paper)."""

    STEADY = 1
    SLOPE = 2


@dataclass(frozen=True, slots=True)
class SpecialSegment:
    """A stretch of samples that contains static information only.

    ``u`` is the integrated input V p^m in % MPa^m, eq. (1). Opening and pressure at its ends and
    the exponent m are NaN if unknown.
    """

    number: int
    kind: SegmentKind
    start_ns: int
    end_ns: int
    samples: int
    u_start: float
    u_end: float
    u_rate_per_s: float
    u_rms: float
    power_start_mw: float
    power_end_mw: float
    power_rms_mw: float
    temperature_mean_degc: float
    opening_start_percent: float = math.nan
    opening_end_percent: float = math.nan
    pressure_start_mpa: float = math.nan
    pressure_end_mpa: float = math.nan
    exponent: float = math.nan


_OFFSET = re.compile(r'(?:UTC|GMT)?\s*([+-])(\d{1,2})(?::?(\d{2}))?')


def zone_of(name: str) -> tzinfo | None:
    """Return a time zone by its name or offset; ``None`` for UTC.

    Raises `InputError` if there is no such zone.
    """
    text = name.strip()
    if text.upper() in ('', 'UTC', 'Z', 'GMT'):
        return None
    offset = _OFFSET.fullmatch(text)
    if offset and int(offset[2]) <= 14:
        minutes = 60 * int(offset[2]) + int(offset[3] or 0)
        return timezone(timedelta(minutes=minutes if offset[1] == '+' else -minutes))
    try:
        return zoneinfo.ZoneInfo(text)
    except (zoneinfo.ZoneInfoNotFoundError, ValueError, OSError):
        raise InputError(
            f"Time zone '{name}' is not known; use a name such as Europe/Berlin, or an offset "
            'such as +01:00.'
        ) from None


def finite(value: Any) -> Any:
    """Return a value for JSON, which has no NumPy numbers, no NaN and no infinity (None here)."""
    if isinstance(value, Mapping):
        return {str(k): finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [finite(v) for v in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
