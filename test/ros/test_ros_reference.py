# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Files given to the node: a reference that its curves are judged by, a model of known causes."""

import json
import os
import signal
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import psutil
import pytest
from extended_file import extended_json, write_extended
from listener import ended, start_monitor, start_plant
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64
from valveflow_msgs.msg import Alarm

from valveflow_ros.cli.main import main
from valveflow_ros.curve.characteristic_json import to_json
from valveflow_ros.errors import ParameterError, RecordingError
from valveflow_ros.interface import parameter_files
from valveflow_ros.logs import open_log
from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.monitoring.offline import feed_rows
from valveflow_ros.parameters import Settings
from valveflow_ros.plant.simulator import DEFAULT_START_NS, simulate
from valveflow_ros.records import NS_PER_S, SIGNALS, SampleTable, Signal
from valveflow_ros.ros import monitor_main
from valveflow_ros.ros import verify as verifying
from valveflow_ros.ros.encoding import to_time

HELD = {'backlash': {'w_percent': 0.5}, 'gain_drift': {'g': 0.05}, 'clock': {'d_s': 3.0}}
STATE = {Signal.VALVE_OPENING: 50.0, Signal.MAIN_STEAM_PRESSURE: 13.0,
         Signal.MAIN_STEAM_TEMPERATURE: 538.0, Signal.GENERATED_POWER: 200.0}  # fmt: skip


@pytest.fixture(scope='module')
def lifted():
    """The curve of some hours of the plant, and 12 MW."""
    monitor = Monitor(Settings({'refit_period': 3600.0, 'refit_segments': 0}))
    feed_rows(monitor, simulate(0.1, 7).table)
    curve = monitor.characteristic
    assert curve is not None
    pieces = tuple(replace(p, intercept=p.intercept + 12.0) for p in curve.pieces)
    return replace(curve, pieces=pieces, model_id='').with_id()


# The files


def test_a_model_that_follows_a_covariate_needs_its_topic(tmp_path):
    vacuum = {
        'name': 'vacuum', 'values': {'b': -1.2, 'a1': 0.0, 'a2': 0.0}, 'switches_s': [],
        'covariate': {
            'column': 'condenser_pressure', 'unit': 'kPa', 'spread': 1.0, 'power_mw': 200.0,
            'centre': [500.0, 100.0, 16.0, 1.0], 'surface': [1.0, *[0.0] * 9],
            'course': [5.0, 0.0, 0.0],
        },
    }  # fmt: skip
    path = tmp_path / 'extended_model.json'
    path.write_text(json.dumps({**extended_json(), 'causes': [vacuum]}), encoding='utf-8')
    without = Settings({'model_file': str(path)})
    with pytest.raises(ParameterError, match="cause 'vacuum', which follows the column"):
        parameter_files.given_model(without)
    told = Settings({'model_file': str(path), 'covariates': 'ambient=/a vacuum=/condenser:kPa'})
    corrector = parameter_files.corrector_for(parameter_files.given_model(told), told)
    assert corrector is not None
    at_200_mw = {**STATE, Signal.MAIN_STEAM_PRESSURE: 16.0, Signal.MAIN_STEAM_TEMPERATURE: 539.0,
                 Signal.VALVE_OPENING: 1250.0 / 16.0**1.125}  # fmt: skip
    rows = SampleTable.from_columns(
        NS_PER_S * np.arange(40, dtype=np.int64),
        {signal: np.full(40, value) for signal, value in at_200_mw.items()},
    )
    rows = replace(rows, covariates=np.column_stack([np.full(40, np.nan), np.full(40, 7.0)]))
    power = corrector.correct(rows).column(Signal.GENERATED_POWER)
    # Two kPa above the usual 5 take 1.2 MW each.
    assert power[-1] == pytest.approx(200.0 + 2.4, abs=1e-6)


