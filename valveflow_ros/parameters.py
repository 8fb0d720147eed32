# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The table of all parameters: names, defaults, units, ranges, descriptions.

The node declares its ROS parameters from this table, ``config/monitor.yaml``
and the documentation are generated from it, the command line checks parameter
files with it, and the engine gets its settings from it. Each value is checked
against its range, and then all values together.
"""

from __future__ import annotations

import contextlib
import difflib
import enum
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import tzinfo
from typing import Any

from valveflow_ros.errors import InputError, ParameterError, UsageError, listed
from valveflow_ros.records import FLOW_UNITS, SIGNALS, zone_of

Value = bool | int | float | str


# Parameters without influence on the engine's decisions.
_APART = frozenset({
    'autostart', 'input_reliability', 'refit_timeout', 'diagnosis_timeout', 'reference_file',
    'record', 'record_directory', 'record_flush', 'record_rotation', 'record_queue',
    'record_keep', 'keep_state', 'state_directory', 'state_period',
})  # fmt: skip


class Depends(enum.IntEnum):
    """The part of a saved state that is invalid after a change of a parameter.

    `SEGMENTS` are found again in the rows of the window. With `ROWS` the window is dropped, and
    curve, reference and alarms are kept. `ALL`: the state is of another unit or in other units.
    """

    NOTHING = 0
    SEGMENTS = 1
    ROWS = 2
    ALL = 3


_DEPENDS = {
    **dict.fromkeys((
        'pressure_exponent', 'time_constant', 'delay', 'block', 'longest_segment', 'steady_min',
        'slope_min', 'input_noise', 'power_noise', 'break_limit', 'steady_limit', 'slope_limit',
    ), Depends.SEGMENTS),
    'sample_period': Depends.ROWS,
    **dict.fromkeys((
        'unit_tag', 'valve_opening_unit', 'main_steam_pressure_unit',
        'main_steam_temperature_unit', 'generated_power_unit', 'valve_command_unit', 'model_file',
    ), Depends.ALL),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Parameter:
    """One row of the table."""

    name: str
    default: Value
    unit: str
    sentence: str
    # low, high: inclusive range of a number
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()  # the allowed values of a text; empty means any text
    live: bool = False  # True if it may be changed while the monitor runs

    @property
    def of_state(self) -> bool:
        """Return True if the engine's decisions depend on it and it is fixed during a run."""
        return not (self.live or self.name in _APART)

    @property
    def depends(self) -> Depends:
        """Return the part of a saved state that is invalid after a change."""
        return _DEPENDS.get(self.name, Depends.NOTHING)

    def check(self, value: object) -> Value:
        """Return ``value`` in this row's type, or raise `ParameterError`.

        An integer is accepted for a real number; NaN is never accepted.
        """
        if isinstance(self.default, bool):
            if isinstance(value, bool):
                return value
            raise ParameterError(self.name, f'must be true or false, not {value!r}')
        if isinstance(self.default, str):
            return self._check_text(value)
        return self._check_number(value)

    def _check_text(self, value: object) -> str:
        if not isinstance(value, str):
            raise ParameterError(self.name, f'must be a text, not {value!r}')
        if not value.isprintable() or len(value) > 500:
            raise ParameterError(self.name, 'must be one line of at most 500 printable characters')
        if self.choices and value not in self.choices:
            allowed, near = ', '.join(self.choices), self._nearest(value)
            hint = f"; did you mean '{near}'?" if near else ''
            raise ParameterError(self.name, f"must be one of {allowed}, not '{value}'{hint}")
        return value

    def _nearest(self, value: str) -> str:
        """Return the choice that differs only by case or little from a text; empty if none."""
        by_word = {choice.casefold(): choice for choice in self.choices}
        # The limit is high, because similar units differ by a factor: Pa and hPa.
        near = difflib.get_close_matches(value.strip().casefold(), by_word, n=1, cutoff=0.85)
        return by_word[near[0]] if near else ''

    def _check_number(self, value: object) -> int | float:
        whole = isinstance(self.default, int)
        if isinstance(value, bool) or not isinstance(value, int | float):
            kind = 'whole number' if whole else 'number'
            raise ParameterError(self.name, f'must be a {kind}, not {value!r}')
        if whole and value != value // 1:
            raise ParameterError(self.name, f'must be a whole number, not {value!r}')
        low, high = self.low, self.high
        if low is None or high is None:
            raise ParameterError(self.name, 'has no range in the table')
        if not low <= value <= high:
            unit = f' {self.unit}' if self.unit else ''
            raise ParameterError(
                self.name, f'must be from {low:g} to {high:g}{unit}, not {value!r}'
            )
        return int(value) if whole else float(value)


