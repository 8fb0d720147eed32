"""A rehearsal leaves no outcome, and the task behind it is computed in the same process."""

from __future__ import annotations

import time

import pytest

pytest.importorskip('rclpy')
from ros_helpers import wait_until
from test_ros_worker import TASK, worker

from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.ros.worker.worker import FitWorker

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures('jobs_on_path')]


def test_a_task_behind_a_rehearsal_is_computed_by_the_same_process() -> None:
    with worker('good') as made:
        first = made.pid
        made.rehearse(TASK)
        assert made.rehearsing
        made.submit(TASK)
        (outcome,) = wait_until(made.poll, 'the outcome')
        assert not made.rehearsing
        assert isinstance(outcome.result, Characteristic)
        assert made.busy_s is None
        # Whether its answer came before or after, it is nobody's.
        time.sleep(0.3)
        assert made.poll() == []
        assert (made.pid, made.starts, made.failures_in_a_row) == (first, 1, 0)


def test_death_in_a_rehearsal_is_no_outcome_and_the_process_is_replaced() -> None:
    with worker('dies') as made:
        made.rehearse(TASK)
        until_s = time.monotonic() + 60.0
        while made.starts < 2 and time.monotonic() < until_s:
            assert made.poll() == []
            time.sleep(0.02)
        assert made.starts == 2
        # Who waits for its end is not kept waiting.
        assert not made.rehearsing
        assert made.failures_in_a_row == 1


def test_the_wait_for_a_rehearsal_is_not_counted_as_the_tasks() -> None:
    now = [0.0]
    made = FitWorker(120.0, 'hurt_jobs:good', clock=lambda: now[0])
    made.start()
    try:
        made.rehearse(TASK)
        # So that its sender has the pipe.
        time.sleep(0.2)
        made.submit(TASK)
        now[0] = 50.0
        (outcome,) = wait_until(made.poll, 'the outcome')
    finally:
        made.close()
    assert outcome.seconds == 0.0


def test_what_waits_behind_a_rehearsal_is_not_ended_for_taking_long() -> None:
    """It may compile for minutes, once; but not for ever."""
    now = [0.0]
    made = FitWorker(120.0, 'hurt_jobs:hangs', clock=lambda: now[0])
    made.start()
    try:
        made.rehearse(TASK)
        made.submit(TASK)
        now[0] = 500.0
        assert made.poll() == []
        assert (made.rehearsing, made.starts) == (True, 1)
        now[0] = 700.0
        (outcome,) = made.poll()
        assert outcome.result == 'The fit process could not be made ready and was ended.'
        assert not made.rehearsing
    finally:
        made.close()
