# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A process is known in the domain before it begins to work, and can be stopped until then."""

import importlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip('rclpy')
import rclpy
from rclpy.node import Node
from ros_helpers import wait_until

from valveflow_ros.ros import monitor_main
from valveflow_ros.ros.domain import Presence, choose_transport
from valveflow_ros.ros.process import StopFlag, Stopped

pytestmark = pytest.mark.ros
# Shows itself, makes a node in the best of the contexts, and tells what is left of the start.
JOIN = """
import json, os, sys, time
import rclpy
from valveflow_ros.ros.domain import Presence
from valveflow_ros.ros.domain import choose_transport
choose_transport()
def held():
    return [len(os.listdir(f'/proc/self/{what}')) for what in ('task', 'fd')]
def waited(node, names):
    end_s = time.monotonic() + 20.0
    while not names <= set(node.get_node_names()) and time.monotonic() < end_s:
        time.sleep(0.02)
    return sorted(node.get_node_names())
presence = Presence(['--ros-args', '-r', '__node:=renamed'], count=5)
context = presence.settle()
node = rclpy.create_node('joined', context=context)
presence.end()
names = waited(node, {'renamed', *sys.argv[1:]})
after = held()
node.destroy_node()
presence.close()
print(json.dumps([names, rclpy.ok()]), flush=True)
rclpy.init(args=[])
node = rclpy.create_node('joined')
print(json.dumps([after, held()]))
node.destroy_node()
rclpy.shutdown()
"""


