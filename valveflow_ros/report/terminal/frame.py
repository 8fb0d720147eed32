# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The content of the terminal view at one time: plain records, and sentences for them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from valveflow_ros.records import NS_PER_S
from valveflow_ros.report.words import counted, decimals, duration, moment, signed

# The numbers of the messages in plain words.
CURVE_STATES = ('no curve yet', 'fresh', 'stale', 'refused', 'provisional')
SAMPLE_STATES = (
    'no curve yet', 'plant in motion', 'steady state', 'on a long ramp', 'outside the curve',
    'bad or missing data',
)  # fmt: skip
ALARM_STATES = (
    'normal', 'ALARM, not acknowledged', 'ALARM, acknowledged',
    'gone by itself, not acknowledged', 'shelved for a time', 'cannot be judged now',
    'out of service',
)  # fmt: skip
VERDICTS = ('not diagnosed yet', 'no cause found', 'cause named', 'unexplained')
NORMAL, UNACKNOWLEDGED, ACKNOWLEDGED = 0, 1, 2
OUTSIDE, BAD_DATA = 4, 5
OK, WARN, ERROR, STALE = 0, 1, 2, 3


@dataclass(frozen=True, slots=True)
class CurveView:
    """The flow characteristic."""

    breakpoints: tuple[float, ...]  # u in % MPa^m of the ends of the pieces; empty: no curve
    values: tuple[float, ...]  # power in MW there
    state: int  # index in `CURVE_STATES`
    cause: str  # why it is not up to date
    model_id: str
    window: tuple[int, int]  # first and last time of its data in ns; 0 if there are none
    samples: int
    rmse_mw: float
    shift: str  # the judgement against the reference; empty if there is none
    exponent: float = math.nan  # the m of u = V p^m; NaN if unknown


@dataclass(frozen=True, slots=True)
class SampleView:
    """One sample and the prediction of the curve; NaN if unknown."""

    time_ns: int
    state: int  # index in `SAMPLE_STATES`
    u: float
    measured_mw: float
    residual_mw: float
    average_mw: float  # running mean of the residual
    low_mw: float  # expected 95 % range of the residual
    high_mw: float
    evidence: float  # beyond 1 or -1 the alarm is raised


@dataclass(frozen=True, slots=True)
class AlarmView:
    """One alarm: name, index in `ALARM_STATES`, sentence, time when raised (0: never)."""

    name: str
    state: int
    sentence: str
    raised_ns: int

    @property
    def standing(self) -> bool:
        """Return True if the alarm needs attention."""
        return self.state != NORMAL


@dataclass(frozen=True, slots=True)
class HealthView:
    """The state of an input, the recorder or another item: OK, WARN, ERROR or STALE; and why."""

    name: str
    level: int
    sentence: str


@dataclass(frozen=True, slots=True)
class DiagnosisView:
    """The last diagnosis."""

    verdict: int  # index in `VERDICTS`
    sentence: str
    causes: tuple[str, ...]  # their names
    until_ns: int  # end of the data
    advice: tuple[str, ...] = ()  # effect of each cause in MW, and what to do, if known


@dataclass(frozen=True, slots=True)
class Frame:
    """The complete content of the view at one time."""

    unit: str = ''  # its tag; empty if unknown
    source: str = ''  # description of the data source
    now_ns: int = 0  # time of the plant; 0 before the first message
    note: str = ''  # at the top, for example what the view is waiting for
    curve: CurveView | None = None
    last: SampleView | None = None
    samples: tuple[SampleView, ...] = ()
    alarms: tuple[AlarmView, ...] = ()
    inputs: tuple[HealthView, ...] = ()
    recorder: HealthView | None = None
    diagnosis: DiagnosisView | None = None


def _word(words: tuple[str, ...], number: int) -> str:
    return words[number] if 0 <= number < len(words) else f'state {number}'


# A sentence and its style, one of `text.TONES` or '' for plain.
Said = tuple[str, str]
NO_CURVE = 'There is no curve yet.'
_SHORT = {
    'valve_opening': 'opening', 'main_steam_pressure': 'pressure',
    'main_steam_temperature': 'temperature', 'generated_power': 'power',
    'valve_command': 'command',
}  # fmt: skip
_TONES = {OK: '', WARN: 'warn', STALE: 'bad'}


