# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A monitor that is killed goes on where it was: same curve, same alarms, one recording."""

import pytest
from listener import LATCHED, MONITOR, Listener, ended, start_monitor
from valveflow_msgs.msg import Alarm
from valveflow_msgs.srv import OperateAlarm

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs import open_log
from valveflow_ros.plant.simulator import simulate
from valveflow_ros.ros.decoding import PLANT_SAMPLE
from valveflow_ros.ros.player import Player
from valveflow_ros.ros.simulator_main import effects_of, stamped_steps
from valveflow_ros.ros.verify import verify

pytestmark = [pytest.mark.ros, pytest.mark.slow]
LOG = simulate(0.11, 7, effects=effects_of(['gain_step:g=-0.12,t0_days=0.085'])).table
# Rows at the fault, when its alarm has been raised for a while, and at the end.
FAULT, RAISED, PLAYED = 7344, 9104, 9204
TAKEN, UNDER_WAY = 'Samples taken in all runs', 'Refit under way for (s)'


class Plant(Listener):
    """Publishes rows of a log and hears what the monitor says."""

    def __init__(self, context):
        super().__init__(context, 'plant')
        self._player = Player(self.node, [PLANT_SAMPLE], 0.0, False, lambda: False)

    def listeners(self):
        """Return who takes our samples; one that was killed stays among them for a while."""
        found = self.node.get_subscriptions_info_by_topic(PLANT_SAMPLE)
        return {bytes(each.endpoint_gid) for each in found}

    def play(self, start, end):
        assert not self._player.wait_for_listeners(240.0)
        self._player.play(stamped_steps([LOG.part(start, end)], False, 'unit'))

    def play_to_the_alarm(self):
        """Give the monitor time for a curve, and then a fault."""
        self.play(0, FAULT)
        self.until(lambda: self.curves and self.curves[-1].model_id, 'the curve')
        self.play(FAULT, RAISED)
        raised = Alarm.UNACKNOWLEDGED
        self.until(lambda: self.alarms and self.alarms[-1].state == raised, 'the alarm')
        # What is still being computed or on its way is heard too.
        self.health.clear()
        self.until(lambda: self.value('fit', TAKEN) == str(RAISED), 'all samples', 60.0)
        self.until(lambda: self.value('fit', UNDER_WAY) == 'unknown', 'the last fit')
        self.quiet(0.5)

    def play_to(self, end, known):
        """Go on once a monitor listens that is not among the known ones, and knows of us."""
        self.until(lambda: self.listeners() - known, 'the new listener')
        self.health.clear()
        publishers = 'input valve_opening', 'Publishers'
        self.until(lambda: self.value(*publishers) not in ('', '0'), 'the monitor knowing us')
        self.play(RAISED, end)
        self.until(lambda: self.value('fit', TAKEN) == str(end), 'the last sample', 60.0)

    def operate(self, name, action):
        request = OperateAlarm.Request(name=name, action=action)
        answer = self.call(OperateAlarm, 'operate_alarm', request)
        return answer.success, answer.message

    def standing(self):
        """Come late; return the alarms that have occurred."""
        late = []
        self.node.create_subscription(Alarm, f'{MONITOR}/alarms', late.append, LATCHED)
        return self.until(lambda: [a for a in late if a.occurrence], 'the standing alarm')


@pytest.fixture
def plant(context):
    made = Plant(context)
    yield made
    made.close()


def killed(monitor):
    monitor.kill()
    monitor.wait()


