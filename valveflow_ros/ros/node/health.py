# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Health items of the inputs, the fit, the alarms, the diagnosis and the recorder."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from rclpy.node import Node

from valveflow_ros.errors import counted, listed
from valveflow_ros.fit.result import weaknesses
from valveflow_ros.logs import Qos, RecorderState
from valveflow_ros.monitoring.alarm_state import Alarm, AlarmState
from valveflow_ros.monitoring.curves import CurveStatus
from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.parameters import Settings
from valveflow_ros.records import NS_PER_S, SIGNALS, SignalInfo
from valveflow_ros.report.data import reason_words
from valveflow_ros.report.words import duration
from valveflow_ros.ros.decoding import INPUT_BY_NAME, PLANT_SAMPLE, Row
from valveflow_ros.ros.encoding import NOT_YET
from valveflow_ros.ros.node.diagnostics import Item, Level
from valveflow_ros.ros.node.intake import TopicStatistics
from valveflow_ros.ros.node.recording import Recording, recorded_qos
from valveflow_ros.ros.node.worker import DiagnosisWorker, FitWorker
from valveflow_ros.signals.align import REASONS, plausible_ranges
from valveflow_ros.signals.units import better_units, unit_of

_NO_LEAD = -(2**63)
_FAR_BEHIND_NS = 120 * NS_PER_S


@dataclass(frozen=True, slots=True)
class Publishers:
    """The publishers of one topic.

    ``right`` have the expected type; ``wrong_types`` are published on the same topic, too.
    """

    right: int = 0
    wrong_types: tuple[str, ...] = ()


def publishers(node: Node, topic: str, type_name: str) -> Publishers:
    """Return the publishers of a topic in the ROS graph; ROS itself reports no wrong types."""
    found = node.get_publishers_info_by_topic(topic)
    right = [info for info in found if info.topic_type == type_name]
    wrong = sorted({info.topic_type for info in found} - {type_name})
    return Publishers(len(right), tuple(wrong))


def offered(node: Node, topic: str, type_name: str) -> tuple[Qos, ...]:
    """Return the QoS that each publisher of a topic offers, from the ROS graph."""
    found = node.get_publishers_info_by_topic(topic)
    return tuple(recorded_qos(i.qos_profile) for i in found if i.topic_type == type_name)


_REJECTED = tuple(reason for reason in REASONS if reason not in ('accepted', 'late'))
_PATIENCE_S = 5.0
# If all readings of an input are rejected for longer than this, it is an error.
_BLIND_S = 10.0


