# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A monitor that is killed goes on where it was: same curve, same alarms, one recording."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from listener import LATCHED, MONITOR, Listener, start_monitor
from ros_helpers import Processes
from valveflow_msgs.msg import Alarm
from valveflow_msgs.srv import OperateAlarm

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs import open_log
from valveflow_ros.monitoring.events import JournalKind
from valveflow_ros.plant.simulator import simulate
from valveflow_ros.ros.decoding import PLANT_SAMPLE, journal_entry
from valveflow_ros.ros.player import Player
from valveflow_ros.ros.simulator_main import effects_of, stamped_steps
from valveflow_ros.ros.verify import verify

pytestmark = [pytest.mark.ros, pytest.mark.slow]
LOG = simulate(0.15, 7, effects=effects_of(['gain_step:g=-0.12,t0_days=0.1'])).table
# Rows at the fault, and when its alarm has been raised for a while.
FAULT, RAISED = 8640, 10_400


class Plant(Listener):
    """Publishes rows of a log and hears what the monitor says."""

    def __init__(self, context: Any) -> None:
        super().__init__(context, 'plant')
        self._player = Player(self.node, [PLANT_SAMPLE], 0.0, False, lambda: False)

    def listeners(self) -> set[bytes]:
        """Return who takes our samples; one that was killed stays among them for a while."""
        found = self.node.get_subscriptions_info_by_topic(PLANT_SAMPLE)
        return {bytes(each.endpoint_gid) for each in found}

    def known(self) -> bool:
        """Tell whether the monitor knows of us, by its newest health."""
        return any(
            v.value != '0' for h in self.health for s in h.status for v in s.values
            if v.key == 'Publishers'
        )  # fmt: skip

    def play(self, start: int, end: int) -> None:
        assert not self._player.wait_for_listeners(240.0)
        self._player.play(stamped_steps([LOG.part(start, end)], False, 'unit'))

    def play_to_the_alarm(self) -> None:
        """Give the monitor time for a curve, and then a fault."""
        self.play(0, FAULT)
        self.until(lambda: self.curves and self.curves[-1].model_id, 'the curve')
        self.play(FAULT, RAISED)
        self.until(
            lambda: self.alarms and self.alarms[-1].state == Alarm.UNACKNOWLEDGED, 'the alarm'
        )

    def quiet(self, seconds: float) -> None:
        """Listen for a while."""
        until_s = time.monotonic() + seconds
        self.until(lambda: time.monotonic() > until_s, 'the end of a while')


@pytest.fixture
def plant(context: Any) -> Iterator[Plant]:
    made = Plant(context)
    yield made
    made.close()


def goes_on(processes: Processes, monitor: Any) -> bool:
    """Tell whether it says so; its line in the journal may come before anybody listens."""
    return 'Going on after' in processes.output(monitor)


def test_killed_and_started_again_it_goes_on_with_curve_alarm_and_recording(
    processes: Processes, plant: Plant, tmp_path: Path
) -> None:
    first = start_monitor(processes, tmp_path)
    plant.play_to_the_alarm()
    # What is still being computed or on its way is heard too.
    plant.quiet(4.0)
    raised, curve = plant.alarms[-1], plant.curves[-1]
    first.kill()
    first.wait()
    before = len(plant.alarms)

    plant.curves.clear()
    # Another parameter of the alarms changes nothing of that.
    second = start_monitor(processes, tmp_path, alarm_floor=2.0)
    begun = time.monotonic()
    found = plant.until(lambda: plant.curves and plant.curves[-1], 'the curve')
    print(f'curve again after {time.monotonic() - begun:.1f} s')
    assert found.model_id == curve.model_id
    plant.until(lambda: goes_on(processes, second), 'the sentence', 240.0)
    # Who listens from now on finds what stands, as it was told before: nothing in it is new.
    plant.until(lambda: len(plant.alarms) > before, 'the standing alarm')
    plant.quiet(0.5)
    assert [a for a in plant.alarms[before:] if a.occurrence] == [raised]
    told = processes.output(second)
    assert f'from before, alarm residual, unacknowledged: {raised.sentence}' in told
    late: list[Alarm] = []
    plant.node.create_subscription(Alarm, f'{MONITOR}/alarms', late.append, LATCHED)
    plant.until(lambda: [a for a in late if a.occurrence], 'the standing alarm for who comes late')
    assert [a for a in late if a.occurrence] == [raised]
    answer = plant.trigger('acknowledge_alarms')
    assert answer.success, answer.message
    plant.until(lambda: plant.alarms[-1].state == Alarm.ACKNOWLEDGED, 'the acknowledgement')
    assert plant.alarms[-1].occurrence == raised.occurrence
    plant.play(RAISED, len(LOG))
    time.sleep(1.0)
    second.send_signal(signal.SIGTERM)
    assert second.wait(10.0) == 0, processes.output(second)
    assert 'Traceback' not in processes.output(second)

    (folder,) = tmp_path.glob('valveflow_*')
    assert not list(folder.glob('*.part'))
    log = open_log(folder)
    assert log.warnings == ()
    assert log.topics['/plant_sample'].count >= len(LOG) - 600
    result = verify(folder)
    assert result.difference == '', result.difference
    assert result.compared['alarms'] >= 2


