"""Messages go over sockets: a killed process leaves no shared memory that others go on using."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip('rclpy')

from valveflow_ros.ros.domain import choose_transport

pytestmark = pytest.mark.ros
FAST_DDS = 'rmw_fastrtps_cpp'
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


def chosen(**given: str) -> dict[str, str]:
    environ = dict(given)
    choose_transport(environ, FAST_DDS)
    return environ


@pytest.mark.parametrize('name', [TRANSPORTS, *PROFILES])
@pytest.mark.parametrize('reach', ['LOCALHOST', 'SUBNET'])
def test_who_has_chosen_keeps_the_choice(name: str, reach: str) -> None:
    given = {name: 'SHM', RANGE: reach}
    assert chosen(**given) == given


@pytest.mark.parametrize(
    'name', ['ROS_LOCALHOST_ONLY', 'ROS_STATIC_PEERS', 'ROS_DISCOVERY_SERVER']
)
def test_discovery_of_another_kind_is_left_alone(name: str) -> None:
    given = {name: '1', RANGE: 'LOCALHOST'}
    assert chosen(**given) == given


@pytest.mark.parametrize('reach', ['LOCALHOST', 'SUBNET', ''])
def test_another_middleware_is_left_alone(reach: str) -> None:
    environ = {RANGE: reach}
    choose_transport(environ, 'rmw_cyclonedds_cpp')
    assert environ == {RANGE: reach}


@pytest.mark.parametrize('reach', ['', 'SUBNET', 'OFF', 'SYSTEM_DEFAULT'])
def test_the_reach_stays_as_it_was(reach: str) -> None:
    assert chosen(**{RANGE: reach}) == {RANGE: reach, TRANSPORTS: 'UDPv4?sockets_size=4MB'}


def test_on_one_host_the_profile_takes_the_place_of_the_limit() -> None:
    environ = chosen(**{RANGE: 'LOCALHOST'})
    assert environ.pop(RANGE) == 'SYSTEM_DEFAULT'
    assert set(environ) == set(PROFILES)
    (profile,) = set(environ.values())
    assert '<address>127.0.0.1</address>' in Path(profile).read_text()


@pytest.mark.parametrize('reach', ['LOCALHOST', 'SUBNET'])
@pytest.mark.parametrize(('transports', 'shared'), [('', False), ('DEFAULT', True)])
def test_a_node_maps_no_shared_memory_unless_that_is_asked_for(
    transports: str, shared: bool, reach: str
) -> None:
    environ = {k: v for k, v in os.environ.items() if k not in PROFILES}
    environ |= {TRANSPORTS: transports, RANGE: reach}
    done = subprocess.run(
        [sys.executable, '-c', NODE], env=environ, capture_output=True, text=True, check=True
    )
    assert (int(done.stdout) > 0) == shared