class InputHealth:
    """Rates the inputs by what has changed since the last call.

    ``topics`` has the full topic names by contract name. ``by_host`` is True if the time of the
    plant is this machine's clock, False with a /clock. Topics with a publisher whose QoS is
    incompatible are added to ``mismatched`` from outside.
    """

    def __init__(
        self, settings: Settings, topics: Mapping[str, str], *, by_host: bool = True
    ) -> None:
        self.settings = settings
        self.mismatched: set[str] = set()
        self._topics = topics
        # Computed once, because these parameters cannot change at run time.
        self._ranges = plausible_ranges(settings).tolist()
        self._jump_ns = round(settings.real('clock_jump') * NS_PER_S)
        self._by_host = by_host
        # Lists by signal number are fast; they are updated for every message.
        self._last_ns = [0] * len(SIGNALS)
        self._lead_ns = [_NO_LEAD] * len(SIGNALS)
        self._impossible: dict[str, tuple[str, float]] = {}
        self._counted: dict[tuple[str, str], int] = {}
        self._used: dict[str, tuple[int, float]] = {}
        self._newest_ns = 0

    def begin(self, counts: Mapping[str, Mapping[str, int]]) -> None:
        """Take what became of the readings of earlier runs: it is no news."""
        for topic, reasons in counts.items():
            self._new(topic, 'rejected', sum(reasons[r] for r in _REJECTED))
            for reason in ('bad_quality', 'time_outlier'):
                self._new(topic, reason, reasons[reason])

    def note(self, name: str, rows: Sequence[Row]) -> None:
        """Store the stamps and the last impossible value of each signal, for the sentences."""
        host_ns = time.time_ns()
        for time_ns, number, value, _ in rows:
            if number >= len(SIGNALS):
                continue
            self._last_ns[number] = time_ns
            self._lead_ns[number] = max(self._lead_ns[number], time_ns - host_ns)
            low, high = self._ranges[number]
            if not low <= value <= high and math.isfinite(value):
                self._impossible[SIGNALS[number].topic] = (name, value)

    def items(
        self,
        statistics: Mapping[str, TopicStatistics],
        counts: Mapping[str, Mapping[str, int]],
        publishers: Mapping[str, Publishers],
        now_s: float,
        listening_s: float,
        newest_ns: int = 0,
    ) -> list[Item]:
        """Return an item for each signal and each covariate.

        Parameters
        ----------
        statistics, publishers : mapping
            By contract name of the topic.
        counts : mapping
            Number of readings by signal and by result (accepted or the reason of rejection).
        now_s, listening_s : float
            Monotonic time, and time since the inputs were subscribed, in s.
        newest_ns : int
            The newest stamp of an accepted reading.
        """
        self._newest_ns = newest_ns
        unknown = Publishers()
        found: list[Item] = []
        for info in SIGNALS:
            name = _speaking(info.topic, statistics, publishers)
            received, seen = statistics[name], publishers.get(name, unknown)
            reasons = counts[info.topic]
            if received.received:
                level, sentence = self._judge(info, name, received, seen, reasons, now_s)
            else:
                level, sentence = self._judge_silent(info.required, name, seen, listening_s)
            both = (info.topic, PLANT_SAMPLE)
            twice = all(publishers.get(n, unknown).right and statistics[n].received for n in both)
            if level <= Level.WARN and info.required and twice:
                level = Level.WARN
                mixed = f'{self._topics[info.topic]} and {self._topics[PLANT_SAMPLE]}'
                sentence = f'{mixed} are both published; their values are mixed. Stop one of them.'
            values = self._values(name, received, seen, reasons, now_s)
            found.append(Item(f'input {info.topic}', level, sentence, values))
        for name in (name for name in self._topics if name not in INPUT_BY_NAME):
            received, seen = statistics[name], publishers.get(name, unknown)
            level, sentence = self._judge_covariate(name, received, seen, now_s, listening_s)
            values = self._values(name, received, seen, {}, now_s)
            found.append(Item(f'input {name}', level, sentence, values))
        return found

    def _values(
        self,
        name: str,
        received: TopicStatistics,
        seen: Publishers,
        counts: Mapping[str, int],
        now_s: float,
    ) -> dict[str, object]:
        values: dict[str, object] = {
            'Topic': self._topics[name],
            'Actual frequency (Hz)': received.rate_hz(),
            'Age of the newest message (s)': received.age_s(now_s),
            'Publishers': seen.right,
            'Messages received': received.received,
            'Messages lost on the way': received.lost,
            'Messages sent before the first received': received.missed_at_start,
            'Messages with irregular numbers': received.irregular,
            'Messages that cannot be read': received.malformed,
            'Messages without a time': received.without_time,
            'Messages sent before the first /clock': received.before_clock,
            'Messages that wait for the first /clock': received.waiting,
        }
        # The engine goes on from a saved state and counts on; the intake begins anew.
        told = {f'Readings {r.replace("_", " ")} in all runs': n for r, n in counts.items()}
        return values | told

    def _judge(
        self,
        info: SignalInfo,
        name: str,
        received: TopicStatistics,
        seen: Publishers,
        counts: Mapping[str, int],
        now_s: float,
    ) -> tuple[Level, str]:
        topic = self._topics[name]
        rejected = self._new(info.topic, 'rejected', sum(counts[r] for r in _REJECTED))
        lost = self._new(info.topic, 'lost', received.lost)
        off, behind = self._stamps(info.signal)
        if name == PLANT_SAMPLE and not info.required and not any(counts.values()):
            # What is wrong with the message is told with the signals that it brings.
            return Level.OK, (
                f'{topic} has none, or leaves {info.topic}_quality at 0, unknown; it is optional.'
            )
        if seen.wrong_types:
            return _wrong_type(topic, seen)
        if received.stale(now_s):
            return Level.STALE, f'{topic} has been silent for {received.age_s(now_s):.1f} s.'
        if seen.right > 1:
            return Level.WARN, (
                f'{topic} has {seen.right} publishers; their values are mixed. Stop all but one.'
            )
        before, since_s = self._used.get(info.topic, (-1, now_s))
        since_s = since_s if counts['accepted'] == before else now_s
        self._used[info.topic] = (counts['accepted'], since_s)
        if rejected:
            why = self._why(info, counts)
            if now_s - since_s > _BLIND_S:
                blind_s = now_s - since_s
                return Level.ERROR, f'Nothing usable has come for {blind_s:.0f} s. {why}'
            if rejected == 1:
                return Level.WARN, f'1 new reading was rejected. {why}'
            return Level.WARN, f'{rejected} new readings were rejected. {why}'
        if received.without_time + received.waiting == received.received:
            return Level.ERROR, f'{topic} comes without a time; is /clock published?'
        if off:
            return Level.WARN, off
        if lost:
            return Level.WARN, f'{lost} messages of {topic} were lost on the way.'
        rate = _rate(received)
        return Level.OK, f'{rate}; {behind}.' if behind else f'{rate}.'

    def _judge_covariate(
        self,
        name: str,
        received: TopicStatistics,
        seen: Publishers,
        now_s: float,
        listening_s: float,
    ) -> tuple[Level, str]:
        topic = self._topics[name]
        if not received.received:
            return self._judge_silent(False, name, seen, listening_s)
        if seen.wrong_types:
            return _wrong_type(topic, seen)
        if received.stale(now_s):
            age_s = received.age_s(now_s)
            return Level.OK, f'{topic} has been silent for {age_s:.1f} s; it is optional.'
        return Level.OK, f'{_rate(received)}.'

    def _judge_silent(
        self, required: bool, name: str, seen: Publishers, listening_s: float
    ) -> tuple[Level, str]:
        topic = self._topics[name]
        if seen.wrong_types:
            return _wrong_type(topic, seen)
        if name in self.mismatched:
            return Level.ERROR, (
                f'{topic} is published as best effort and asked for as reliable, so nothing '
                'comes: set input_reliability, and qos_overrides if given, to best_effort.'
            )
        if not required:
            return Level.OK, f'{topic} is not sent; it is optional.'
        if listening_s < _PATIENCE_S:
            return Level.OK, f'Waiting for {topic}.'
        if seen.right:
            return Level.STALE, f'{topic} has a publisher, but nothing has come from it yet.'
        all_in_one = '' if name == PLANT_SAMPLE else f' or {self._topics[PLANT_SAMPLE]}'
        told = f'Nobody publishes {topic}{all_in_one}; remap it, or start the gateway.'
        return Level.STALE, told

    def _why(self, info: SignalInfo, counts: Mapping[str, int]) -> str:
        """Return why readings were rejected: the last impossible value, or counts by reason."""
        found = self._impossible.pop(info.topic, None)
        bad_quality = self._new(info.topic, 'bad_quality', counts['bad_quality'])
        if found is None:
            off_ns = self._last_ns[info.signal] - self._newest_ns
            outliers = self._new(info.topic, 'time_outlier', counts['time_outlier'])
            if outliers and abs(off_ns) > self._jump_ns:
                off = duration(abs(off_ns) / NS_PER_S)
                if off_ns > 0:
                    return f'The last stamp is {off} ahead of the newest one used.'
                return f'The last stamp is {off} behind the newest one used.'
            if bad_quality:
                return (
                    'The sender marked them as bad quality, or does not set '
                    f'{info.topic}_quality, which is then 0, unknown; 1 is good.'
                )
            told = reason_words({r: counts[r] for r in _REJECTED})
            return f'Rejected in all runs so far: {told}.'
        name, value = found
        low, high = self._ranges[info.signal]
        stamped = name == PLANT_SAMPLE
        named = info.unit if stamped else self.settings.text(f'{info.topic}_unit')
        unit = unit_of(info.signal, named)
        sent = (value - unit.offset) / unit.scale
        text = (
            f'The last one, {sent:g} {named}, is impossible '
            f'(accepted: {low:g} to {high:g} {info.unit}).'
        )
        fitting = better_units(info.signal, np.array([sent]), named, (low, high))
        if not fitting or self.settings.output_unit != 'MW':
            return text  # what is usual is known of a steam unit only
        suiting = listed(fitting, 'or')
        if stamped:
            return f'{text} It would be possible in {suiting}: convert to {named} before sending.'
        # YAML takes a bare % for something else.
        choices = listed([f"'{'percent' if u == '%' else u}'" for u in fitting], 'or')
        return f'{text} It would be possible in {suiting}: set {info.topic}_unit to {choices}.'

    def _stamps(self, number: int) -> tuple[str, str]:
        """Return an error and a remark about the stamps since the last call, empty if none.

        Stamps a little behind are normal for a slow gateway; stamps ahead are an error.
        """
        lead_ns, self._lead_ns[number] = self._lead_ns[number], _NO_LEAD
        if not self._by_host or lead_ns == _NO_LEAD or abs(lead_ns) <= self._jump_ns:
            return '', ''
        off = duration(abs(lead_ns) / NS_PER_S)
        if lead_ns > 0:
            return (
                f"Stamps are up to {off} ahead of this machine's clock; set both by one server.",
                '',
            )
        if lead_ns >= -_FAR_BEHIND_NS:
            return '', f"stamps are {off} behind this machine's clock"
        return (
            f"Stamps are {off} behind this machine's clock; set both by one server, or play a "
            'recording with a /clock.',
            '',
        )

    def _new(self, topic: str, what: str, count: int) -> int:
        """Return the increase of a count since the last call."""
        last = self._counted.get((topic, what), 0)
        self._counted[topic, what] = count
        return max(0, count - last)


