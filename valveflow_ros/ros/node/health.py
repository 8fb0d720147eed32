"""How the work goes: an item each for the fit, the alarm and the recorder."""

from __future__ import annotations

import json
import math

from valveflow_ros.errors import counted
from valveflow_ros.fit.result import weaknesses
from valveflow_ros.logs import RecorderState
from valveflow_ros.monitoring.alarm import Alarm, AlarmState
from valveflow_ros.monitoring.curves import CurveStatus
from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.ros.conversions import NOT_YET
from valveflow_ros.ros.diagnostics import Item, Level
from valveflow_ros.ros.node.recording import Recording
from valveflow_ros.ros.worker.worker import DiagnosisWorker, FitWorker

# Somebody knows of it, or nothing can be known of it.
_ASIDE = (AlarmState.SHELVED, AlarmState.SUPPRESSED)


def fit_item(monitor: Monitor, worker: FitWorker, last_fit_s: float | None) -> Item:
    """Return how the curve is, and the process that fits it."""
    curve = monitor.characteristic
    values = _fit_values(monitor, worker, last_fit_s)
    if worker.failures_in_a_row:
        sentence = (
            f'{monitor.cause} {counted(worker.failures_in_a_row, "failure")} in a row.'.strip()
        )
        return Item('fit', Level.ERROR, sentence, values)
    if curve is None:
        refused = monitor.status == CurveStatus.REFUSED
        return Item('fit', Level.WARN if refused else Level.OK, monitor.cause, values)
    if monitor.status == CurveStatus.STALE:
        return Item('fit', Level.WARN, f'The curve is not renewed: {monitor.cause}', values)
    if curve.source.temperature_flag:
        return Item(
            'fit',
            Level.WARN,
            f'The main steam temperature spread over {curve.source.temperature_spread_k:.1f} K; '
            'the method assumes an unchanged one, so the curve is to be doubted.',
            values,
        )
    weak = weaknesses(curve)
    if weak:
        more = f' Weak points in all: {len(weak)}.' if len(weak) > 1 else ''
        return Item('fit', Level.WARN, weak[0] + more, values)
    return Item('fit', Level.OK, f'A curve of {counted(len(curve.pieces), "piece")}.', values)


def _fit_values(
    monitor: Monitor, worker: FitWorker, last_fit_s: float | None
) -> dict[str, object]:
    curve = monitor.characteristic
    noise = monitor.noise()
    return {
        'Status': monitor.status.name.lower(),
        'Model': '' if curve is None else curve.model_id,
        'Pieces': 0 if curve is None else len(curve.pieces),
        'Age of the curve (s)': None if curve is None else _age_s(monitor),
        'Special segments in the window': monitor.segments,
        'Special samples in the window': monitor.special_samples,
        'Samples taken': monitor.rows,
        'Noise of the integrated input (% MPa^e)': noise.input,
        'Noise of the power (MW)': noise.power_mw,
        'Temperature spread (K)': math.nan if curve is None else curve.source.temperature_spread_k,
        'Refit under way for (s)': worker.busy_s,
        'Last refit took (s)': last_fit_s,
        'Fit process starts': worker.starts,
        'Notes': '' if curve is None else ' '.join(curve.notes),
    }


def _age_s(monitor: Monitor) -> float:
    curve = monitor.characteristic
    if curve is None:
        return math.nan
    # The clock may have gone back behind what the curve was found from.
    return max(0.0, (monitor.last_ns - curve.source.window_end_ns) / 1e9)


def alarm_item(monitor: Monitor) -> Item:
    """Return how the residual alarm stands, whether or not that was announced."""
    alarm = monitor.alarm
    words = _words(alarm)
    values: dict[str, object] = {
        'State': words,
        'Evidence (1 is an alarm)': monitor.judged.evidence,
        'Shift (MW)': monitor.judged.shift_mw,
        **_count_values(alarm),
    }
    if alarm.active:
        aside = alarm.state in _ASIDE
        level = Level.WARN if aside else Level.ERROR
        return Item('alarm', level, f'The unit does not follow its curve ({words}).', values)
    if alarm.state == AlarmState.SUPPRESSED:
        sentence = 'The residual cannot be judged, so no alarm can come (suppressed).'
        return Item('alarm', Level.WARN, sentence, values)
    if alarm.standing:
        return Item('alarm', Level.WARN, f'The alarm waits to be cleared ({words}).', values)
    return Item('alarm', Level.OK, 'No alarm.', values)


