# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The OPC UA gateway as a process between real servers and ROS, both ways."""

import asyncio
import importlib.util
import signal
from datetime import datetime, timedelta, timezone
from types import SimpleNamespace

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from opcua_server import (
    ENGINE,
    OpcUaServer,
    certificate,
    free_port,
    mapping,
    signals,
    write_mapping,
)
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from ros_helpers import spin_until, wait_until
from test_ros_watch import AT_S, Speaker
from valveflow_msgs.msg import Alarm, PlantSample

import valveflow_ros as vf
from valveflow_ros.opcua.mapping import read_mapping_file
from valveflow_ros.records import Readings
from valveflow_ros.ros.gateway_main import GatewayUnit

pytestmark = [
    pytest.mark.ros,
    pytest.mark.skipif(
        importlib.util.find_spec('asyncua') is None, reason='asyncua not installed; an extra'
    ),
]
GATEWAY = 'valveflow_ros.ros.gateway_main'


class Hearing:
    """Hears samples of units and the gateway's health."""

    def __init__(self, context, *units):
        self.node = Node('hearing', context=context)
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(self.node)
        self.samples = {unit: [] for unit in units}
        self.health = {}
        self.values = {}
        for unit in units:
            self.node.create_subscription(
                PlantSample, f'{unit}/plant_sample', self.samples[unit].append, 1000
            )
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._on_health, 10)

    def _on_health(self, message):
        for status in message.status:
            self.health[status.name] = status.level[0], status.message
            self.values[status.name] = {pair.key: pair.value for pair in status.values}

    def until(self, condition, what):
        spin_until(self._executor, condition, what, 60.0)

    def last(self, unit):
        return self.samples[unit][-1] if self.samples[unit] else None

    def until_quality(self, unit, quality, topic='generated_power'):
        self.until(
            lambda: self.last(unit) and getattr(self.last(unit), f'{topic}_quality') == quality,
            f'quality {quality} of {topic}',
        )

    def until_told(self, item, words):
        self.until(lambda: words in self.health.get(item, (0, ''))[1], f'{item}: {words}')


@pytest.fixture
def hearing(context):
    made = Hearing(context, '/u1', '/u2')
    yield made
    made.node.destroy_node()


@pytest.fixture(scope='module')
def server():
    made = OpcUaServer(free_port())
    yield made
    made.kill()


def start(processes, folder, content):
    path = write_mapping(folder, content)
    return processes.start(GATEWAY, '--ros-args', '-p', f'mapping_file:={path}')


def two_units(server):
    content = mapping(server.port)
    missing = signals(valve_opening={'node': 'ns=3;s=HV', 'unit': '%'})
    content['units'].append({'namespace': '/u2', 'tag': 'U2', 'signals': missing})
    return content


def test_samples_of_two_units_health_and_an_outage(processes, hearing, server, tmp_path):
    gateway = start(processes, tmp_path, two_units(server))
    hearing.until_quality('/u1', PlantSample.QUALITY_GOOD)
    hearing.until_quality('/u2', PlantSample.QUALITY_GOOD)
    sample = hearing.last('/u1')
    assert sample.header.frame_id == 'U1'
    assert {name: getattr(sample, name) for name in ENGINE} == pytest.approx(ENGINE)
    # Not mapped: the monitor leaves it alone. Not there: bad.
    assert sample.valve_command_quality == PlantSample.QUALITY_UNKNOWN
    assert hearing.last('/u2').valve_opening_quality == PlantSample.QUALITY_BAD
    hearing.until_told('u2/opcua_gateway: signal valve_opening', 'no such node')
    hearing.until_told('u1/opcua_gateway: link', 'Connected to opc.tcp://127.0.0.1')
    power = 'u1/opcua_gateway: signal generated_power'
    hearing.until_told(power, '150 MW, good, ')
    # Unchanged: it stays good, and is older each time.
    values = dict(hearing.values[power])
    assert (values['value (MW)'], values['status']) == ('150', 'good')
    hearing.until(
        lambda: float(hearing.values[power]['age_s']) > float(values['age_s']) + 1.0, 'its age'
    )
    server.set('power', 151_000.0, status='UncertainSensorNotAccurate')
    hearing.until_told(power, '151 MW, uncertain, ')
    assert float(hearing.values[power]['age_s']) < 10.0
    server.set('power', 'text', kind='String')
    hearing.until_quality('/u1', PlantSample.QUALITY_BAD)
    hearing.until_told(power, '1 wrong_type')
    assert [hearing.values[power][k] for k in ('value (MW)', 'status')] == ['unknown', 'bad']
    server.kill()
    hearing.until_told('u1/opcua_gateway: link', 'nobody listens there')
    hearing.until_quality('/u1', PlantSample.QUALITY_BAD, 'main_steam_pressure')
    server.restart()
    hearing.until_told('u1/opcua_gateway: link', 'Connected')
    hearing.until_quality('/u1', PlantSample.QUALITY_GOOD)
    for unit in ('/u1', '/u2'):
        stamps = [(s.header.stamp.sec, s.header.stamp.nanosec) for s in hearing.samples[unit]]
        assert stamps == sorted(set(stamps))
    gateway.send_signal(signal.SIGTERM)
    assert gateway.wait(20) == 0
    told = processes.output(gateway)
    assert 'U1, link: No link to' in told
    assert 'Traceback' not in told