def test_killed_and_started_again_it_goes_on_with_curve_alarm_and_recording(
    processes, plant, tmp_path
):
    # Nothing is written in its time: what is on disk is there because it was confirmed.
    given = {'record_flush': 60.0, 'alarm_suppress_time': 86400.0}
    first = start_monitor(processes, tmp_path, **given)
    plant.until(lambda: plant.curves, 'the first monitor')
    second = start_monitor(processes, tmp_path, **given)
    assert second.wait(120.0) == 1
    refused = processes.output(second)
    assert f'another monitor (process {first.pid}) keeps its state there' in refused
    assert 'Traceback' not in refused
    assert first.poll() is None

    plant.play_to_the_alarm()
    # After this the state has just been saved, and is not due for a second. What a service
    # confirmed survives a kill that follows at once.
    success, sentence = plant.operate('residual', 'shelve')
    killed(first)
    assert success
    assert sentence.startswith('The alarm residual is shelved for 8 h; then it comes back')
    plant.quiet(0.5)
    shelved, curve, known = plant.alarms[-1], plant.curves[-1], plant.listeners()
    assert (shelved.state, shelved.previous_state) == (Alarm.SHELVED, Alarm.UNACKNOWLEDGED)

    before = len(plant.alarms)
    plant.curves.clear()
    # Another parameter of the alarms changes nothing of that.
    third = start_monitor(processes, tmp_path, **given, alarm_floor=2.0)
    found = plant.until(lambda: plant.curves and plant.curves[-1], 'the curve')
    assert found.model_id == curve.model_id
    plant.until(lambda: 'The saved state was loaded' in processes.output(third), 'the sentence')
    # Who listens from now on finds what stands, as it was told before: nothing in it is new.
    plant.until(lambda: len(plant.alarms) > before, 'the standing alarm')
    plant.quiet(0.5)
    assert [a for a in plant.alarms[before:] if a.occurrence] == [shelved]
    assert plant.standing() == [shelved]
    told = f'from before, alarm residual, shelved: {shelved.sentence}'
    assert told in processes.output(third)
    assert plant.operate('residual', 'unshelve')[0]
    assert plant.trigger('acknowledge_alarms')[0]
    plant.until(lambda: plant.alarms[-1].state == Alarm.ACKNOWLEDGED, 'the acknowledgement')
    assert plant.alarms[-1].occurrence == shelved.occurrence
    plant.play_to(PLAYED, known)
    ended(processes, third, 10.0)

    (folder,) = tmp_path.glob('valveflow_*')
    assert not list(folder.glob('*.part'))
    log = open_log(folder)
    assert log.warnings == ()
    assert log.topics['/plant_sample'].count == PLAYED
    result = verify(folder)
    assert (result.difference, result.rows) == ('', PLAYED)
    assert result.compared['alarms'] >= 4
    with pytest.raises(RecordingError, match='goes on from an earlier recording'):
        verify(max(folder.glob('*.mcap')))

    with_other_parameters_it_goes_on_from_what_was_confirmed(processes, plant, tmp_path)
    assert list(tmp_path.glob('valveflow_*')) == [folder]


def with_other_parameters_it_goes_on_from_what_was_confirmed(processes, plant, folder):
    """Those of the alarms and of the segments may be other ones, and nothing is recorded."""
    given = {
        'record': False, 'state_directory': str(folder / 'state_unit'), 'steady_min': 150.0,
        'alarm_floor': 2.0, 'alarm_suppress_time': 86400.0,
    }  # fmt: skip
    monitor = start_monitor(processes, folder, **given)
    before = 'from before, alarm residual, acknowledged'
    plant.until(lambda: before in processes.output(monitor), 'the alarm of before')
    changed = 'Since the state was saved steady_min changed. Segments were found again in '
    assert changed in processes.output(monitor)
    assert [(a.name, a.state) for a in plant.standing()] == [('residual', Alarm.ACKNOWLEDGED)]
    for name, action, words in (
        ('', 'shelve', "There is no alarm ''; choose residual or curve_shift."),
        ('residual', 'stop', "There is no action 'stop'; choose acknowledge, shelve or unshelve."),
        ('residual', 'unshelve', 'The alarm residual is not shelved.'),
        ('curve_shift', 'acknowledge',
         'There is nothing to acknowledge of the alarm curve_shift.'),
    ):  # fmt: skip
        assert plant.operate(name, action) == (False, words)
    ended(processes, monitor, 10.0)