def _rate(received: TopicStatistics) -> str:
    hz = received.rate_hz()
    if hz is None:
        return 'The first message has come'
    return f'{hz:.0f} Hz' if hz >= 100.0 else f'{hz:.3g} Hz'


def _wrong_type(topic: str, seen: Publishers) -> tuple[Level, str]:
    kinds = ' and '.join(seen.wrong_types)
    return Level.ERROR, f'{topic} is published as {kinds}, which the monitor cannot take.'


def _speaking(
    topic: str, statistics: Mapping[str, TopicStatistics], publishers: Mapping[str, Publishers]
) -> str:
    """Return the topic that carries a signal: the one received last, or the one published."""
    own, stamped = statistics[topic].last_s, statistics[PLANT_SAMPLE].last_s
    if own is None and stamped is None:
        nobody = publishers.get(topic, Publishers()) == Publishers()
        somebody = publishers.get(PLANT_SAMPLE, Publishers()) != Publishers()
        return PLANT_SAMPLE if nobody and somebody else topic
    return PLANT_SAMPLE if stamped is not None and (own is None or stamped > own) else topic


# The operator has shelved the alarm, or it cannot be evaluated.
_ASIDE = (AlarmState.SHELVED, AlarmState.SUPPRESSED)


def fit_item(monitor: Monitor, worker: FitWorker, last_fit_s: float | None) -> Item:
    """Return the item of the curve and the fit process."""
    curve = monitor.characteristic
    noise = monitor.noise()
    spread_k = age_s = None
    if curve is not None:
        spread_k = curve.source.temperature_spread_k
        # The clock may have been set back to before the end of the fitted data.
        age_s = max(0.0, (monitor.last_ns - curve.source.window_end_ns) / 1e9)
    values: dict[str, object] = {
        'Status': monitor.status.name.lower(),
        'Model': '' if curve is None else curve.model_id,
        'Pieces': 0 if curve is None else len(curve.pieces),
        'Age of the curve (s)': age_s,
        'Special segments in the window': monitor.segments,
        'Special samples in the window': monitor.special_samples,
        'Samples taken in all runs': monitor.rows,
        'Noise of the integrated input (% MPa^e)': noise.input if noise.learnt else None,
        'Noise of the power (MW)': noise.power_mw if noise.learnt else None,
        'Temperature spread (K)': spread_k,
        'Refit under way for (s)': worker.busy_s,
        'Last refit took (s)': last_fit_s,
        'Fit process starts': worker.starts,
        'Notes': '' if curve is None else ' '.join(curve.notes),
    }
    return Item('fit', *_fit(monitor, worker), values)