def _words(alarm: Alarm) -> str:
    return alarm.state.name.lower().replace('_', ' ')


def _count_values(alarm: Alarm) -> dict[str, object]:
    """Return what an announcement may not have told yet."""
    until_ns = alarm.shelved_until_ns
    return {
        'Occurrences': alarm.occurrence,
        'Announcements held back': alarm.held,
        'Shelved until (s since 1970)': None if until_ns is None else until_ns // 10**9,
    }


def reference_item(monitor: Monitor) -> Item:
    """Return how the curve stands to its reference."""
    keeper = monitor.reference
    if keeper.curve is None:
        return Item('reference', Level.OK, 'No reference was set (~/set_reference).')
    shift = keeper.shift
    values: dict[str, object] = {
        'Reference': keeper.curve.model_id,
        'Alarm': _words(keeper.alarm),
        **_count_values(keeper.alarm),
    }
    if shift is not None:
        sizes = [p.shift_mw for p in shift.pieces]
        values['Shift by piece (MW)'] = ', '.join(f'{size:+.2f}' for size in sizes)
        values['Shift since (s since 1970)'] = shift.since_ns // 10**9 or None
    if keeper.problem:
        return Item('reference', Level.WARN, keeper.problem, values)
    level = Level.WARN if keeper.alarm.standing else Level.OK
    if keeper.alarm.active and keeper.alarm.state not in _ASIDE:
        level = Level.ERROR
    # After a restart no curve was judged yet, and the alarm stands all the same.
    sentence = 'The next curve is judged against it.' if shift is None else shift.sentence
    if keeper.alarm.active and (shift is None or not shift.moved):
        spans = ' and '.join(f'u {a:.0f} to {b:.0f}' for a, b in keeper.alarm.ranges)
        moved = f'what moved, {spans}, is not judged unmoved yet' if spans else 'doubt is left'
        sentence = f'The alarm stands: {moved}. {sentence}'
    return Item('reference', level, sentence, values)


def recorder_item(recording: Recording) -> Item:
    """Return how the recording goes."""
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
        'Files finished': status.files_finished,
        'Bytes written': status.bytes_written,
    }
    if status.state != RecorderState.RECORDING:
        return Item('recorder', Level.ERROR, f'Not recording: {status.reason}', values)
    if dropped or status.lost:
        missing = dropped + status.lost
        return Item(
            'recorder',
            Level.WARN,
            f'{counted(missing, "message is", "messages are")} missing.',
            values,
        )
    return Item('recorder', Level.OK, 'Recording.', values)


# How well the model fits, and how the diagnoses go: an item each.


def model_item(monitor: Monitor) -> Item:
    """Return whether the model still fits."""
    diagnosing = monitor.diagnosing
    values: dict[str, object] = {
        'Loudest statistic': diagnosing.misfit.name,
        'Its distance from zero (standard errors)': diagnosing.misfit.score,
        'Limit (standard errors)': monitor.settings.real('mismatch_limit'),
    }
    if diagnosing.sentence:
        return Item('model', Level.WARN, diagnosing.sentence, values)
    if not diagnosing.misfit.name:
        return Item('model', Level.OK, 'Not judged yet: that takes a day with a curve.', values)
    return Item('model', Level.OK, 'The model fits.', values)


def diagnosis_item(monitor: Monitor, worker: DiagnosisWorker, last_s: float | None) -> Item:
    """Return what the last diagnosis said, and whether one is running."""
    last = monitor.diagnosing.last
    values: dict[str, object] = {
        'Verdict': 'unknown',
        'Data until (s since 1970)': None if last is None else last.task.window_end_ns // 10**9,
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