NOT_NOW = 'cannot be changed while the monitor runs; set it at the start, or after a clean-up'
# In YAML an unquoted % begins a directive.
_OPENING_UNITS = ('percent', '%', 'fraction')
# Convert alternative names of a value, so that states are equal for both.
_SAME: dict[Value, Value] = {'%': 'percent'}
_PRESSURE_UNITS = (
    'MPa', 'kPa', 'Pa', 'bar', 'mbar', 'psi', 'kg/cm2', 'MPag', 'kPag', 'barg', 'psig',
)  # fmt: skip
_TEMPERATURE_UNITS = ('degC', 'K', 'degF')
_POWER_UNITS = ('MW', 'kW', 'W', *FLOW_UNITS)

_UNIT_AND_INPUTS = (
    Parameter('unit_tag', 'unit', '', 'Tag of the unit; frame_id and hardware_id of messages.'),
    Parameter('time_zone', '', '', 'Time zone of times in sentences, such as Europe/Berlin or '
              '+01:00; empty: UTC. Numbers and files stay in UTC.'),
    Parameter('autostart', True, '', 'Configure and activate the node by itself at start.'),
    Parameter(
        'stamp_source',
        'source',
        '',
        'Time of a plain Float64: the stamp its publisher gave it (source), its receipt '
        '(receive) or ROS time (ros_time; always so when use_sim_time is set).',
        choices=('source', 'receive', 'ros_time'),
    ),
    Parameter(
        'input_reliability',
        'best_effort',
        '',
        'Reliability asked of input topics; best_effort matches every publisher.',
        choices=('best_effort', 'reliable'),
    ),
    Parameter(
        'valve_opening_unit', 'percent', '', 'Unit the gateway sends valve_opening in.',
        choices=_OPENING_UNITS,
    ),
    Parameter(
        'main_steam_pressure_unit', 'MPa', '',
        'Unit the gateway sends main_steam_pressure in: absolute, or gauge (MPag, barg, ...), to '
        'which the standard atmosphere is added.',
        choices=_PRESSURE_UNITS,
    ),
    Parameter(
        'main_steam_temperature_unit', 'degC', '',
        'Unit the gateway sends main_steam_temperature in.', choices=_TEMPERATURE_UNITS,
    ),
    Parameter(
        'generated_power_unit', 'MW', '',
        'Unit the gateway sends generated_power in. A flow keeps it: parameters and results in MW '
        'are in this unit then.',
        choices=_POWER_UNITS,
    ),
    Parameter(
        'valve_command_unit', 'percent', '', 'Unit the gateway sends valve_command in.',
        choices=_OPENING_UNITS,
    ),
    Parameter(
        'covariates', '', '',
        'Further topics (std_msgs/Float64) that the power may follow and that a diagnosis tries '
        'as causes: NAME=TOPIC[:UNIT], separated by blanks, such as '
        'vacuum=/condenser/pressure:kPa; at most ten.',
    ),
)  # fmt: skip