def _fit(monitor: Monitor, worker: FitWorker) -> tuple[Level, str]:
    curve, status = monitor.characteristic, monitor.status
    if worker.failures_in_a_row:
        failures = counted(worker.failures_in_a_row, 'failure')
        return Level.ERROR, f'{monitor.cause} {failures} in a row.'.strip()
    if curve is None:
        return Level.WARN if status == CurveStatus.REFUSED else Level.OK, monitor.cause
    if status == CurveStatus.STALE:
        return Level.WARN, f'The curve is not renewed: {monitor.cause}'
    if status == CurveStatus.PROVISIONAL:
        return Level.WARN, monitor.cause
    if curve.source.temperature_flag:
        return Level.WARN, (
            f'The main steam temperature spread over {curve.source.temperature_spread_k:.1f} K; '
            'the method assumes a constant one, so the curve may be wrong.'
        )
    if weak := weaknesses(curve):
        more = f' Weak points in all: {len(weak)}.' if len(weak) > 1 else ''
        return Level.WARN, weak[0] + more
    return Level.OK, f'A curve of {counted(len(curve.pieces), "piece")}.'


def alarm_item(monitor: Monitor) -> Item:
    """Return the item of the residual alarm, also if its state was not announced."""
    alarm = monitor.alarm
    words = _words(alarm)
    values: dict[str, object] = {
        'State': words,
        'Evidence (1 is an alarm)': monitor.judged.evidence,
        'Shift (MW)': monitor.judged.shift_mw,
        **_count_values(alarm),
    }
    level, sentence = Level.OK, 'No alarm.'
    if monitor.characteristic is None:
        sentence = 'No alarm; without a curve none can come.'
    if alarm.active:
        level = Level.WARN if alarm.state in _ASIDE else Level.ERROR
        sentence = f'The unit does not follow its curve ({words}).'
    elif alarm.state == AlarmState.SUPPRESSED:
        level = Level.WARN
        sentence = 'The residual cannot be judged, so no alarm can come (suppressed).'
    elif alarm.standing:
        level = Level.WARN
        sentence = f'The condition has gone; acknowledge the alarm to clear it ({words}).'
    return Item('alarm', level, sentence, values)


