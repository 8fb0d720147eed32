# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The diagnosis in the running node: asked for, computed elsewhere, published, repeated."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import hurt_jobs
import pytest
from rclpy.lifecycle import TransitionCallbackReturn as Transition
from rclpy.parameter import Parameter
from rclpy.serialization import deserialize_message
from ros_helpers import Processes, wait_until
from test_ros_live import SlowWorker, rows_of
from valveflow_msgs.msg import Diagnosis
from valveflow_msgs.msg import JournalEntry as JournalMessage

from valveflow_ros.errors import DataError
from valveflow_ros.monitoring.events import (
    Diagnosed,
    DiagnosisRequested,
    DiagnosisTask,
    Event,
    JournalEntry,
    JournalKind,
)
from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.monitoring.offline import JournalReplayer
from valveflow_ros.parameters import Settings
from valveflow_ros.plant.simulator import simulate
from valveflow_ros.plant.unit import UnitDescription
from valveflow_ros.records import NS_PER_S, Readings, table_to_readings, zone_of
from valveflow_ros.report.words import in_zone
from valveflow_ros.ros import encoding
from valveflow_ros.ros.node.diagnostics import Level, line_of
from valveflow_ros.ros.node.engine import LiveEngine, example_curve, example_task
from valveflow_ros.ros.node.health import diagnosis_item, model_item
from valveflow_ros.ros.node.monitor_node import MonitorNode
from valveflow_ros.ros.node.outputs import Output, Outputs
from valveflow_ros.ros.node.worker import DiagnosisWorker, compute
from valveflow_ros.ros.simulator_main import effects_of
from valveflow_ros.ros.verify import diagnose_in_process
from valveflow_ros.signals.align import Aligner

pytestmark = pytest.mark.usefixtures('jobs_on_path')
STEP_S, FAULT_DAYS = 10.0, 0.5
SETTINGS = Settings(
    {'sample_period': STEP_S, 'refit_period': 28800.0, 'refit_segments': 0, 'diagnosis_hour': 2}
)


def task_of() -> DiagnosisTask:
    contents, curve = example_task(Settings()).contents, example_curve(Settings())
    end_ns = int(contents.time_ns[-1])
    return DiagnosisTask(end_ns, contents, Settings(), curve.with_id(), end_ns)


TASK = task_of()


@pytest.mark.parametrize(
    ('job', 'words'),
    [
        ('diagnosed', ''),
        ('dies', 'The diagnosis process ended unexpectedly (signal SIGKILL).'),
        (
            'hangs',
            'The diagnosis took longer than 1 s and was ended (parameter diagnosis_timeout).',
        ),
    ],
)
def test_each_task_has_a_process_and_an_outcome(job: str, words: str) -> None:
    made = DiagnosisWorker(1.0 if job == 'hangs' else 60.0, f'hurt_jobs:{job}')
    assert made.poll() == []
    assert made.pid is None
    made.submit(TASK)
    try:
        (outcome,) = wait_until(made.poll, 'the outcome')
        assert outcome.request_ns == TASK.request_ns
        assert outcome.result == (words or hurt_jobs.diagnosed(TASK))
        assert (made.starts, made.pid, made.busy_s) == (1, None, None)
    finally:
        made.close()


@pytest.mark.parametrize(
    ('job', 'words'),
    [
        ('diagnosed', ''),
        ('nothing', 'gave no result'),
        ('diagnosed_other_data', 'answered for other data'),
        ('no_verdict', 'gave no verdict'),
        ('half', 'cannot be checked (KeyError)'),
        ('raises', 'The diagnosis failed unexpectedly: a fault (ZeroDivisionError'),
        ('refuses', 'There is no curve in these data.'),
    ],
)
def test_a_bad_result_is_a_sentence(job: str, words: str) -> None:
    given = compute(getattr(hurt_jobs, job), TASK, 'diagnosis')
    believed = DiagnosisWorker(60.0)._believed(TASK, given)
    if words:
        assert isinstance(believed, str)
        assert words in believed
        assert believed.endswith('.')
    else:
        assert believed == hurt_jobs.diagnosed(TASK)


