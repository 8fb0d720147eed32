# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A covariate in the running node: from its topic into diagnosis, recording, state and health."""

import itertools
import time

import numpy as np
import pytest
from listener import ended, start_monitor
from rclpy.parameter import Parameter
from valveflow_msgs.msg import Diagnosis

import valveflow_ros as vf
from valveflow_ros.errors import ParameterError
from valveflow_ros.interface.logs import read_covariate
from valveflow_ros.logs import open_log
from valveflow_ros.records import SIGNALS
from valveflow_ros.ros.decoding import from_time
from valveflow_ros.ros.encoding import float64_bytes
from valveflow_ros.ros.node.monitor_node import MonitorNode
from valveflow_ros.ros.player import Player, Step
from valveflow_ros.ros.replay_main import steps_of
from valveflow_ros.ros.verify import verify

pytestmark = pytest.mark.ros
TOPIC, COLUMN = '/condenser/pressure', 'condenser_pressure_kpa'
REQUIRED = [info for info in SIGNALS if info.required]
ROWS = 1800
MINUTES = {
    'covariates': f'vacuum={TOPIC}:kPa ambient=/weather/temperature', 'sample_period': 60.0,
    'hold_limit': 150.0, 'lateness': 60.0, 'block': 60.0, 'alarm_block': 120.0,
    'refit_period': 86400.0, 'diagnosis_hour': -1, 'diagnosis_on_mismatch': False,
    'reference_after': 0.0, 'use_sim_time': True, 'state_period': 1.0,
    'diagnostics_period': 0.2, 'unit_tag': 'unit 1',
}  # fmt: skip


def times_of(frame):
    return frame['time'].dt.tz_convert(None).to_numpy('datetime64[ns]').astype(np.int64).tolist()


def steps(frame):
    for k, time_ns in enumerate(times_of(frame)):
        value = np.nan if k % 10 == 0 else frame[COLUMN].iloc[k]
        row = [(info.topic, float64_bytes(frame[info.column].iloc[k])) for info in REQUIRED]
        yield Step(time_ns, [(TOPIC, float64_bytes(value)), *row])


@pytest.mark.slow
def test_a_topic_is_named_recorded_replayed_and_kept_by_the_state(processes, listener, tmp_path):
    plant = vf.simulate(days=1.25, seed=3, unit='choked:number=3', recording='minute')
    frame = plant.to_dataframe()
    monitor = start_monitor(processes, tmp_path / 'recordings', **MINUTES)
    names = [TOPIC, *(info.topic for info in REQUIRED)]
    player = Player(listener.node, names, 0.0, True, lambda: False)
    played = steps(frame)

    def taken():
        return int(listener.value('fit', 'Samples taken in all runs') or 0)

    assert player.wait_for_listeners(240.0) == []
    player.play(itertools.islice(played, ROWS // 2))
    listener.until(lambda: taken() > ROWS // 2 - 5, 'half of it')
    # Health is published five times a second: a state as young as that has all of these samples.
    begun_s, age = time.monotonic(), 'Seconds since it was saved'
    listener.until(
        lambda: time.monotonic() > begun_s + 2.0
        and float(listener.value('state', age) or 9) < 1.5,
        'a saved state',
    )  # fmt: skip
    monitor.kill()
    monitor.wait()
    monitor = start_monitor(processes, tmp_path / 'recordings', **MINUTES)
    listener.until(
        lambda: 'The saved state was loaded' in processes.output(monitor), 'the restart'
    )
    listener.health.clear()
    assert player.wait_for_listeners(240.0) == []
    player.play(played)
    listener.until(lambda: taken() > ROWS - 50, 'all of it')
    assert listener.trigger('diagnose')[0]
    heard = listener.latched(Diagnosis, 'diagnosis')
    listener.until(lambda: heard and heard[-1].causes, 'the diagnosis')
    found = heard[-1]
    assert repr(listener.late(Diagnosis, 'diagnosis')) == repr(found)
    assert (found.verdict, found.header.frame_id) == (Diagnosis.NAMED, 'unit 1')
    assert found.model_id == listener.curves[-1].model_id
    assert from_time(found.header.stamp) > times_of(frame)[-50]
    assert found.rmse_extended < found.rmse_simulation
    (cause,) = found.causes
    assert (cause.name, bool(cause.meaning)) == ('vacuum', True)
    truth = plant.data.unit.vacuum_per_kpa * frame['generated_power_mw'].mean()
    b = cause.parameter_values[list(cause.parameter_names).index('b')]
    assert b == pytest.approx(truth, rel=0.1)
    assert f'for every kPa that {TOPIC} (vacuum) is higher' in cause.sentence

    ambient = listener.status('input covariate ambient')
    told = '/weather/temperature is not sent; it is optional.'
    assert (ambient.level, ambient.message) == (b'\x00', told)

    def silent():
        status = listener.status('input covariate vacuum')
        told = status.message.startswith(f'{TOPIC} has been silent for')
        return told and status.message.endswith(' s; it is optional.') and status.level == b'\x00'

    listener.until(silent, 'the silence')
    ended(processes, monitor)

    (folder,) = (tmp_path / 'recordings').glob('valveflow_*')
    result = verify(folder)
    assert result.difference == ''
    assert result.compared['diagnosis'] >= 2
    assert result.rows == result.compared['prediction'] > ROWS - 50
    series = read_covariate(vf.open_log(folder), 'vacuum', TOPIC)
    sent = frame[COLUMN].to_numpy()
    np.testing.assert_array_equal(series.values, sent[np.arange(len(sent)) % 10 > 0])
    inputs, again = steps_of(open_log(folder))
    assert inputs[0] == TOPIC
    assert [name for name, _ in next(again).messages] == names


def test_a_bad_entry_is_refused_in_the_words_of_the_option(context):
    node = MonitorNode(context=context)
    for text, sentence in (
        ('vacuum', "entry 'vacuum' is not of the form NAME=TOPIC[:UNIT]."),
        ('a-b=/x', "entry 'a-b': a name has letters, digits and underscores, at most 40."),
        ('backlash=/x', "entry 'backlash' is a cause of the catalogue already; choose another"),
        ('a=/x//y', "entry '/x//y' is no name of a topic."),
        ('a=/x b=/x', "entry '/x' is the topic of another input."),
        ('a=/u2/generated_power', "entry '/u2/generated_power' is the topic of another input."),
    ):
        wanted = Parameter('covariates', value=text)
        with pytest.raises(ParameterError) as refused:
            MonitorNode(context=context, parameter_overrides=[wanted])
        assert f"Parameter 'covariates' cannot be used: {sentence}" in str(refused.value)
        (answer,) = node.set_parameters([wanted])
        assert (answer.successful, answer.reason) == (False, str(refused.value))
    node.destroy_node()