def _words(alarm: Alarm) -> str:
    return alarm.state.name.lower().replace('_', ' ')


def _count_values(alarm: Alarm) -> dict[str, object]:
    """Return the values of an alarm that may not have been announced yet."""
    return {
        'Occurrences in all runs': alarm.occurrence,
        'Announcements suppressed by alarm_flood': alarm.held,
        'Shelved until (s since 1970)': _seconds(alarm.shelved_until_ns),
    }


def _seconds(time_ns: int | None) -> int | None:
    return None if time_ns is None else time_ns // 10**9


def reference_item(monitor: Monitor) -> Item:
    """Return the item that compares the curve with its reference."""
    reference = monitor.reference
    if reference.curve is None:
        sentence = (
            'There is no reference curve yet. A curve becomes the reference after reference_after '
            'days without a fault, or when ~/set_reference is called.'
        )
        return Item('reference', Level.OK, sentence)
    shift = reference.shift
    values: dict[str, object] = {
        'Reference': reference.curve.model_id,
        'Fault since (s since 1970)': _seconds(reference.fault_ns),
        'Wear (MW a month)': None if reference.wear is None else reference.wear.mw_per_month,
        'Alarm': _words(reference.alarm),
        **_count_values(reference.alarm),
    }
    if shift is not None:
        sizes = [p.shift_mw for p in shift.pieces]
        values['Shift by piece (MW)'] = ', '.join(f'{size:+.2f}' for size in sizes)
        values['Shift since (s since 1970)'] = shift.since_ns // 10**9 or None
    if reference.problem:
        return Item('reference', Level.WARN, reference.problem, values)
    suspected = shift is not None and shift.moved
    level = Level.WARN if reference.alarm.standing or suspected else Level.OK
    if reference.alarm.active and reference.alarm.state not in _ASIDE:
        level = Level.ERROR
    # After a restart the alarm may be active although no curve was compared yet.
    sentence = 'The next curve is judged against it.' if shift is None else shift.sentence
    if reference.alarm.active and (shift is None or not shift.moved):
        spans = ' and '.join(reference.curve.place_words(*r) for r in reference.alarm.ranges)
        why = (
            f'no later curve has confirmed the reference at {spans}' if spans
            else 'the last curve is too uncertain to clear it'
        )  # fmt: skip
        sentence = f'The alarm is still active: {why}. {sentence}'
    elif suspected and not reference.alarm.active:
        sentence += ' An alarm is raised if the next curve shows it too.'
    return Item('reference', level, sentence, values)