def test_no_result_is_unknown_and_says_why() -> None:
    (told,) = Outputs('unit 1').of([Diagnosed(TASK, '', 'Because.')])
    message = deserialize_message(told.data, Diagnosis)
    assert (message.verdict, message.sentence) == (Diagnosis.UNKNOWN, 'Because.')
    assert (message.model_id, message.header.frame_id) == (TASK.curve.model_id, 'unit 1')
    assert math.isnan(message.rmse_simulation)
    assert len(message.causes) == 0
    first = next(o for o in Outputs('u').latched() if o.name == 'diagnosis')
    before = deserialize_message(first.data, Diagnosis)
    assert (before.verdict, before.model_id) == (Diagnosis.UNKNOWN, '')
    assert before.sentence == encoding.NOT_YET


def test_what_a_replay_reads_of_the_journal_is_not_told_in_a_zone() -> None:
    entry = JournalEntry(0, JournalKind.RESET, 0, 1, '', 'since 2024-01-02 00:30 UTC')
    (told,) = Outputs('u', zone=zone_of('+05:00')).of([entry])
    assert deserialize_message(told.data, JournalMessage).text == entry.text


@pytest.fixture(scope='module')
def run() -> tuple[Readings, list[list[Event]], LiveEngine, DiagnosisWorker]:
    """A day and a quarter with a fault: too early by hand, at night, and by hand at the end."""
    unit = replace(UnitDescription(), sample_period_s=STEP_S)
    effects = effects_of(['gain_step:g=-0.03,t0_days=0.6'])
    readings = table_to_readings(simulate(1.25, 5, unit, effects=effects).table)
    worker = DiagnosisWorker(300.0)
    engine = LiveEngine(SETTINGS, SlowWorker(1), worker)
    rows, calls = rows_of(readings), []
    with pytest.raises(DataError, match='no curve'):
        engine.request_diagnosis()
    for start in range(0, len(rows), 3000):
        calls += [engine.poll(), engine.feed(rows[start : start + 3000])]
        if start == 24_000:
            with pytest.raises(DataError, match='A diagnosis needs a day of data; the'):
                engine.request_diagnosis()
    calls.append(wait_until(engine.poll, 'the diagnosis of the night'))
    calls += [engine.request_diagnosis(), wait_until(engine.poll, 'the diagnosis')]
    with_end = wait_until(lambda: not engine.monitor.diagnosing.pending, 'the end')
    assert with_end
    worker.close()
    return readings, calls, engine, worker


def said(calls: list[list[Event]]) -> list[Output]:
    outputs = Outputs('u', begun_ns=1)
    return [*outputs.latched(), *(output for events in calls for output in outputs.of(events))]


def test_the_night_and_a_hand_bring_a_diagnosis(
    run: tuple[Readings, list[list[Event]], LiveEngine, DiagnosisWorker],
) -> None:
    _, calls, engine, worker = run
    events = [event for events in calls for event in events]
    asked = [event.task for event in events if isinstance(event, DiagnosisRequested)]
    found = [event for event in events if isinstance(event, Diagnosed)]
    assert [e.task.request_ns for e in found] == [task.request_ns for task in asked]
    assert len(found) >= 2
    assert found[-1].task.window_end_ns == engine.monitor.last_ns
    assert found[-1].content, found[-1].reason
    assert len(found[-1].task.contents.time_ns) == 0
    messages = [deserialize_message(o.data, Diagnosis) for o in said(calls)
                if o.name == 'diagnosis']  # fmt: skip
    assert len(messages) == len(found) + 1
    content = json.loads(found[-1].content)
    assert messages[-1].verdict == encoding.VERDICTS[content['verdict']]
    assert messages[-1].sentence == content['sentence']
    assert [c.name for c in messages[-1].causes] == [c['name'] for c in content['causes']]
    assert [c.to_do for c in messages[-1].causes] == [c['to_do'] for c in content['causes']]
    assert all('MW' in c.meaning and c.to_do for c in messages[-1].causes)
    local = [*Outputs('u', zone=zone_of('+05:00')).of([found[-1]])]
    (told,) = [deserialize_message(o.data, Diagnosis) for o in local]
    assert ' UTC+05:00' in told.sentence
    assert told.sentence == in_zone(content['sentence'], zone_of('+05:00'))
    assert {'gain_step', 'curve_step'} & {c['name'] for c in content['causes']}
    assert messages[-1].rmse_extended < messages[-1].rmse_simulation
    level, line = line_of(found[-1]) or (Level.OK, '')
    assert (level, line) == (Level.WARN, f'diagnosis: {content["sentence"]}')
    item = diagnosis_item(engine.monitor, worker, engine.last_diagnosis_s)
    assert (item.level, item.sentence) == (Level.WARN, content['sentence'])
    assert item.values['Verdict'] == 'named'
    assert item.values['Running'] is False
    assert engine.last_diagnosis_s is not None
    assert model_item(engine.monitor).sentence.endswith('.')