_PLAUSIBLE = (
    Parameter('valve_opening_low', -2.0, '%', 'Lower values are impossible and rejected.',
              -50.0, 50.0),
    Parameter('valve_opening_high', 105.0, '%', 'Higher values are impossible and rejected.',
              50.0, 1000.0),
    Parameter('main_steam_pressure_low', 0.05, 'MPa', 'Lower values are rejected.', 0.0, 50.0),
    Parameter('main_steam_pressure_high', 40.0, 'MPa', 'Higher values are rejected.', 0.1, 100.0),
    Parameter('main_steam_temperature_low', 50.0, 'degC', 'Lower values are rejected.',
              -273.15, 700.0),
    Parameter('main_steam_temperature_high', 750.0, 'degC', 'Higher values are rejected.',
              50.0, 1000.0),
    Parameter('generated_power_low', -100.0, 'MW', 'Lower values are rejected.', -1e7, 1e7),
    Parameter('generated_power_high', 2500.0, 'MW', 'Higher values are rejected.', 1e-6, 1e7),
)  # fmt: skip

_TIME_BASE = (
    Parameter('sample_period', 1.0, 's',
              'Time between samples: set it to the interval of your data.', 0.01, 3600.0),
    Parameter('hold_limit', 10.0, 's',
              'A value is used for at most this time; then the signal is stale and the sample '
              'is bad.',
              0.01, 86400.0),
    Parameter('lateness', 2.0, 's',
              'How long a row waits for slower topics before it is closed.', 0.0, 3600.0),
    Parameter('clock_jump', 15.0, 's',
              'A stamp further ahead than this is used only after two more stamps have confirmed '
              'it. If twenty stamps in a row are further behind than this, the clock was set '
              'back: rows later than the new time are set aside.',
              1.0, 1e6),
    Parameter('window_days', 10.0, 'd', 'Length of the rolling window.', 0.02, 60.0),
)  # fmt: skip

_MODEL = (
    Parameter('axis', 'auto', '',
              'What the curve is a function of: V p^m with m = pressure_exponent, eq. (1) of the '
              'paper, or the opening alone, the power being p^m F(V) + c. By default the data '
              'choose axis and m.',
              choices=('auto', 'integrated_input', 'opening')),
    Parameter('pressure_exponent', 1.125, '',
              'Exponent m of u = V p^m, eq. (1) of the paper, unless the data choose another.',
              0.4, 2.0),
    Parameter('time_constant', 80.0, 's',
              'Largest time constant T expected; with delay it sets the transient 5 T + tau '
              'that does not count after a move begins.', 0.1, 3600.0),
    Parameter('delay', 10.0, 's', 'Largest delay tau expected.', 0.0, 600.0),
    Parameter('block', 10.0, 's', 'Length of the means the segmenter works on.', 0.01, 7200.0),
    Parameter('longest_segment', 1800.0, 's',
              'A longer segment is divided here; the next part begins without a transient.',
              60.0, 864000.0),
    Parameter('steady_min', 120.0, 's', 'Shortest steady-state segment.', 0.0, 864000.0),
    Parameter('slope_min', 120.0, 's', 'Shortest slope-response segment.', 0.0, 864000.0),
    Parameter('input_noise', 0.0, '% MPa^m',
              'Noise of u about its line, block means; 0 takes it from the data.', 0.0, 1e6),
    Parameter('power_noise', 0.0, 'MW',
              'Noise of power about its line, block means; 0 takes it from the data.', 0.0, 1e6),
    Parameter('break_limit', 4.5, 'sd',
              'A line ends where two block means in a row leave it by more than this.', 1.0, 50.0),
    Parameter('steady_limit', 2.5, 'sd',
              'A segment counts as steady while u drifts less than this many noise sd.',
              0.1, 50.0),
    Parameter('slope_limit', 8.0, 'sd',
              'A segment counts as slope response when u moves more than this many noise sd.',
              1.0, 1000.0),
    Parameter('temperature_spread_limit', 15.0, 'K',
              'Spread of the main steam temperature over the special samples (central 95 %) '
              'beyond which a warning says that the temperature was not constant.',
              0.1, 500.0),
    Parameter('model_file', '', '',
              'An extended_model.json of valveflow diagnose: the effect of its causes is '
              'removed from opening and power first; empty: nothing is removed.'),
)  # fmt: skip

