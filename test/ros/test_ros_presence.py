"""A process is known in the domain before it begins to work, and can be stopped until then."""

from __future__ import annotations

import importlib
import json
import os
import signal
import subprocess
import sys
import time
from typing import Any

import pytest

pytest.importorskip('rclpy')
import rclpy
from rclpy.context import Context
from rclpy.node import Node
from ros_helpers import wait_until

from valveflow_ros.ros import monitor_main
from valveflow_ros.ros.presence import Presence
from valveflow_ros.ros.stops import StopFlag, Stopped

pytestmark = pytest.mark.ros
# Shows itself until somebody is known, makes a node, and tells what is left of the start.
JOIN = """
import json, os, sys
import rclpy
from valveflow_ros.ros.presence import Presence
from valveflow_ros.ros.transport import choose_transport
choose_transport()
held = lambda: [len(os.listdir(f'/proc/self/{what}')) for what in ('task', 'fd')]
with Presence([], tries=int(sys.argv[1])) as presence:
    known = presence.settle()
    node = rclpy.create_node('joined')
after = held()
names = node.get_node_names()
node.destroy_node()
rclpy.shutdown()
rclpy.init(args=[])
node = rclpy.create_node('joined')
print(json.dumps([known, presence.tries, sorted(names), after, held()]))
node.destroy_node()
rclpy.shutdown()
"""


def joined(tries: int) -> Any:
    done = subprocess.run(
        [sys.executable, '-c', JOIN, str(tries)], capture_output=True, text=True, timeout=240,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_a_neighbour_is_known_before_the_work_begins_and_nothing_is_left(context: Context) -> None:
    neighbour = Node('neighbour', context=context)
    try:
        # With two of five answers lost, thirty in a row are not: 1e-12.
        for _ in range(3):
            known, _, names, after, plain = joined(30)
            assert known
            assert names == ['joined', 'neighbour']
            # As many threads and descriptors as a process that has never looked for anybody.
            assert after == plain
    finally:
        neighbour.destroy_node()


@pytest.mark.usefixtures('ros_environment')
@pytest.mark.parametrize('tries', [1, 3])
def test_who_is_alone_asks_so_often_and_goes_on(tries: int) -> None:
    known, asked, names, after, plain = joined(tries)
    assert (known, asked, names) == (False, tries, ['joined'])
    assert after == plain


@pytest.mark.usefixtures('ros_environment', 'here')
def test_another_middleware_is_asked_once(monkeypatch: pytest.MonkeyPatch) -> None:
    module = 'valveflow_ros.ros.presence'
    monkeypatch.setattr(
        f'{module}.get_rmw_implementation_identifier', lambda: 'rmw_cyclonedds_cpp'
    )
    with Presence([]) as presence:
        assert not presence.settle()
    assert presence.tries == 1
    rclpy.shutdown()


@pytest.mark.usefixtures('ros_environment', 'here')
@pytest.mark.parametrize('failing', [1, 2])
def test_what_rclpy_refuses_is_told_and_ros_is_down_again(
    monkeypatch: pytest.MonkeyPatch, failing: int
) -> None:
    plain, made = rclpy.create_node, []

    def create(*args: Any, **more: Any) -> Node:
        made.append(1)
        if len(made) == failing:
            raise RuntimeError('no more nodes')
        return plain(*args, **more)

    monkeypatch.setattr(rclpy, 'create_node', create)
    with pytest.raises(RuntimeError, match='no more nodes'), Presence([], tries=3) as presence:
        presence.settle()
    assert len(made) == failing
    assert not rclpy.ok()


@pytest.mark.usefixtures('ros_environment', 'here')
def test_a_signal_while_the_monitor_loads_ends_it_at_once(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    reached = []

    def load(name: str) -> Any:
        os.kill(os.getpid(), signal.SIGTERM)
        reached.append(name)
        time.sleep(60.0)

    monkeypatch.setattr(importlib, 'import_module', load)
    begun_s = time.monotonic()
    assert monitor_main.main([]) == 0
    assert time.monotonic() - begun_s < 30.0
    assert not reached
    assert capfd.readouterr().err == ''
    assert not rclpy.ok()


@pytest.mark.usefixtures('here')
def test_signals_cut_only_where_they_may() -> None:
    stop = StopFlag().install()
    stop.cut(True)
    stop.cut(False)
    os.kill(os.getpid(), signal.SIGINT)
    wait_until(lambda: bool(stop), 'the signal', 20.0)
    # One that came before counts too.
    with pytest.raises(Stopped):
        stop.cut(True)