def recorder_item(recording: Recording) -> Item:
    """Return the item of the recording."""
    status = recording.status()
    if status is None:
        wanted = recording.folder is None and 'switched off' in recording.problem
        return Item('recorder', Level.OK if wanted else Level.ERROR, recording.problem)
    dropped = sum(status.dropped.values())
    values: dict[str, object] = {
        'State': status.state.name.lower(),
        'Folder': str(recording.folder),
        'File': status.file,
        'Messages written': status.written,
        'Messages waiting': status.queued,
        'Messages dropped': dropped,
        'Messages lost': status.lost,
        'Messages in files removed since': status.removed,
        'Files finished': status.files_finished,
        'Bytes written': status.bytes_written,
    }
    level, sentence = Level.OK, 'Recording.'
    if status.state != RecorderState.RECORDING:
        level, sentence = Level.ERROR, f'Not recording: {status.reason}'
    elif dropped or status.lost:
        told = f'{counted(dropped + status.lost, "message is", "messages are")} missing.'
        level, sentence = Level.WARN, f'{told} {status.loss}'.rstrip()
    return Item('recorder', level, sentence, values)


def model_item(monitor: Monitor) -> Item:
    """Return the item that says whether the model still fits the data."""
    diagnosing = monitor.diagnosing
    values: dict[str, object] = {
        'Largest deviation': diagnosing.misfit.name,
        'Its distance from zero (standard errors)': diagnosing.misfit.score,
        'Limit (standard errors)': monitor.settings.real('mismatch_limit'),
    }
    level, sentence = Level.OK, 'The model fits.'
    if diagnosing.sentence:
        level, sentence = Level.WARN, diagnosing.sentence
    elif not diagnosing.misfit.name:
        sentence = 'Not judged yet: this needs a curve and a day of data.'
    return Item('model', level, sentence, values)


def diagnosis_item(monitor: Monitor, worker: DiagnosisWorker, last_s: float | None) -> Item:
    """Return the item of the last diagnosis and of a running one."""
    last = monitor.diagnosing.last
    values: dict[str, object] = {
        'Verdict': 'unknown',
        'Data until (s since 1970)': _seconds(last and last.task.window_end_ns),
        'Running': monitor.diagnosing.pending,
        'Running for (s)': worker.busy_s,
        'Last one took (s)': last_s,
    }
    if last is None:
        return Item('diagnosis', Level.OK, NOT_YET, values)
    if not last.content:
        return Item('diagnosis', Level.WARN, last.reason, values)
    content = json.loads(last.content)
    values['Verdict'] = content['verdict']
    values['Causes'] = ', '.join(cause['name'] for cause in content['causes'])
    level = Level.OK if content['verdict'] == 'nothing' else Level.WARN
    return Item('diagnosis', level, content['sentence'], values)