_FIT = (
    Parameter('max_pieces', 10, '', 'Largest number of pieces tried, R_max of the paper.', 1, 20),
    Parameter('selection_rule', 'prediction_error', '',
              'How the number of pieces is chosen: a breakpoint must lower the whitened '
              "prediction error by enough (needs refine), or by the paper's turning angle, "
              'eq. (24).',
              choices=('prediction_error', 'paper')),
    Parameter('min_piece_share', 0.01, '',
              'Smallest share of the special samples in a piece.', 0.0, 0.2),
    Parameter('refine', True, '',
              'Refine the curve together with time constants and delays on all samples.'),
    Parameter('refit_period', 600.0, 's', 'Time between refits; 0 refits on request only.',
              0.0, 864000.0, live=True),
    Parameter('refit_segments', 20, '',
              'Refit after this many new special segments; 0 waits for the period.',
              0, 100000, live=True),
    Parameter('refit_share', 0.1, '',
              'A refit waits until this share of the special segments in the window (steady '
              'states and long ramps) has come since the last fit.',
              0.0, 1.0, live=True),
    Parameter('refit_timeout', 120.0, 's', 'A refit that takes longer is ended.', 1.0, 3600.0),
    Parameter('min_fit_samples', 600, '', 'Fewest special samples a fit needs.', 10, 10_000_000),
)  # fmt: skip

_ALARM = (
    Parameter('alarm_run_length', 30.0, 'd',
              'Accepted mean time between false residual alarms: a longer one gives wider limits, '
              'so fewer false alarms and later true ones.',
              0.5, 3650.0, live=True),
    Parameter('alarm_block', 60.0, 's', 'Length of the means of the residual for the alarm.',
              1.0, 86400.0, live=True),
    Parameter('alarm_floor', 1.0, 'MW',
              'Smaller lasting shifts are not important; applies from the next fit on, like '
              'alarm_run_length and alarm_block.', 0.0, 1e4, live=True),
    Parameter('alarm_limit', 0.0, 'MW',
              'Fixed limit of the running mean of the residual; 0 leaves it to alarm_run_length.',
              0.0, 1e5, live=True),
    Parameter('alarm_average', 300.0, 's', 'Time constant of the running mean of the residual.',
              1.0, 86400.0, live=True),
    Parameter('alarm_on_delay', 900.0, 's', 'The limit must be exceeded this long.',
              0.0, 86400.0, live=True),
    Parameter('alarm_off_delay', 86400.0, 's',
              'The alarm ends when the residual has been within its limit for this long, at '
              'openings where the alarm was seen. If the alarm comes back soon (within seven of '
              'these times), this time doubles, up to eight times its value.',
              0.0, 864000.0, live=True),
    Parameter('alarm_dead_band', 0.3, '', 'The return is judged at limit x (1 - dead band).',
              0.0, 0.9, live=True),
    Parameter('alarm_latch', True, '',
              'An alarm stays until its condition has gone and it was acknowledged.', live=True),
    Parameter('alarm_shelve_time', 28800.0, 's',
              'A shelved alarm comes back by itself after this time.',
              60.0, 604800.0, live=True),
    Parameter('alarm_suppress_time', 3600.0, 's',
              'If the residual could not be judged for this long, for example because an input is '
              'missing, its alarm is suppressed. The alarm is shown again when the residual has '
              'been judged for alarm_off_delay or five alarm_block, whichever is shorter, or at '
              'once if the alarm changes.',
              1.0, 86400.0, live=True),
    Parameter('alarm_flood', 5, '',
              'Most announcements of one alarm in ten minutes; more are counted and not sent.',
              1, 100, live=True),
)  # fmt: skip

