"""How well the model fits, and how the diagnoses go: an item each."""

from __future__ import annotations

import json

from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.ros.diagnosis_message import NOT_YET
from valveflow_ros.ros.diagnostics import Item, Level
from valveflow_ros.ros.worker.worker import DiagnosisWorker


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