def joined(*neighbours):
    """Return the names it came to know, whether ROS was still up, and what it holds."""
    done = subprocess.run(
        [sys.executable, '-c', JOIN, *neighbours],
        capture_output=True, text=True, timeout=240, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    first, second = map(json.loads, done.stdout.splitlines()[-2:])
    return (*first, *second)


def test_neighbours_are_known_and_as_little_is_left_as_of_a_plain_start(context):
    neighbour = Node('neighbour', context=context)
    try:
        names, up, after, plain = joined('neighbour')
    finally:
        neighbour.destroy_node()
    # The one node of ours that is left is the real one, by the name it was given.
    assert {'neighbour', 'renamed'} <= set(names)
    assert not [name for name in names if name.startswith(('_valveflow', 'joined'))]
    assert not up
    # Contexts of ROS that were shut down leave nothing; the one in use may be another one.
    assert after[0] - plain[0] in (0, 1)
    assert after[1] - plain[1] <= 2


class Told:
    """A node that is said to have heard of some others."""

    def __init__(self, context, names):
        self.context, self.names, self.there = context, names, True

    def get_node_names(self):
        if 'broken' in self.names:
            raise RuntimeError('no graph')
        return self.names

    def destroy_node(self):
        self.there = False


class Graph:
    """Makes nodes that are said to have heard of others; None where one cannot be made."""

    def __init__(self):
        self.nodes = []
        self.heard = [[]] * 5

    def create(self, name, context, **more):
        heard = self.heard[len(self.nodes)]
        if heard is None:
            raise RuntimeError('no more nodes')
        self.nodes.append(Told(context, heard))
        return self.nodes[-1]


@pytest.fixture
def graph(monkeypatch, ros_environment):
    made = Graph()
    monkeypatch.setattr(rclpy, 'create_node', made.create)
    yield made
    assert not rclpy.ok()


@pytest.mark.parametrize(
    ('heard', 'best'),
    [
        ([['_own'], ['_own', 'a'], ['_own', 'a', 'b'], ['_own', 'b']], 2),
        # Who else only starts or looks on is no neighbour.
        ([['_own', '_valveflow_starting', '_daemon'], ['_own', 'a']], 1),
        ([['broken'], ['_own'], ['_own', 'a']], 2),
        # Alone the first will do, which has the log of the process.
        ([['_own'], ['_own'], ['_own']], 0),
        ([['broken'], ['broken']], 0),
    ],
)
def test_it_goes_on_as_the_one_that_heard_of_most(graph, heard, best):
    graph.heard = heard
    made = graph.nodes
    presence = Presence([], count=len(heard))
    chosen = presence.settle()
    assert chosen is made[best].context
    assert [node.there for node in made] == [k == best for k in range(len(heard))]
    # The first keeps the log of the process; the others are down.
    up = [node.context.ok() for node in made]
    assert up == [k in (0, best) for k in range(len(heard))]
    presence.end()
    assert not made[best].there
    presence.close()
    assert not any(node.context.ok() for node in made)


@pytest.mark.parametrize('failing', [1, 2])
def test_where_one_more_cannot_be_made_those_before_will_do(graph, failing):
    graph.heard[failing - 1] = None
    presence = Presence([], count=5)
    assert len(graph.nodes) == failing - 1
    assert presence.settle().ok()
    presence.close()


def test_it_shows_itself_only_where_that_helps_and_is_allowed(graph, monkeypatch):
    name = 'valveflow_ros.ros.domain.get_rmw_implementation_identifier'
    for middleware, environ, shown in (
        (FAST_DDS, {}, 5),
        ('rmw_cyclonedds_cpp', {}, 0),
        (FAST_DDS, {'ROS_SECURITY_ENABLE': 'true'}, 0),
        (FAST_DDS, {'ROS_SECURITY_ENABLE': 'false'}, 5),
    ):
        monkeypatch.setattr(name, lambda middleware=middleware: middleware)
        graph.nodes.clear()
        presence = Presence([], environ=environ)
        assert len(graph.nodes) == shown
        assert presence.settle().ok()
        presence.close()


@pytest.mark.usefixtures('ros_environment')
def test_a_signal_while_the_monitor_loads_ends_it_at_once(monkeypatch, capfd):
    reached = []

    def load(name):
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


def test_signals_cut_only_where_they_may_and_only_once():
    stop = StopFlag().install()

    def work():
        with stop.cutting():
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(60.0)

    with pytest.raises(Stopped):
        work()
    # What comes after it is for the flag alone.
    os.kill(os.getpid(), signal.SIGINT)
    wait_until(lambda: stop.name == 'SIGINT', 'the second signal', 20.0)
    # One that came before counts too, and leaves no door open.
    with pytest.raises(Stopped), stop.cutting():
        pytest.fail('begun after a signal')
    os.kill(os.getpid(), signal.SIGTERM)
    wait_until(lambda: stop.name == 'SIGTERM', 'the third signal', 20.0)
    stop = StopFlag().install()
    with pytest.raises(ImportError), stop.cutting():
        raise ImportError
    # An error closes the door, too.
    os.kill(os.getpid(), signal.SIGINT)
    wait_until(lambda: stop.name == 'SIGINT', 'the last signal', 20.0)


# Transport: sockets, so that a killed process leaves no shared memory that others go on using

FAST_DDS = 'rmw_fastrtps_cpp'
SOCKETS = 'UDPv4?sockets_size=4MB'
RANGE = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
TRANSPORTS = 'FASTDDS_BUILTIN_TRANSPORTS'
PROFILES = ('FASTDDS_DEFAULT_PROFILES_FILE', 'FASTRTPS_DEFAULT_PROFILES_FILE')
# Prints the files in /dev/shm that a node of Fast DDS maps into its process.
NODE = """
import rclpy
from valveflow_ros.ros.domain import choose_transport
choose_transport()
rclpy.init()
node = rclpy.create_node('transport_probe')
with open('/proc/self/maps') as maps:
    print(sum('/dev/shm/fastrtps' in line for line in maps))
node.destroy_node()
rclpy.shutdown()
"""


def chosen(**given):
    environ = dict(given)
    choose_transport(environ, FAST_DDS)
    return environ


def test_who_has_chosen_keeps_the_choice_and_the_reach_stays_as_it_was():
    for reach in ('', 'SUBNET', 'OFF', 'SYSTEM_DEFAULT'):
        assert chosen(**{RANGE: reach}) == {RANGE: reach, TRANSPORTS: SOCKETS}
    for reach in ('LOCALHOST', 'SUBNET'):
        for name in (TRANSPORTS, *PROFILES):
            given = {name: 'SHM', RANGE: reach}
            assert chosen(**given) == given
        # Discovery of another kind.
        for name in ('ROS_LOCALHOST_ONLY', 'ROS_STATIC_PEERS', 'ROS_DISCOVERY_SERVER'):
            given = {name: '1', RANGE: reach}
            more = {} if reach == 'LOCALHOST' else {TRANSPORTS: SOCKETS}
            assert chosen(**given) == given | more
        environ = {RANGE: reach}
        choose_transport(environ, 'rmw_cyclonedds_cpp')
        assert environ == {RANGE: reach}


def test_on_one_host_the_profile_takes_the_place_of_the_limit():
    environ = chosen(**{RANGE: 'LOCALHOST'})
    assert environ.pop(RANGE) == 'SYSTEM_DEFAULT'
    assert set(environ) == set(PROFILES)
    (profile,) = set(environ.values())
    assert '<address>127.0.0.1</address>' in Path(profile).read_text()


@pytest.mark.parametrize(
    ('transports', 'shared', 'reach'),
    [('', False, 'LOCALHOST'), ('', False, 'SUBNET'), ('DEFAULT', True, 'SUBNET')],
)
def test_a_node_maps_no_shared_memory_unless_that_is_asked_for(transports, shared, reach):
    environ = {k: v for k, v in os.environ.items() if k not in PROFILES}
    environ |= {TRANSPORTS: transports, RANGE: reach}
    done = subprocess.run(
        [sys.executable, '-c', NODE], env=environ, capture_output=True, text=True, check=True
    )
    assert (int(done.stdout) > 0) == shared