_SHIFT = (
    Parameter('reference_file', '', '',
              'A characteristic.json that later curves are compared with; empty: see '
              'reference_after.'),
    Parameter('reference_after', 3.0, 'd',
              'A curve of this long becomes the reference automatically after as long without a '
              'fault; 0: only by ~/set_reference.', 0.0, 60.0, live=True),
    Parameter('wear_budget', 3.0, 'MW/month',
              'Slow change of the curve up to this is followed and reported as wear; beyond it '
              'there is an alarm.', 0.0, 1e4, live=True),
    Parameter('shift_confidence', 0.999, '',
              'How sure a shift of the curve must be before it is called one.',
              0.9, 0.999999, live=True),
    Parameter('shift_least', 0.3, 'MW',
              'A shift of the curve smaller than this raises no alarm. The wear that wear_budget '
              'allows since the reference was set is added to it.',
              0.0, 1e4, live=True),
)  # fmt: skip

_DIAGNOSIS = (
    Parameter('mismatch_limit', 3.5, 'sd',
              'The model is said to fit no longer where a statistic of its residual is further '
              'from zero than this many of its standard errors.', 2.0, 100.0, live=True),
    Parameter('diagnosis_on_mismatch', True, '',
              'Diagnose when the model no longer fits.', live=True),
    Parameter('diagnosis_hour', 2, 'h UTC',
              'Hour of the day, in UTC, at which a diagnosis is made every day; -1: none.',
              -1, 23, live=True),
    Parameter('diagnosis_pause', 3.0, 'h',
              'Least time between two diagnoses that were not asked for by hand.',
              0.0, 8760.0, live=True),
    Parameter('diagnosis_timeout', 3600.0, 's', 'A diagnosis that takes longer is ended.',
              1.0, 86400.0),
)  # fmt: skip

_RECORD = (
    Parameter('record', True, '', 'Record inputs and outputs to MCAP.'),
    Parameter('record_directory', '', '',
              'Folder of the recordings; empty means valveflow_recordings where the node starts.'),
    Parameter('record_flush', 0.5, 's', 'Longest time a message waits before it is on disk.',
              0.05, 60.0),
    Parameter('record_rotation', 3600.0, 's', 'A new file begins after this time.',
              1.0, 864000.0),
    Parameter('record_queue', 200_000, '', 'Messages that may wait for the disk.',
              100, 10_000_000),
    Parameter('record_keep', 0, '',
              'Finished files kept in a recording, the oldest go first; 0 keeps all.',
              0, 1_000_000),
    Parameter('keep_state', True, '',
              'Save window, curve and alarms, and go on with them after the next start.'),
    Parameter('state_directory', '', '',
              'Folder of the saved state, for one monitor only; empty means state_ and the '
              'unit_tag below record_directory, and none if nothing is recorded.'),
    Parameter('state_period', 3600.0, 's',
              'Longest time between saved states; a new curve or alarm saves one within seconds.',
              1.0, 86400.0),
    Parameter('diagnostics_period', 1.0, 's', 'Time between messages on /diagnostics.', 0.1, 60.0,
              live=True),
)  # fmt: skip

_MOST_ROWS = 20_000_000  # about 0.8 GB of window
_MOST_COVARIATES = 10  # each needs as much memory as one of the five signals

TABLE: tuple[Parameter, ...] = (
    *_UNIT_AND_INPUTS,
    *_PLAUSIBLE,
    *_TIME_BASE,
    *_MODEL,
    *_FIT,
    *_ALARM,
    *_SHIFT,
    *_DIAGNOSIS,
    *_RECORD,
)
PARAMETERS: dict[str, Parameter] = {row.name: row for row in TABLE}
_TOPICS = ('plant_sample', *(info.topic for info in SIGNALS))