@pytest.mark.ros
@pytest.mark.usefixtures('ros_environment')
@pytest.mark.parametrize('parameter', ['model_file', 'reference_file'])
def test_a_bad_file_keeps_the_node_from_starting(capfd, tmp_path, parameter):
    words = ['--ros-args', '-p', f'{parameter}:={tmp_path}/gone.json', '-p', 'record:=false']
    assert monitor_main.main(words) == 1
    said = capfd.readouterr().err
    assert f"names '{tmp_path}/gone.json', which cannot be used: no such file" in said
    assert 'Traceback' not in said


def test_a_recording_without_its_model_is_not_verified(tmp_path):
    log = SimpleNamespace(path=tmp_path, attachments={})
    settings = Settings({'model_file': 'gone.json'})
    with pytest.raises(RecordingError, match='lacks the attachment'):
        verifying.corrector_of_run(log, settings)
    log.attachments = {parameter_files.ATTACHMENT: b'{}'}
    with pytest.raises(RecordingError, match='an extended model that cannot be used'):
        verifying.corrector_of_run(log, settings)
    assert verifying.corrector_of_run(log, Settings()) is None


# The node


def states(listener):
    return [a.state for a in listener.alarms if a.name == 'curve_shift' and a.occurrence]


@pytest.mark.ros
@pytest.mark.slow
def test_curves_are_judged_their_alarm_is_put_aside_and_an_end_waits_for_no_refit(
    processes, listener, lifted, tmp_path
):
    given = tmp_path / 'reference.json'
    given.write_text(json.dumps(to_json(lifted)), encoding='utf-8')
    monitor = start_monitor(
        processes, tmp_path / 'recordings', reference_file=str(given), alarm_limit=500.0,
        use_sim_time=True,
    )  # fmt: skip
    listener.until(
        lambda: listener.curves and listener.curves[-1].reference_model_id == lifted.model_id,
        'the reference that was given',
    )
    success, sentence = listener.trigger('set_reference')
    assert (success, 'no curve that could become the reference' in sentence) == (False, True)
    assert listener.trigger('shelve_alarms') == (False, 'There is no alarm to shelve.')

    plant = start_plant(processes, days=0.1, use_clock=True)
    listener.until(lambda: plant.poll() is not None and states(listener), 'the alarm on the shift')
    (raised,) = (a for a in listener.alarms if a.name == 'curve_shift' and a.occurrence)
    assert (raised.state, raised.first_out) == (Alarm.UNACKNOWLEDGED, 'curve_shift')
    assert 'less than the reference' in raised.sentence
    moved = listener.until(lambda: [m for m in listener.curves if m.shift_sentence], 'the shift')
    assert len(moved[-1].shift_mw) == moved[-1].pieces
    assert min(moved[-1].shift_mw) < -5.0

    success, sentence = listener.trigger('shelve_alarms')
    assert (success, 'shelved for 8 h' in sentence) == (True, True)
    listener.until(lambda: Alarm.SHELVED in states(listener), 'the shelf')
    assert not listener.trigger('acknowledge_alarms')[0]
    assert listener.trigger('unshelve_alarms')[0]
    back = [Alarm.UNACKNOWLEDGED, Alarm.SHELVED, Alarm.UNACKNOWLEDGED]
    listener.until(lambda: states(listener) == back, 'its return')
    assert listener.trigger('unshelve_alarms') == (False, 'There is no shelved alarm.')
    assert listener.trigger('acknowledge_alarms')[0]
    success, sentence = listener.trigger('set_reference')
    model_id = listener.curves[-1].model_id
    assert (success, model_id in sentence) == (True, True)
    listener.until(lambda: listener.curves[-1].reference_model_id == model_id, 'its message')
    assert set(listener.curves[-1].shift_mw) == {0.0}
    listener.until(lambda: states(listener)[-1] == Alarm.NORMAL, 'the end of the alarm')

    (worker,) = (
        child for child in psutil.Process(monitor.pid).children()
        if any('valveflow_ros.ros.node.worker' in word for word in child.cmdline())
    )  # fmt: skip
    listener.until(lambda: listener.value('fit', 'Refit under way for (s)') == 'unknown', 'rest')
    # However fast the machine is, this refit is under way when the monitor has to end.
    worker.suspend()
    assert listener.trigger('refit')[0]
    assert listener.trigger('refit') == (False, 'A fit is running already.')
    begun = time.monotonic()
    monitor.send_signal(signal.SIGTERM)
    os.kill(monitor.pid, signal.SIGINT)
    ended(processes, monitor, 10.0)
    assert time.monotonic() - begun < 2.0
    assert not worker.is_running() or worker.status() == psutil.STATUS_ZOMBIE
    (folder,) = (tmp_path / 'recordings').glob('valveflow_*')
    assert not list(folder.glob('*.part'))
    assert (folder / 'metadata.yaml').exists()
    assert open_log(folder).warnings == ()
    result = verifying.verify(folder)
    assert result.identical, result.difference
    assert result.compared['journal'] >= 5
    assert result.compared['alarms'] == len(listener.alarms)


