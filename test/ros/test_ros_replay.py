# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
import itertools
import json
import math

import numpy as np
import pytest
from rclpy.node import Node
from ros_helpers import wait_until
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64
from valveflow_msgs.msg import Alarm, PlantSample, Prediction

from valveflow_ros.errors import ParameterError, RecordingError
from valveflow_ros.logs import RecordingWriter, open_log, write_samples, write_table
from valveflow_ros.parameters import Settings
from valveflow_ros.plant.simulator import simulate
from valveflow_ros.records import NS_PER_S, SIGNALS, SampleTable, Signal
from valveflow_ros.ros.decoding import INPUT_BY_NAME, header_time_ns
from valveflow_ros.ros.encoding import encode, float64_bytes
from valveflow_ros.ros.node.intake import ClockTrack
from valveflow_ros.ros.node.polled_subscription import PolledSubscription
from valveflow_ros.ros.replay_main import main, steps_of
from valveflow_ros.ros.simulator_main import (
    check_together,
    effects_of,
    plain_steps,
    stamped_steps,
    start_ns_of,
)
from valveflow_ros.ros.verify import verify

REPLAY = 'valveflow_ros.ros.replay_main'
TABLE = simulate(0.01, 3).table.part(0, 300)


class Ears:
    def __init__(self, context, names):
        self.node = Node('ears', context=context, namespace='plant')
        kinds = {name: INPUT_BY_NAME[name].message_type for name in names}
        self._subscriptions = {
            name: PolledSubscription(self.node, kind, name, reliable=True)
            for name, kind in [*kinds.items(), ('/clock', Clock)]
        }
        self.heard = {name: [] for name in self._subscriptions}

    def take(self):
        for name, subscription in self._subscriptions.items():
            self.heard[name] += subscription.take()

    def until(self, process):
        """Listen until a process has ended and nothing more comes."""
        quiet = 0

        def over():
            nonlocal quiet
            before = sum(map(len, self.heard.values()))
            self.take()
            still = before == sum(map(len, self.heard.values()))
            quiet = quiet + 1 if still and process.poll() is not None else 0
            return quiet > 20

        wait_until(over, 'the end of the replay')

    def close(self):
        self.node.destroy_node()


@pytest.mark.ros
def test_a_log_is_heard_again_as_it_stands_with_its_times_on_the_clock(
    context, processes, tmp_path
):
    path = tmp_path / 'log.csv'
    write_table(TABLE, path)
    names = [info.topic for info in SIGNALS]
    ears = Ears(context, names)
    # A thousand times real time: 300 s of plant in less than a second.
    process = processes.start(
        REPLAY, str(path), '--rate', '1000', '--ros-args', '-r', '__ns:=/plant'
    )
    ears.until(process)
    assert process.returncode == 0, processes.output(process)
    clock = ClockTrack()
    for taken in ears.heard['/clock']:
        clock.note(taken.source_ns, header_time_ns(taken.data))
    for info in SIGNALS:
        heard = ears.heard[info.topic]
        assert [t.data for t in heard] == [
            float64_bytes(value) for value in TABLE.column(info.signal).tolist()
        ]
        # The time that who listens gives to each value is the recorded one.
        assert [clock.at(t.source_ns) for t in heard] == TABLE.time_ns.tolist()
    ears.close()


def test_a_recording_and_a_table_of_the_same_samples_give_the_same_steps(tmp_path):
    write_samples(TABLE, tmp_path / 'log.mcap')
    write_table(TABLE, tmp_path / 'log.csv')
    names, steps = steps_of(open_log(tmp_path / 'log.mcap'))
    names_of_table, steps_of_table = steps_of(open_log(tmp_path / 'log.csv'))
    assert set(names) == set(names_of_table) == {info.topic for info in SIGNALS}
    sorted_steps = [(step.time_ns, sorted(step.messages)) for step in steps]
    assert sorted_steps == [(step.time_ns, sorted(step.messages)) for step in steps_of_table]
    assert [time_ns for time_ns, _ in sorted_steps] == TABLE.time_ns.tolist()