def test_what_a_monitor_says_is_read_by_opc_ua(processes, context, server, tmp_path):
    from asyncua import Client, ua
    from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256

    keys = {name: certificate(tmp_path, name) for name in ('gateway', 'dcs', 'stranger')}
    keys['old'] = certificate(tmp_path, 'old', -1.0)
    keys['damaged'] = (str(tmp_path / 'damaged.der'), '')
    (tmp_path / 'damaged.der').write_bytes(b'no certificate')
    port = free_port()
    content = mapping(server.port, server={
        'endpoint': f'opc.tcp://127.0.0.1:{port}',
        'security': {'certificate': keys['gateway'][0], 'private_key': keys['gateway'][1],
                     'trusted': [keys[name][0] for name in ('dcs', 'old', 'damaged')]},
    })  # fmt: skip
    content['units'][0] |= {'namespace': '', 'monitor': 'valveflow_monitor'}
    gateway = start(processes, tmp_path, content)
    wait_until(lambda: 'are offered at' in processes.output(gateway), 'the server')
    # A certificate that is of no use stops only the client that has it.
    told = processes.output(gateway)
    day = f'{datetime.now(timezone.utc) - timedelta(days=1):%Y-%m-%d}'
    assert f'{keys["old"][0]}: expired on {day}; the client that has it is refused.' in told
    damaged = f'{keys["damaged"][0]}: is no certificate that can be read; the client that has it '
    assert f'{damaged}is refused.' in told
    assert 'WARN' in told
    speaker = Speaker(context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(speaker)
    alarms = speaker._latched[1]

    async def client_of(name):
        client = Client(f'opc.tcp://127.0.0.1:{port}', timeout=10)
        client.application_uri = f'urn:test:{name}'
        await client.set_security(
            SecurityPolicyBasic256Sha256, *keys[name], server_certificate=keys['gateway'][0]
        )
        return client

    class Events(list):
        def event_notification(self, event):
            self.append(event)

    async def read():
        for refused in ('stranger', 'old'):
            with pytest.raises(ua.UaError):
                await (await client_of(refused)).connect()
        async with await client_of('dcs') as client:
            index = await client.get_namespace_index('urn:valveflow')

            def node(name):
                return client.get_node(f'ns={index};s=U1.{name}')

            async def data(name):
                return await node(name).read_data_value(raise_on_bad_status=False)

            async def until(name, condition, what):
                for _ in range(600):
                    if condition(await data(name)):
                        return
                    executor.spin_once(timeout_sec=0)
                    await asyncio.sleep(0.05)
                pytest.fail(f'{what} did not come: {await data(name)}')

            await until('characteristic.breakpoints', lambda d: d.Value.Value == [1000.0, 2000.0],
                        'the curve')  # fmt: skip
            await until('diagnosis.causes_name', lambda d: d.Value.Value == ['stiction'], 'it')
            await until('alarms.residual.sentence', lambda d: d.Value.Value == 'Less.', 'alarm')
            assert (await data('characteristic.stamp')).SourceTimestamp.timestamp() == AT_S
            # Nothing was said of it.
            shift = (await data('alarms.curve_shift.state')).StatusCode
            assert shift.name == 'BadWaitingForInitialData'
            with pytest.raises(ua.UaError, match='BadUserAccessDenied'):
                await node('characteristic.breakpoints').write_value([0.0])
            events = Events()
            subscription = await client.create_subscription(50, events)
            kinds = await client.nodes.base_event_type.get_children()
            (kind,) = [
                k for k in kinds if (await k.read_browse_name()).Name == 'ValveflowAlarmType'
            ]
            await subscription.subscribe_events(client.get_node(f'ns={index};s=U1'), kind)
            seen = {'sentence': 'Seen.', 'value': -12.0, 'unit': 'MW', 'priority': Alarm.HIGH}
            alarms.publish(Alarm(
                header=speaker.head, name='residual', state=Alarm.ACKNOWLEDGED,
                previous_state=Alarm.UNACKNOWLEDGED, **seen,
            ))  # fmt: skip
            for _ in range(600):
                if events:
                    break
                await asyncio.sleep(0.05)
            (event,) = events
            assert (event.SourceName, event.Message.Text) == ('residual', 'Seen.')
            assert (event.Severity, event.State, event.Value) == (900, 2, -12.0)
            executor.remove_node(speaker)
            speaker.destroy_node()
            old = 'UncertainLastUsableValue'
            breakpoints = 'characteristic.breakpoints'
            await until(breakpoints, lambda d: d.StatusCode.name == old, 'the mark')

    asyncio.run(read())
    gateway.send_signal(signal.SIGINT)
    assert gateway.wait(20) == 0


def test_the_history_of_an_outage_is_a_recording(tmp_path):
    unit = read_mapping_file(
        write_mapping(tmp_path, mapping(1, backfill_directory='new/backfill'))
    ).units[0]
    parts = [Readings.of([(AT_S * 10**9 + k, k % 4, 10.0, 0) for k in range(8)])]
    told = GatewayUnit._save(SimpleNamespace(unit=unit), parts)
    path = tmp_path / 'new/backfill/backfill_U1_20231114T221320Z.mcap'
    assert told == f'8 values in {path}'
    assert len(vf.open_log(path).readings) == 8


@pytest.mark.long
def test_the_demo_tells_its_story(processes, tmp_path):
    demo = processes.start('valveflow_ros.ros.opcua_demo', '--output', str(tmp_path / 'demo'))
    assert demo.wait(300) == 0
    told = processes.output(demo)
    for words in ('publishes plant_sample', 'Read back', 'is killed', 'started again', 'pieces'):
        assert words in told