def test_replaying_the_journal_repeats_each_diagnosis_byte_for_byte(
    run: tuple[Readings, list[list[Event]], LiveEngine, DiagnosisWorker],
) -> None:
    readings, calls, _, _ = run
    journal = [e for events in calls for e in events if isinstance(e, JournalEntry)]
    table = Aligner(SETTINGS).feed(readings).table
    replayer = JournalReplayer(Monitor(SETTINGS), journal, diagnose_in_process)
    assert said([replayer.feed(table)]) == said(calls)
    entry = JournalEntry(0, JournalKind.DIAGNOSED, 5, 0, '', '')
    with pytest.raises(DataError, match='never asked for'):
        JournalReplayer(Monitor(SETTINGS), [entry]).feed(table)


@pytest.mark.ros
def test_a_node_that_comes_late_hears_the_diagnosis(
    context: Any, processes: Processes, tmp_path: Path
) -> None:
    """A day of data, the real processes for curve and diagnosis, DDS, a listener of its own."""
    unit = replace(UnitDescription(), sample_period_s=STEP_S)
    effects = effects_of([f'gain_step:g=-0.03,t0_days={FAULT_DAYS}'])
    log = simulate(1.02, 5, unit, effects=effects)
    overrides = [
        Parameter('record_directory', value=str(tmp_path / 'recordings')),
        Parameter('unit_tag', value='unit 1'),
        Parameter('sample_period', value=STEP_S),
        Parameter('refit_period', value=86_400.0),
        Parameter('refit_segments', value=0),
        Parameter('refine', value=False),
        Parameter('selection_rule', value='paper'),
        Parameter('diagnosis_hour', value=-1),
    ]
    node = MonitorNode(context=context, parameter_overrides=overrides)
    try:
        assert node.trigger_configure() == node.trigger_activate() == Transition.SUCCESS
        session = node.session
        assert session is not None
        session.publish(session.engine.feed(rows_of(table_to_readings(log.table))))
        wait_until(lambda: node.step() or session.engine.monitor.characteristic, 'the curve')
        session.publish(session.engine.request_diagnosis())
        wait_until(lambda: node.step() or session.engine.monitor.diagnosing.last, 'a diagnosis')
        listener = processes.start('late_listener', session.outputs['diagnosis'])
        wait_until(lambda: listener.poll() is not None, 'the end of the listener')
    finally:
        node.end_session()
        node.destroy_node()
    said = json.loads(processes.output(listener))
    assert (said['verdict'], said['tag']) == (Diagnosis.NAMED, 'unit 1')
    last = session.engine.monitor.diagnosing.last
    assert said['sentence'] == json.loads(last.content)['sentence']
    assert said['model_id'] == last.task.curve.model_id
    assert said['until'] == list(divmod(int(log.table.time_ns[-1]), NS_PER_S))
    assert said['rmse'][1] < said['rmse'][0]
    (step,) = (c for c in said['causes'] if 't0_days' in c['values'])
    begin_s = int(log.table.time_ns[0]) / NS_PER_S
    onset = datetime.fromtimestamp(begin_s + FAULT_DAYS * 86_400.0, tz=timezone.utc)
    assert f'{onset:%Y-%m-%d}' in step['sentence']
    assert step['values']['t0_days'] == pytest.approx(FAULT_DAYS, abs=0.05)
    assert any(unit.startswith('days since 20') for unit in step['units'])