class Settings(Mapping[str, Value]):
    """A complete, checked set of parameter values; immutable.

    Raises `ParameterError` if a name is unknown, a value is invalid, or two values contradict each
    other.

    Parameters
    ----------
    values : mapping, optional
        Values that differ from the defaults.
    """

    __slots__ = ('_values',)

    def __init__(self, values: Mapping[str, object] | None = None) -> None:
        merged: dict[str, Value] = {row.name: row.default for row in TABLE}
        for name, value in (values or {}).items():
            merged[name] = parameter(name).check(value)
        _check_together(merged)
        self._values = merged

    def __getitem__(self, name: str) -> Value:
        """Return one value."""
        return self._values[name]

    def __iter__(self) -> Any:
        """Iterate over the names in the table's order."""
        return iter(self._values)

    def __len__(self) -> int:
        """Return the number of parameters."""
        return len(self._values)

    def real(self, name: str) -> float:
        """Return a number as float."""
        return float(self._values[name])

    def whole(self, name: str) -> int:
        """Return an integer."""
        return int(self._values[name])

    def flag(self, name: str) -> bool:
        """Return a boolean."""
        return bool(self._values[name])

    def text(self, name: str) -> str:
        """Return a text."""
        return str(self._values[name])

    def changed(self, values: Mapping[str, object]) -> Settings:
        """Return a checked copy with some values replaced."""
        return Settings({**self._values, **values})

    def live_changes(self, wanted: Settings) -> dict[str, Value]:
        """Return the values that differ in ``wanted``.

        Raises `ParameterError` if a value differs that may not be changed while the monitor runs.
        """
        changed = wanted.changes(self)
        for name in changed:
            if not parameter(name).live:
                raise ParameterError(name, NOT_NOW)
        return changed

    @classmethod
    def earlier(cls, values: Mapping[str, object]) -> Settings:
        """Return the settings of an earlier version without parameters that are invalid now.

        Raises `ParameterError` if two values contradict each other.
        """
        known: dict[str, object] = {}
        for name, value in values.items():
            with contextlib.suppress(ParameterError):
                known[name] = parameter(name).check(value)
        return cls(known)

    def changes(self, then: Mapping[str, Value]) -> dict[str, Value]:
        """Return the parameters with another effective value in ``then``, in the table's order."""
        return {n: v for n, v in self.items() if _SAME.get(v, v) != _SAME.get(then[n], then[n])}

    def retuned(self, then: Mapping[str, Value]) -> tuple[str, ...]:
        """Return the names of those changes with `Parameter.of_state`."""
        return tuple(n for n in self.changes(then) if parameter(n).of_state)

    @property
    def output_unit(self) -> str:
        """Return the unit of the output after conversion: MW, or that of a flow."""
        unit = self.text('generated_power_unit')
        return unit if unit in FLOW_UNITS else 'MW'

    @property
    def zone(self) -> tzinfo | None:
        """Return the time zone of times in messages and pages; None: UTC."""
        return zone_of(self.text('time_zone'))

    @property
    def settle_s(self) -> float:
        """Return the transient after a move begins in s, 5 T + tau (Table I of the paper)."""
        return 5.0 * self.real('time_constant') + self.real('delay')


def parameter(name: str, value: object = None) -> Parameter:
    """Return the parameter ``name``; the error message names the most similar one.

    ``value`` is what was given for it, for the message on a topic that is no parameter.
    """
    row = PARAMETERS.get(name)
    if row is None and name in _TOPICS:
        theirs = value if isinstance(value, str) and value else 'TOPIC'
        raise ParameterError(
            name,
            f'does not exist: it is a topic; remap it with -r {name}:={theirs} after --ros-args',
        )
    if row is None:
        near = difflib.get_close_matches(str(name), PARAMETERS, n=1)
        hint = f"; did you mean '{near[0]}'?" if near else ''
        raise ParameterError(name, f'does not exist{hint}')
    return row


def covariate_columns(
    said: Iterable[str], where: str = '--covariate', column: str = 'COLUMN'
) -> dict[str, str]:
    """Return ``COLUMN`` or ``COLUMN:UNIT`` of texts ``NAME=COLUMN[:UNIT]``, by name.

    Raises `UsageError` if a text has another form, or a name is given twice. The message begins
    with ``where`` and calls the column ``column``.
    """
    found: dict[str, str] = {}
    for text in said:
        name, equals, theirs = (part.strip() for part in text.partition('='))
        if not equals or not name or not theirs:
            raise UsageError(f"{where} '{text}' is not of the form NAME={column}[:UNIT].")
        if name in found:
            raise UsageError(f'{where} {name} is given twice.')
        found[name] = theirs
    return found