def test_a_table_that_needs_options_is_to_be_imported_first(tmp_path, capsys):
    path = tmp_path / 'log.csv'
    write_table(TABLE, path)
    path.write_text(path.read_text().replace('valve_opening_percent', 'FV101', 1))
    assert main([str(path)]) == 1
    said = capsys.readouterr().err
    assert 'Name yours with --column valve_opening=THEIRS[:unit]' in said
    assert f'make a log of the table first, with valveflow import {path} -o' in said


def with_a_hole(table):
    power = table.column(Signal.GENERATED_POWER).copy()
    power[10] = math.nan
    columns = {info.signal: table.column(info.signal) for info in SIGNALS}
    return SampleTable.from_columns(table.time_ns, columns | {Signal.GENERATED_POWER: power})


@pytest.mark.parametrize('command', [False, True])
def test_the_plant_says_the_same_plainly_and_stamped(command):
    from rclpy.serialization import deserialize_message

    table = with_a_hole(TABLE)
    plain = list(plain_steps([table.part(0, 200), table.part(200, 300)], command))
    stamped = list(stamped_steps([table], command, 'tag'))
    assert [s.time_ns for s in plain] == [s.time_ns for s in stamped] == table.time_ns.tolist()
    for one, other in zip(plain, stamped, strict=True):
        values = {name: deserialize_message(data, Float64).data for name, data in one.messages}
        ((name, data),) = other.messages
        assert name == 'plant_sample'
        sample = deserialize_message(data, PlantSample)
        assert header_time_ns(data) == one.time_ns
        assert sample.header.frame_id == 'tag'
        assert ('valve_command' in values) == command
        for info in SIGNALS:
            value = getattr(sample, info.topic)
            np.testing.assert_equal(value, values.get(info.topic, math.nan))
            good = getattr(sample, f'{info.topic}_quality') == PlantSample.QUALITY_GOOD
            assert good == math.isfinite(value)


def test_effects_come_one_by_one_or_together():
    texts = ['gain_step:g=0.01,t0_days=1', 'backlash']
    apart = effects_of(texts)
    assert [e.name for e in apart] == ['gain_step', 'backlash']
    assert effects_of(['; '.join(texts)]) == apart
    assert effects_of(['', ' ; ']) == []


def test_the_first_samples_time():
    now_ns = 1_800_000_000 * NS_PER_S + 7
    for text, rate, expected in (
        ('2026-03-01T12:00:00Z', 1.0, 1_772_366_400),
        ('2026-03-01T12:00:00', 60.0, 1_772_366_400),
        ('2026-03-01T13:00:00+01:00', 0.0, 1_772_366_400),
        ('', 60.0, 1_700_006_400),
        ('', 1.0, 1_800_000_000),
    ):
        assert start_ns_of(text, rate, now_ns) == expected * NS_PER_S


def test_plain_values_need_a_clock_unless_in_real_time():
    refused = []
    for given in itertools.product((0.0, 1.0, 60.0), (False, True), (False, True)):
        try:
            check_together(*given)
        except ParameterError:
            refused.append(given)
    assert refused == [(0.0, False, False), (60.0, False, False)]


@pytest.mark.parametrize('occurrence', [None, 1, 0])
def test_a_recording_whose_beginning_is_of_an_earlier_version_is_not_compared(
    tmp_path, occurrence
):
    """It told no alarm as normal at its beginning; byte for byte it can be nothing of today's."""
    names = {'prediction': '/m/prediction', 'alarms': '/m/alarms'}
    attachments = {
        'parameters.json': json.dumps(dict(Settings())).encode(),
        'topics.json': json.dumps({'inputs': {}, 'outputs': names}).encode(),
    }
    with RecordingWriter(tmp_path / 'log', attachments=attachments) as writer:
        writer.add_topic('/m/prediction', 'valveflow_msgs/msg/Prediction')
        writer.add_topic('/m/alarms', 'valveflow_msgs/msg/Alarm')
        writer.write('/m/prediction', encode(Prediction()), 10**18, 10**18)
        if occurrence is not None:
            alarm = encode(Alarm(occurrence=occurrence))
            writer.write('/m/alarms', alarm, 10**18 + 1, 10**18 + 1)
    if occurrence == 0:
        assert verify(tmp_path / 'log').difference  # compared, and found to be something else
        return
    with pytest.raises(RecordingError, match=r'earlier version, .* replayed, not verified'):
        verify(tmp_path / 'log')