def curve_words(curve: CurveView | None, now_ns: int) -> Said:
    """Return the age and the data of the curve in words."""
    if curve is None:
        return NO_CURVE, 'warn'
    if not curve.breakpoints:
        return curve.cause or NO_CURVE, 'warn'
    first, last = curve.window
    told = [
        f'{_word(CURVE_STATES, curve.state)}, {counted(len(curve.breakpoints) - 1, "piece")}',
        f'{counted(curve.samples, "sample")} of {duration((last - first) / NS_PER_S)} '
        f'until {_minute(last)}',
    ]
    if now_ns >= last:
        told.append(f'{duration((now_ns - last) / NS_PER_S)} old')
    if math.isfinite(curve.rmse_mw):
        told.append(f'scatter {decimals(curve.rmse_mw, 2)} MW')
    text = ', '.join(told) + '.'
    if curve.cause:
        return f'{text} {curve.cause}', 'warn'
    return f'{text} {curve.shift}'.rstrip(), ''


def sample_words(sample: SampleView | None) -> Said:
    """Return the position of the last sample relative to the curve in words."""
    if sample is None:
        return 'There is no prediction yet, so no residual.', 'dim'
    state = _word(SAMPLE_STATES, sample.state)
    if not math.isfinite(sample.residual_mw):
        return f'{state}.', 'bad' if sample.state == BAD_DATA else 'dim'
    text = f'{signed(sample.residual_mw)} MW ({state})'
    inside = sample.low_mw <= sample.residual_mw <= sample.high_mw
    if math.isfinite(sample.low_mw) and math.isfinite(sample.high_mw):
        text += f', limits {signed(sample.low_mw)} to {signed(sample.high_mw)}'
    if math.isfinite(sample.average_mw):
        text += f', mean {signed(sample.average_mw)}'
    if math.isfinite(sample.evidence):
        text += f', residual alarm at {decimals(100.0 * abs(sample.evidence), 0)} % of its limit'
    return f'{text}.', '' if inside or sample.state == OUTSIDE else 'warn'


def alarm_words(alarm: AlarmView) -> Said:
    """Return the state of an alarm in words."""
    known = alarm.standing and alarm.raised_ns
    raised = f', raised {_minute(alarm.raised_ns)}' if known else ''
    text = f'{alarm.name}: {_word(ALARM_STATES, alarm.state)}{raised}. {alarm.sentence}'
    return text, 'bad' if alarm.state in (UNACKNOWLEDGED, ACKNOWLEDGED) else 'warn'


def alarms_words(frame: Frame) -> list[Said]:
    """Return the standing alarms in words, the most urgent first."""
    standing = [alarm for alarm in frame.alarms if alarm.standing]
    if not standing:
        return [('None.', 'good')]
    return [alarm_words(a) for a in sorted(standing, key=lambda a: (a.state, a.raised_ns))]


def inputs_words(frame: Frame) -> list[Said]:
    """Return a line for each faulty input, and one line for all others."""
    if not frame.inputs:
        return [('Nothing has come from any of them yet.', 'dim')]
    # A problem of several inputs at once is one line, for example a stopped gateway.
    groups: dict[tuple[int, str], list[str]] = {}
    for item in frame.inputs:
        if item.level != OK:
            groups.setdefault((item.level, item.sentence), []).append(item.name)
    wrong = [
        (f'{", ".join(map(short_name, names))}: {sentence}', _TONES.get(level, 'bad'))
        for (level, sentence), names in groups.items()
    ]
    fine = [
        f'{short_name(i.name)} {i.sentence.rstrip(".")}' for i in frame.inputs if i.level == OK
    ]
    return [*wrong, *([(', '.join(fine), '')] if fine else [])]


def health_words(item: HealthView) -> Said:
    """Return the state of one item in words."""
    return f'{short_name(item.name)}: {item.sentence}', _TONES.get(item.level, 'bad')


def recorder_words(frame: Frame) -> Said:
    """Return the state of the recorder in words."""
    if frame.recorder is None:
        return 'Nothing is known of it yet.', 'dim'
    return frame.recorder.sentence, _TONES.get(frame.recorder.level, 'bad')


def diagnosis_words(diagnosis: DiagnosisView | None) -> Said:
    """Return the result of the last diagnosis in words."""
    if diagnosis is None:
        return 'There is no diagnosis yet.', 'dim'
    if not diagnosis.verdict and diagnosis.sentence:
        return diagnosis.sentence, 'dim'
    names = f' ({", ".join(diagnosis.causes)})' if diagnosis.causes else ''
    until = f' in the data until {_minute(diagnosis.until_ns)}' if diagnosis.until_ns else ''
    text = f'{_word(VERDICTS, diagnosis.verdict)}{names}{until}. {diagnosis.sentence}'
    return ' '.join([text, *diagnosis.advice]), 'warn' if diagnosis.verdict in (2, 3) else ''


def _minute(time_ns: int) -> str:
    return f'{moment(time_ns)[:16]} UTC'


def short_name(name: str) -> str:
    """Return the short name of a signal, for narrow places."""
    return _SHORT.get(name, name)