def _check_covariates(text: str) -> None:
    try:
        count = len(covariate_columns(text.split(), 'entry', 'TOPIC'))
    except UsageError as error:
        raise ParameterError('covariates', f'cannot be used: {str(error).rstrip(".")}') from None
    if count > _MOST_COVARIATES:
        raise ParameterError('covariates', f'has {count} entries, at most {_MOST_COVARIATES}')


def _check_zone(name: str) -> None:
    try:
        zone_of(name)
    except InputError:
        told = 'use a name such as Europe/Berlin, or an offset such as +01:00'
        raise ParameterError('time_zone', f"is no zone, '{name}'; {told}") from None


def _check_together(values: Mapping[str, Value]) -> None:
    """Raise `ParameterError` if valid values contradict each other."""
    _check_zone(str(values['time_zone']))
    _check_covariates(str(values['covariates']))
    for signal in ('valve_opening', 'main_steam_pressure', 'main_steam_temperature',
                   'generated_power'):  # fmt: skip
        low, high = float(values[f'{signal}_low']), float(values[f'{signal}_high'])
        if not low < high:
            raise ParameterError(
                f'{signal}_low', f'({low:g}) must be below {signal}_high ({high:g})'
            )
    period = float(values['sample_period'])
    names = ('hold_limit', 'block', 'alarm_block', 'alarm_average')
    if short := [name for name in names if float(values[name]) < period]:
        first, *others = (f'{name} ({float(values[name]):g} s)' for name in short)
        told = listed([first.removeprefix(f'{short[0]} '), *others])
        raise ParameterError(short[0], f'{told} must not be below sample_period ({period:g} s)')
    if values['selection_rule'] == 'prediction_error' and not values['refine']:
        raise ParameterError('selection_rule', 'must be paper when refine is false')
    longest, window_s = float(values['longest_segment']), 86400.0 * float(values['window_days'])
    if longest < 6.0 * float(values['block']):
        raise ParameterError('longest_segment', 'must be at least six times block')
    for name in ('steady_min', 'slope_min'):
        if float(values[name]) > longest:
            raise ParameterError(name, 'must not be above longest_segment')
    if window_s <= longest:
        raise ParameterError('window_days', f'must be longer than longest_segment ({longest:g} s)')
    if window_s / period > _MOST_ROWS:
        raise ParameterError(
            'window_days', f'holds more than {_MOST_ROWS:,} rows at this sample_period'
        )
    if float(values['slope_limit']) <= float(values['steady_limit']):
        raise ParameterError('slope_limit', 'must be above steady_limit')


def as_yaml(rows: Iterable[Parameter] = TABLE, values: Mapping[str, Value] | None = None) -> str:
    """Write a commented ROS 2 parameter file for any node name.

    Parameters
    ----------
    rows : iterable of Parameter
        Which rows to write.
    values : mapping, optional
        Values that differ from the defaults.
    """
    lines = ['/**:', '  ros__parameters:']
    for row in rows:
        about = row.sentence
        if row.low is not None and row.high is not None:
            about += f' Range {row.low:g} to {row.high:g}'
            about += f' {row.unit}.' if row.unit else '.'
        if row.choices:
            about += f' One of {", ".join(row.choices)}.'
        if row.live:
            about += ' May be changed while running.'
        lines.append(f'    # {about}')
        value = row.default if values is None else values.get(row.name, row.default)
        lines.append(f'    {row.name}: {_yaml_scalar(value)}')
    return '\n'.join(lines) + '\n'


def _yaml_scalar(value: Value) -> str:
    if isinstance(value, bool):
        return 'true' if value else 'false'
    if isinstance(value, str):
        return "'" + value.replace("'", "''") + "'"
    if isinstance(value, float):
        # In YAML 1.1 a number with an exponent but without a decimal point is a text.
        mantissa, exponent, power = repr(value).partition('e')
        return (mantissa if '.' in mantissa else mantissa + '.0') + exponent + power
    return str(value)
