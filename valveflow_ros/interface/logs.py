# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A log from a file or a DataFrame: readings in the engine's units, with constants added."""

from __future__ import annotations

import difflib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from valveflow_ros.errors import DataError, InputError, listed
from valveflow_ros.interface import SILENT, Progress, plausibility
from valveflow_ros.interface.mapping import LOOKING_ON, LogMapping, gather_refusals, read_mapping
from valveflow_ros.interface.plausibility import Doubt
from valveflow_ros.logs import LogContents
from valveflow_ros.logs import open_log as read_file
from valveflow_ros.logs.names import signal_of
from valveflow_ros.logs.reader import TABLE_SUFFIXES
from valveflow_ros.logs.tables.cells import QUALITY_SUFFIX
from valveflow_ros.logs.tables.match import TIME, option
from valveflow_ros.logs.tables.reader import TableReader
from valveflow_ros.logs.tables.refusal import quoted
from valveflow_ros.parameters import PARAMETERS, Settings
from valveflow_ros.records import (
    FLOW_UNITS,
    N_SIGNALS,
    SIGNALS,
    BoolArray,
    FloatArray,
    IntArray,
    Quality,
    Readings,
    SampleTable,
    Signal,
    table_to_readings,
)
from valveflow_ros.report.words import duration, moment
from valveflow_ros.signals.compression import Compression, find_compression, held_readings
from valveflow_ros.signals.units import (
    DIFFERENCES,
    Unit,
    convert,
    engine_unit,
    known_units,
    unit_of,
)