EARLY, LATE = 20, 30
WAITING = 'Messages that wait for the first /clock'


@pytest.mark.ros
@pytest.mark.slow
def test_values_before_the_first_clock_are_corrected_and_recorded_before_its_time(
    processes, listener, tmp_path, capsys, monkeypatch
):
    """None is lost, none stands at 1970, and the recording repeats with the model it holds."""
    model = write_extended(tmp_path / 'extended_model.json', **HELD)
    monitor = start_monitor(
        processes, tmp_path / 'recordings', model_file=str(model), use_sim_time=True,
        keep_state=False,
    )  # fmt: skip
    publishers = {
        s: listener.node.create_publisher(Float64, SIGNALS[s].topic, 1000) for s in STATE
    }
    clock = listener.node.create_publisher(Clock, '/clock', 1000)
    everybody = [*publishers.values(), clock]
    listener.until(lambda: all(p.get_subscription_count() for p in everybody), 'the monitor')

    def tick(k):
        clock.publish(Clock(clock=to_time(DEFAULT_START_NS + k * NS_PER_S)))

    def told(key):
        return listener.value('input valve_opening', key)

    for k in range(EARLY + LATE):
        if k == EARLY:
            listener.until(lambda: told(WAITING) == str(EARLY), 'the wait')
        if k >= EARLY:
            tick(k - EARLY)
        for signal_, publisher in publishers.items():
            publisher.publish(Float64(data=STATE[signal_] + k / 100))
        time.sleep(0.02)
    tick(LATE)
    listener.until(lambda: told('Messages received') == str(EARLY + LATE), 'all values')
    before = 'Messages sent before the first /clock'
    listener.until(lambda: told(before) == str(EARLY), 'the early values')
    assert 'by model_file: backlash, gain_drift, clock.' in ended(processes, monitor)
    (folder,) = (tmp_path / 'recordings').glob('valveflow_*')
    log = open_log(folder)
    for signal_, first in STATE.items():
        mine = log.readings.signal == signal_
        value, time_ns = log.readings.value[mine], log.readings.time_ns[mine]
        assert value.tolist() == [first + k / 100 for k in range(EARLY + LATE)]
        assert (np.diff(time_ns) > 0).all()
        since = time_ns - DEFAULT_START_NS
        assert (since[:EARLY] > -60 * NS_PER_S).all()
        assert (since[:EARLY] < 0).all()
        assert since[EARLY:].tolist() == [k * NS_PER_S for k in range(LATE)]
    model.unlink()  # the recording has its own
    assert json.loads(log.attachments[parameter_files.ATTACHMENT]) == extended_json(**HELD)
    result = verifying.verify(folder)
    assert result.identical, result.difference
    assert result.rows >= LATE
    # Rows as measured would have another u from the first one on.
    monkeypatch.setattr(verifying, 'corrector_of_run', lambda *_: None)
    assert 'Prediction number 1 differs' in verifying.verify(folder).difference
    assert main(['info', str(folder)]) == 0
    assert '1970' not in capsys.readouterr().out