@pytest.mark.parametrize('kept_by', ['recording', 'state'])
def test_what_a_service_confirmed_survives_a_kill_that_follows_at_once(
    processes: Processes, plant: Plant, tmp_path: Path, kept_by: str
) -> None:
    # Nothing is written in its time: what is on disk is there because it was confirmed.
    given: dict[str, object] = {'record_flush': 60.0, 'alarm_suppress_time': 86400.0}
    if kept_by == 'state':
        given |= {'record': False, 'state_directory': str(tmp_path / 'state')}
    first = start_monitor(processes, tmp_path, **given)
    plant.play_to_the_alarm()
    plant.quiet(3.0)

    def operate(name: str, action: str) -> OperateAlarm.Response:
        request = OperateAlarm.Request(name=name, action=action)
        return plant.call(OperateAlarm, 'operate_alarm', request)

    for name, action, words in (
        ('nothing', 'shelve', "There is no alarm 'nothing'; choose residual or curve_shift."),
        ('', 'shelve', "There is no alarm ''; choose residual or curve_shift."),
        ('residual', 'stop', "There is no action 'stop'; choose acknowledge, shelve or unshelve."),
        ('residual', 'unshelve', 'The alarm residual is not shelved.'),
        (
            'curve_shift',
            'acknowledge',
            'There is nothing to acknowledge of the alarm curve_shift.',
        ),
    ):
        answer = operate(name, action)
        assert (answer.success, answer.message) == (False, words)
    # After these the state has just been saved, and is not due for a second.
    assert operate('residual', 'shelve').success
    assert operate('residual', 'unshelve').success
    begun_s = time.monotonic()
    answer = operate('residual', 'acknowledge')
    os.kill(first.pid, signal.SIGKILL)
    print(f'confirmed after {time.monotonic() - begun_s:.3f} s')
    assert (answer.success, answer.message) == (True, 'The alarm residual is acknowledged.')
    first.wait()
    known = plant.listeners()

    # The parameters of the alarms and those of the segments may be other ones.
    second = start_monitor(processes, tmp_path, **given, alarm_floor=2.0, steady_min=150.0)
    plant.until(lambda: goes_on(processes, second), 'the sentence', 240.0)
    before = 'from before, alarm residual, acknowledged'
    plant.until(lambda: before in processes.output(second), 'the alarm of before')
    told = processes.output(second)
    assert 'Since the state was saved steady_min changed. Segments were found again in ' in told
    late: list[Alarm] = []
    plant.node.create_subscription(Alarm, f'{MONITOR}/alarms', late.append, LATCHED)
    plant.until(lambda: [a for a in late if a.occurrence], 'the standing alarm')
    assert ('residual', Alarm.ACKNOWLEDGED) in [(a.name, a.state) for a in late]
    assert not [a for a in late if a.state not in (Alarm.ACKNOWLEDGED, Alarm.NORMAL)]
    answer = operate('residual', 'shelve')
    assert answer.success
    assert answer.message.startswith('The alarm residual is shelved for 8 h; then it comes back')
    plant.until(lambda: plant.listeners() - known, 'the new listener')
    plant.play(RAISED, RAISED + 100)
    plant.quiet(1.0)
    second.send_signal(signal.SIGTERM)
    assert second.wait(10.0) == 0, processes.output(second)
    folders = sorted(tmp_path.glob('valveflow_*'))
    if kept_by == 'state':
        assert folders == []
        return
    # Other parameters make another recording; the one before holds all that was confirmed.
    assert len(folders) == 2
    result = verify(folders[0])
    assert result.difference == '', result.difference
    entries = [
        journal_entry(m.data) for m in open_log(folders[0]).iter_messages([f'{MONITOR}/journal'])
    ]
    (entry,) = [e for e in entries if e.kind == JournalKind.ACKNOWLEDGE]
    assert entry.text == 'residual'


def test_a_second_monitor_on_the_same_state_is_refused_and_the_first_goes_on(
    processes: Processes, plant: Plant, tmp_path: Path
) -> None:
    first = start_monitor(processes, tmp_path)
    plant.until(lambda: plant.curves, 'the first monitor', 240.0)
    second = start_monitor(processes, tmp_path)
    assert second.wait(120.0) == 1
    said = processes.output(second)
    assert f'another monitor (process {first.pid}) keeps its state there' in said
    assert 'Traceback' not in said
    assert first.poll() is None
    # However young it is, another one goes on from there.
    plant.play(0, 600)
    plant.quiet(2.5)
    known = plant.listeners()
    os.kill(first.pid, signal.SIGKILL)
    first.wait()
    third = start_monitor(processes, tmp_path)
    plant.until(lambda: goes_on(processes, third), 'the sentence', 240.0)
    # The one that is gone would count as a listener too; and the new one has to know of us.
    plant.until(lambda: plant.listeners() - known, 'the new listener')
    plant.health.clear()
    plant.until(plant.known, 'the monitor knowing the plant')
    plant.play(600, 700)
    plant.quiet(1.0)
    third.send_signal(signal.SIGTERM)
    assert third.wait(10.0) == 0, processes.output(third)
    (folder,) = tmp_path.glob('valveflow_*')
    result = verify(folder)
    assert (result.difference, result.rows) == ('', 700)
    last = max(folder.glob('*.mcap'))
    with pytest.raises(RecordingError, match='goes on from an earlier recording'):
        verify(last)