@dataclass(frozen=True, slots=True, repr=False)
class Log:
    """A log that was read, and its interpretation.

    Attributes
    ----------
    name : str
        Name of the file, or 'DataFrame'.
    contents : LogContents
        The log as in the file.
    readings : Readings
        In engine units; constants have the times of another signal.
    units : dict
        The assumed unit of each signal, and the unit in which each constant was given.
    constants : dict
        Value of each constant signal, engine units.
    doubts : list of Doubt
        Signals whose values are implausible for their unit.
    compression : Compression, optional
        How a historian compressed the values, if it stored them by exception.
    updates : Readings, optional
        The values that were read, if ``readings`` repeat each value until the next one.
    source : object
        The file or DataFrame, to read further columns from it.
    mapping : LogMapping
        What the user specified about the log.
    """

    name: str
    contents: LogContents
    readings: Readings
    units: dict[Signal, str]
    constants: dict[Signal, float]
    doubts: list[Doubt]
    compression: Compression | None = None
    updates: Readings | None = None
    source: Any = None
    mapping: LogMapping = field(default_factory=LogMapping)

    def __repr__(self) -> str:
        """Return what the log contains, without its readings."""
        columns = ', '.join(f'{SIGNALS[s].topic} in {unit}' for s, unit in self.units.items())
        return f'<Log: {self.name}, {duration(self.span_s)}: {columns}>'

    @property
    def recorded(self) -> Readings:
        """Return the values in the log itself, without repeated ones."""
        return self.readings if self.updates is None else self.updates

    @property
    def span_s(self) -> float:
        """Return the time from the first reading to the last, in s."""
        return float(np.ptp(self.readings.time_ns)) / 1e9 if len(self.readings) else 0.0

    @property
    def notes(self) -> tuple[str, ...]:
        """Return notes on how the file was read."""
        kept = () if self.compression is None else (self.compression.sentence,)
        return (*self.contents.warnings, *(d.sentence for d in self.doubts), *kept)

    @property
    def output_unit(self) -> str:
        """Return the unit of the readings of generated_power: MW, or that of a flow."""
        unit = self.units.get(Signal.GENERATED_POWER, 'MW')
        return engine_unit(Signal.GENERATED_POWER, unit)

    def between(self, start_ns: int | None, end_ns: int | None) -> Log:
        """Return the log with the readings from a time on and up to another; None: no limit.

        Raises
        ------
        InputError
            There are none between the two.
        """
        if start_ns is None and end_ns is None:
            return self

        def cut(readings: Readings) -> Readings:
            times, ends = readings.time_ns, np.iinfo(np.int64)
            first = ends.min if start_ns is None else start_ns
            return plausibility.selected(
                readings, (times >= first) & (times <= (ends.max if end_ns is None else end_ns))
            )

        readings = cut(self.readings)
        if not len(readings):
            times = self.readings.time_ns
            held = (
                f' It lasts from {moment(int(times.min()))} to {moment(int(times.max()))}.'
                if len(times) else ''
            )  # fmt: skip
            raise InputError(f'{self.name} has no readings between these times.{held}')
        updates = None if self.updates is None else cut(self.updates)
        return replace(self, readings=readings, updates=updates)

    def parameters(self, given: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
        """Return the given parameters with those that follow from the log's units, and notes.

        The defaults in MW suit a unit of about 300 MW; if the output is a flow they are scaled
        to its size. The unit of the output is always that of the log.

        Raises
        ------
        InputError
            The given parameters name another unit of the flow.
        """
        found: dict[str, Any] = {**plausibility.limits_beside_steam(self.units, self.constants)}
        told: list[str] = []
        unit = self.output_unit
        wanted = given.get('generated_power_unit', unit)
        if wanted in FLOW_UNITS and wanted != unit:
            theirs = self.name_of(Signal.GENERATED_POWER)
            raise InputError(
                f'generated_power_unit is {wanted}, and generated_power of the log is in {unit}: '
                f"say what it is with --column 'generated_power={theirs}:{wanted}'."
            )
        if self.units.get(Signal.MAIN_STEAM_PRESSURE) in DIFFERENCES:
            found['pressure_exponent'] = _OF_DIFFERENCE
            m = given.get('pressure_exponent', _OF_DIFFERENCE)
            told.append(
                'main_steam_pressure is the pressure difference over the valve: '
                f'pressure_exponent is {m:g} unless the data choose another.'
            )
        if unit != 'MW':
            mine = self.readings.signal == Signal.GENERATED_POWER
            sizes = np.abs(self.readings.value[mine])
            sizes = sizes[np.isfinite(sizes)]
            top = float(np.quantile(sizes, _FULL)) if len(sizes) else 0.0
            found['generated_power_unit'] = unit
            if top > 0.0:
                sized = {'generated_power_low': -_MOST * top, 'generated_power_high': _MOST * top}
                for name in ('alarm_floor', 'shift_least'):
                    sized[name] = float(PARAMETERS[name].default) * top / _USUAL_MW
                for name, value in sized.items():
                    low, high = PARAMETERS[name].low, PARAMETERS[name].high
                    found[name] = min(max(value, low or 0.0), high or value)
            own = ', '.join(
                f'{n} {found[n]:.3g}' for n in ('alarm_floor', 'shift_least')
                if n in found and n not in given
            )  # fmt: skip
            told.append(
                f'The output is a flow, up to {top:.4g} {unit}; numbers called _mw are in {unit}.'
                + (f' Adapted to it: {own} {unit}.' if own else '')
            )
        units = {'generated_power_unit': unit} if unit != 'MW' else {}
        return {**found, **given, **units}, told

    def name_of(self, signal: Signal) -> str:
        """Return the topic or column of a signal, empty if the log does not contain the signal."""
        return '' if signal in self.constants else self.contents.signals.get(signal, '')

    def steps(self) -> dict[Signal, float]:
        """Return the median time between readings in s, for each signal with several readings."""
        return steps_of(self.readings.by_signal())

    def to_dataframe(self) -> Any:
        """Return the readings as a table with one row for each time with any reading.

        Returns
        -------
        pandas.DataFrame
            ``time`` (UTC) and a float64 column for each signal, in the engine's units and
            with its name (``valve_opening_percent``, ...). A value is NaN if the signal was not
            read or its value is bad; of several values at one time the last is used. A
            signal with uncertain values also has a column ``..._quality``.
        """
        import pandas as pd

        r = self.recorded
        times, row = np.unique(r.time_ns, return_inverse=True)
        values = np.full((len(times), N_SIGNALS), np.nan)
        quality = np.zeros((len(times), N_SIGNALS), dtype=np.uint8)
        values[row, r.signal] = np.where(r.quality < Quality.BAD, r.value, np.nan)
        quality[row, r.signal] = r.quality
        columns: dict[str, Any] = {TIME: pd.to_datetime(times, utc=True)}
        for info in SIGNALS:
            value = values[:, info.signal]
            if info.required or np.isfinite(value).any():
                columns[info.column] = value
            if (quality[:, info.signal] == Quality.UNCERTAIN).any():
                columns[info.column + QUALITY_SUFFIX] = quality[:, info.signal]
        return pd.DataFrame(columns)


def open_log(
    source: Any,
    mapping: LogMapping | None = None,
    *,
    columns: Mapping[str, str] | None = None,
    constants: Mapping[str, float | str] | None = None,
    time_zone: str = '',
    date_order: str = '',
    decimal: str = '',
    sheet: str = '',
    max_unpacked: str = '',
    period: str = '',
    progress: Progress = SILENT,
) -> Log:
    """Open a log, convert its units, and report implausible values.

    Parameters
    ----------
    source : str, Path or pandas.DataFrame
        An ``.mcap`` file, a rosbag2 folder, a ``.csv``, ``.xlsx`` or ``.parquet`` table, or
        a DataFrame with a column ``time`` (datetimes, those without a zone in UTC; ISO 8601
        texts; or Unix seconds) and columns such as ``valve_opening_percent``.
    mapping : LogMapping, optional
        All of the following in one object.
    columns : mapping of str to str, optional
        Name of a signal in the log and its unit: ``{'main_steam_pressure':
        'PT_100:bar'}``. Columns of a table with a recognisable name need not be given.
    constants : mapping, optional
        Signals that were not logged: ``{'main_steam_temperature': 540}``.
    time_zone, date_order, decimal, sheet : str
        Format of a table, if it cannot be recognised from the table itself.
    max_unpacked : str
        Largest unpacked size of a workbook or a Parquet file, in megabytes.
    period : str
        Time from one row to the next of a table without times: ``60s``, ``1min``.
    progress : Progress

    Raises
    ------
    RecordingError, InputError, DataError
        The log cannot be read, a column is missing, or a unit is unknown.
    """
    if mapping is None:
        table = {'time_zone': time_zone, 'date_order': date_order, 'decimal': decimal,
                 'sheet': sheet, 'max_unpacked': max_unpacked, 'period': period}  # fmt: skip
        mapping = read_mapping(
            [f'{name}={theirs}' for name, theirs in (columns or {}).items()],
            [f'{name}={value}' for name, value in (constants or {}).items()],
            **{name: value for name, value in table.items() if value},
        )
    if hasattr(source, 'columns'):
        contents = mapping.open_with(lambda names: _from_dataframe(source, names))
        return replace(
            _understood('DataFrame', contents, mapping, progress), source=source, mapping=mapping
        )
    path = Path(source)

    def look(said: LogMapping) -> LogContents:
        absent = list(said.constants)
        return said.open_with(
            lambda names: read_file(path, columns=names, absent=absent, table=said.table)
        )

    def again(said: LogMapping) -> Log:
        progress(0.02, LOOKING_ON)
        return _understood('', look(said), said, SILENT, strict=True)

    contents = gather_refusals(path, look, mapping, again)
    name = path.resolve().name if path.name in ('', '..') else path.name
    return replace(_understood(name, contents, mapping, progress), source=path, mapping=mapping)


def read_covariate(log: Log, name: str, said: str) -> Series:
    """Read a further column of a log, without conversion of units and without limits.

    ``name`` is that of the covariate in messages, ``said`` is ``COLUMN`` or ``COLUMN:unit``; of a
    recording a topic of Float64. Raises `InputError` if there is none, or no number in it.
    """
    return read_series(log.source, log.mapping, log.name, name, said)


def read_series(source: Any, mapping: LogMapping, log: str, name: str, said: str) -> Series:
    """Read a further column of the file or DataFrame called ``log``; see `read_covariate`."""
    theirs, colon, told = said.rpartition(':')
    contents = _column_of(source, mapping, theirs.strip()) if colon and theirs else None
    if contents is None:  # a column's name may itself contain a colon
        theirs, told = said, ''
        contents = _column_of(source, mapping, theirs.strip())
    if contents is None:
        raise InputError(
            f"--covariate {name}: {log} has no column or topic '{said}'"
            f'{_offered(name, said, _further(source, mapping))}.'
        )
    mine = contents.readings.signal == _READ_AS
    good = mine & np.isfinite(contents.readings.value) & (contents.readings.quality < Quality.BAD)
    if not good.any():
        raise InputError(f"--covariate {name}: '{theirs}' of {log} holds no number.")
    times, values = contents.readings.time_ns[good], contents.readings.value[good]
    order = np.argsort(times, kind='stable')
    theirs = theirs.strip()
    # A column may be named without the unit in its heading.
    named = _unit_in(contents.signals.get(_READ_AS, theirs))
    unit = told.strip() or _unit_kept(contents, theirs) or named
    return Series(theirs, unit, times[order], values[order])


@dataclass(frozen=True, slots=True)
class Series:
    """A further column of a log, with its unit, '' if unknown."""

    column: str
    unit: str
    time_ns: IntArray  # int64 (k,), not decreasing
    values: FloatArray  # float64 (k,), finite

    def at(self, time_ns: IntArray) -> FloatArray:
        """Return the values at other times by linear interpolation; NaN in gaps and outside.

        A gap is longer than one hour and longer than five times the median step.
        """
        seconds = (self.time_ns - time_ns[0]) / 1e9
        rows = (time_ns - time_ns[0]) / 1e9
        steps = np.diff(seconds)
        longest = max(_GAP_S, _GAP_STEPS * float(np.median(steps)) if len(steps) else 0.0)
        after = np.searchsorted(seconds, rows)
        before = np.searchsorted(seconds, rows, side='right') - 1
        last = len(seconds) - 1
        away = np.minimum(
            np.abs(rows - seconds[np.clip(before, 0, last)]),
            np.abs(rows - seconds[np.clip(after, 0, last)]),
        )
        out: FloatArray = np.interp(rows, seconds, self.values)
        out[away > 0.5 * longest] = np.nan
        return out


# The flow is proportional to the root of the pressure difference; limit of a flow, as multiple of
# the full flow; quantile that defines full flow; size of unit that the parameters in MW suit.
_OF_DIFFERENCE, _MOST, _FULL, _USUAL_MW = 0.5, 10.0, 0.995, 300.0
_GAP_S, _GAP_STEPS = 3600.0, 5.0
# Readers return signals only: the column is read as this signal, before units are converted.
_READ_AS = Signal.VALVE_COMMAND
_NUMBER, _MOST_OFFERED = 'std_msgs/msg/Float64', 12


def _column_of(source: Any, mapping: LogMapping, theirs: str) -> LogContents | None:
    """Return the log with the column read as a signal; None if there is no such column."""
    topics = [info.topic for info in SIGNALS]
    times = {k: v for k, v in mapping.names().items() if k not in topics}
    names = {**times, SIGNALS[_READ_AS].topic: theirs}
    try:
        if hasattr(source, 'columns'):
            return _from_dataframe(source, names)
        return read_file(source, columns=names, absent=topics, table=mapping.table)
    except InputError:
        return None


def _further(source: Any, mapping: LogMapping) -> list[str]:
    """Return the names of the columns or topics with numbers that are no signals."""
    try:
        if hasattr(source, 'columns'):
            taken = {*_from_dataframe(source, mapping.names()).signals.values(), TIME}
            numbers = source.select_dtypes('number').columns
            return [str(name) for name in numbers if name not in taken]
        if Path(source).suffix.lower() in TABLE_SUFFIXES:
            topics = [info.topic for info in SIGNALS]
            return TableReader(source, mapping.names(), topics, mapping.table).numeric_ignored
        found = read_file(source, columns=mapping.names()).topics.values()
    except InputError:
        return []
    return [t.name.lstrip('/') for t in found if t.type == _NUMBER and t.signal is None]


def _offered(name: str, said: str, others: list[str]) -> str:
    """Return the end of a sentence with the columns that may be meant; '' if there is none."""
    if not others:
        return ''
    near = difflib.get_close_matches(said, others, n=1, cutoff=0.4)
    near += [other for other in others if said.lower() in other.lower()]
    example = quoted(f'{name}={(near or others)[0]}')
    return f'; it has {listed(others[:_MOST_OFFERED])}: --covariate {example}'


def _unit_kept(contents: LogContents, topic: str) -> str:
    """Return the unit that an imported log lists for a covariate, '' if there is none."""
    try:
        rows = json.loads(contents.attachments['import.json'])['covariates']
        return next(str(row['unit']) for row in rows if row['name'] == topic.lstrip('/'))
    except (KeyError, ValueError, TypeError, AttributeError, StopIteration):
        return ''


def _unit_in(column: str) -> str:
    """Return the unit at the end of a column's name, '' if there is none."""
    last = column.lower().replace('[', '_').replace('(', '_').strip('])').split('_')[-1]
    return _COVARIATE_UNITS.get(last.strip(), '')


_COVARIATE_UNITS = {
    unit.lower(): unit
    for unit in ('kPa', 'Pa', 'MPa', 'hPa', 'mbar', 'bar', 'psi', 'degC', 'K', 'degF', 'MW', 'kW',
                 'Mvar', 'percent', 't/h', 'kg/s', 'Hz', 'MJ/kg', 'kJ/kg')
}  # fmt: skip


def as_log(log: Any, progress: Progress) -> Log:
    """Return a log unchanged, or open it: by a call, or from a file or a DataFrame."""
    log = log() if callable(log) else log
    return log if isinstance(log, Log) else open_log(log, progress=progress)


def steps_of(parts: dict[int, Readings]) -> dict[Signal, float]:
    """Return the median time between readings, by signal, in s."""
    steps: dict[Signal, float] = {}
    for signal, part in parts.items():
        gaps = np.diff(part.time_ns)
        if gaps.min(initial=1) <= 0:
            gaps = gaps[gaps > 0]
        if len(gaps):
            steps[Signal(signal)] = float(np.median(gaps)) / 1e9
    return steps


def _understood(
    name: str, contents: LogContents, mapping: LogMapping, progress: Progress, strict: bool = False
) -> Log:
    for sentence in contents.warnings:
        progress.warn(sentence)
    for sentence in contents.understood:
        progress.say(sentence)
    told = _units_told(contents)
    units = {s: mapping.unit_of(s, told) for s in contents.signals}
    constants = mapping.constant_signals
    stated = {**units, **mapping.constant_units}
    output = engine_unit(Signal.GENERATED_POWER, stated.get(Signal.GENERATED_POWER, ''))
    progress.measured_in(output)
    settings = Settings(plausibility.limits_beside_steam(stated, constants))
    plausibility.check_constants(constants, settings)
    measured_signals = sorted(units.keys() - constants.keys())
    for signal in measured_signals:
        if note := plausibility.air_note(signal, units[signal], contents.signals[signal]):
            progress.say(note)
    raw, steam = contents.readings, output == 'MW'
    judged = (
        plausibility.doubt(s, raw.value[raw.signal == s], units[s], settings, steam)
        for s in measured_signals
    )
    doubts = [found for found in judged if found is not None]
    plausibility.refuse_guesses(
        contents.path, doubts, contents.grounds, mapping.unsaid(units), contents.signals, strict
    )
    if not contents.topics:  # a table
        plausibility.refuse_impossible(contents.path, doubts, contents.signals)
    for found in doubts:
        progress.warn(found.advice(contents.signals[found.signal]))
    for signal in constants.keys() & contents.signals.keys():
        progress.warn(
            f"{SIGNALS[signal].topic} stands in the log as '{contents.signals[signal]}' too; "
            'the constant is used instead.'
        )
    power, pressure = Signal.GENERATED_POWER, Signal.MAIN_STEAM_PRESSURE
    if steam and pressure in constants and power not in told and power in mapping.unsaid(units):
        theirs = contents.signals.get(power, 'COLUMN')
        progress.warn(
            f"'{theirs}' is taken as a power in MW. If it is a flow, add its unit: "
            f'{option("generated_power", theirs, "t/h")}'
        )
    measured = _converted(raw, units)
    compression = find_compression(measured)
    if compression is not None:
        progress.say(compression.sentence)
    if compression is None or not compression.own_times:
        readings = plausibility.with_constants(measured, constants)
        return Log(name, contents, readings, stated, constants, doubts, compression)
    held = plausibility.with_constants(held_readings(measured, compression), constants)
    recorded = plausibility.with_constants(
        plausibility.selected(measured, np.isfinite(measured.value)), constants
    )
    return Log(name, contents, held, stated, constants, doubts, compression, recorded)


def _units_told(contents: LogContents) -> dict[Signal, str]:
    """Return the units that the log itself contains.

    The columns of a table may name them. An imported log lists its units in an attachment.
    A monitor records the values in the gateway's units, and its own parameters, which name
    these units; stamped samples always use the default units.
    """
    if contents.units:
        return dict(contents.units)
    try:
        rows = json.loads(contents.attachments['import.json'])['signals']
        named = {signal_of(row['topic']): str(row['unit']) for row in rows}
        return {s: unit for s, unit in named.items() if unit in known_units(s)}
    except (KeyError, ValueError, TypeError, InputError):
        pass
    try:
        parameters = json.loads(contents.attachments['parameters.json'])
        named = {s: parameters.get(f'{SIGNALS[s].topic}_unit') for s in contents.signals}
    except (KeyError, ValueError, AttributeError):
        return {}
    return {
        signal: unit
        for signal, unit in named.items()
        if unit in known_units(signal) and not contents.signals[signal].endswith('plant_sample')
    }


def _converted(readings: Readings, units: dict[Signal, str]) -> Readings:
    value = readings.value
    for signal, unit in units.items():
        if unit_of(signal, unit) == Unit(1.0):
            continue
        mine = readings.signal == signal
        value = value.copy() if value is readings.value else value
        value[mine] = convert(signal, unit, value[mine])
    return replace(readings, value=value)


def _from_dataframe(frame: Any, names: Mapping[str, str]) -> LogContents:
    """Return a DataFrame as a log; raises `InputError` or `DataError`."""
    import pandas as pd

    if missing := [theirs for theirs in names.values() if theirs not in frame.columns]:
        raise InputError(f"The DataFrame has no column '{missing[0]}'.")
    theirs = names.get(TIME, TIME)
    if theirs not in frame.columns and not isinstance(frame.index, pd.DatetimeIndex):
        raise InputError("The DataFrame has no column 'time', and its index holds no times.")
    time_ns, there = nanoseconds(frame[theirs] if theirs in frame.columns else frame.index)
    order = np.flatnonzero(there)[np.argsort(time_ns[there], kind='stable')]
    columns, quality, signals = {}, {}, {}
    for info in SIGNALS:
        usual = (info.column, info.topic)
        theirs = names.get(info.topic) or next((c for c in usual if c in frame.columns), '')
        if not theirs:
            continue
        signals[info.signal] = theirs
        numbers = pd.to_numeric(frame[theirs], errors='coerce').to_numpy(np.float64)
        columns[info.signal] = numbers[order]
        if theirs + QUALITY_SUFFIX in frame.columns:
            quality[info.signal] = frame[theirs + QUALITY_SUFFIX].to_numpy(np.uint8)[order]
    if not columns or not len(order):
        raise DataError(
            'The DataFrame has no row with a time.' if columns else
            f'The DataFrame has none of the columns {", ".join(i.column for i in SIGNALS)}.'
        )  # fmt: skip
    table = SampleTable.from_columns(time_ns[order], columns, quality)
    readings = table_to_readings(table)
    return LogContents(
        'DataFrame', readings, readings.time_ns, signals=signals,
        start_ns=int(table.time_ns[0]), end_ns=int(table.time_ns[-1]),
    )  # fmt: skip


def nanoseconds(times: Any) -> tuple[IntArray, BoolArray]:
    """Return times in ns since 1970, and which of them can be read."""
    import pandas as pd

    series = pd.Series(times).reset_index(drop=True)
    if pd.api.types.is_numeric_dtype(series):
        seconds = series.to_numpy(np.float64)
        there = np.isfinite(seconds)
        # Whole seconds are converted separately: a float64 of ns would round them.
        whole = np.floor(np.where(there, seconds, 0.0))
        part = np.round((np.where(there, seconds, 0.0) - whole) * 1e9).astype(np.int64)
        return whole.astype(np.int64) * 1_000_000_000 + part, there
    stamps = pd.to_datetime(series, utc=True, errors='coerce')
    time_ns = stamps.astype('datetime64[ns, UTC]').astype(np.int64).to_numpy()
    return time_ns, stamps.notna().to_numpy()
