# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Every executable: its help, its example as it stands there, and each refusal in a sentence."""

import importlib
import importlib.util
import json
import os
import re
import shlex
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from opcua_server import mapping, write_mapping
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from ros_helpers import wait_until
from std_msgs.msg import Float64
from valveflow_msgs.msg import PlantSample

from valveflow_ros.logs import write_samples
from valveflow_ros.parameters import TABLE
from valveflow_ros.plant.simulator import simulate
from valveflow_ros.records import SIGNALS
from valveflow_ros.ros import demo, replay_main, simulator_main, watch_main

pytestmark = pytest.mark.ros
MAINS = {
    'monitor': 'monitor_main', 'page': 'page_main', 'watch': 'watch_main', 'replay': 'replay_main',
    'plant_simulator': 'simulator_main', 'opcua_gateway': 'gateway_main',
}  # fmt: skip
NEEDS = {'page': 'dash', 'opcua_gateway': 'asyncua'}
# What each says once it works.
WORKS = {
    'monitor': r'U1: listening to .*; recording to /', 'page': 'The page is at',
    'watch': 'No monitor /unit1/valveflow_monitor was found', 'replay': 'Playing plant.mcap',
    'plant_simulator': 'wrong with it: gain_step', 'opcua_gateway': 'opc.tcp://127.0.0.1:9',
}  # fmt: skip


def there(name):
    return name not in NEEDS or importlib.util.find_spec(NEEDS[name]) is not None


def result_of(main, words):
    """Return the exit status of a main function in this process."""
    try:
        return main(words)
    except SystemExit as error:
        return error.code


def named(name):
    return importlib.import_module(f'valveflow_ros.ros.{MAINS[name]}').main


def test_help_is_a_page_and_its_example_works(context, processes, tmp_path, capsys):
    # A player begins once somebody listens to every input.
    ears = Node('ears', context=context)
    for topic, kind in (*((s.topic, Float64) for s in SIGNALS), ('plant_sample', PlantSample)):
        ears.create_subscription(kind, topic, lambda _: None, qos_profile_sensor_data)
    # A server that is not there: the gateway says so and goes on trying.
    write_mapping(tmp_path, mapping(9))
    write_samples(simulate(0.02, 3).table, tmp_path / 'plant.mcap')
    running = {}
    for name in filter(there, MAINS):
        assert result_of(named(name), ['--help']) == 0
        page = capsys.readouterr().out
        assert page.startswith('usage: ')
        for row in {'monitor': TABLE, 'plant_simulator': simulator_main.TABLE}.get(name, ()):
            assert row.name in page
            assert row.sentence in page
        found = re.search(rf'^examples?:\n  ros2 run valveflow_ros {name}(.*)$', page, re.M)
        assert found, page
        module = f'valveflow_ros.ros.{MAINS[name]}'
        running[name] = processes.start(module, *shlex.split(found[1]))
    for name, process in running.items():

        def works(name=name, process=process):
            said = processes.output(process)
            found = re.search(WORKS[name], said) is not None
            assert found or process.poll() is None, said
            return found

        wait_until(works, f'"{WORKS[name]}" of {name}')
    for process in running.values():
        process.terminate()
    for process in running.values():
        assert process.wait(60) == 0, processes.output(process)
        assert 'Traceback' not in processes.output(process)
    ears.destroy_node()


def test_help_that_nobody_reads_to_its_end_is_no_accident():
    """As by ``monitor --help | head -1``: the pipe is closed before a letter is written."""
    reader, writer = os.pipe()
    os.close(reader)
    words = [sys.executable, '-m', 'valveflow_ros.ros.monitor_main', '--help']
    with os.fdopen(writer, 'w') as closed:
        ended = subprocess.run(
            words, stdout=closed, stderr=subprocess.PIPE, text=True, timeout=120, check=False
        )
    assert (ended.returncode, ended.stderr) == (0, '')


def test_a_wrong_argument_is_refused_in_a_sentence(capsys):
    for parser, words, said in (
        (replay_main.parser, 'x.mcap --rate fast', '--rate must be a number of seconds of the'),
        (replay_main.parser, 'x.mcap --wait nan', "such as --wait 60; 'nan' is not"),
        (watch_main.parser, '--interval 0', "from 0.1 to 3600, such as --interval 5; '0' is"),
        (watch_main.parser, '--ask foo', 'valveflow watch: --ask must be one of refit, '),
        (watch_main.parser, '--ask', 'valveflow watch: --ask wants a value after it. Try --help.'),
        (replay_main.parser, 'x.mcap y.mcap', "replay: 'y.mcap' is one argument too many."),
        (replay_main.parser, '', 'valveflow replay: Something is missing: LOG.'),
        (demo.parser, '--output d --days -1', '--days must be a number of days'),
        (demo.parser, '--output d --seed x', "'x' is no whole number"),
    ):
        with pytest.raises(SystemExit) as ended:
            parser().parse_args(words.split())
        assert ended.value.code == 2
        told = capsys.readouterr().err
        assert said in told
        assert told.count('\n') == 1


NOT_A_FILE = 'cannot be opened (no such file or directory)'
REFUSED = [
    ('replay', 'missing.mcap', f'missing.mcap: {NOT_A_FILE}.', 1),
    ('replay', 'runs', 'give one of: runs/one, runs/two.', 1),
    ('replay', 'plain.mcap --verify', 'is no recording of the monitor', 1),
    ('replay', 'plain.mcap --rate -1', 'from 0 to 1000000', 2),
    ('replay', 'plain.mcap --wait 0.2', 'Nobody listened within 0.2 s', 1),
    ('plant_simulator', '--ros-args -p days:=-1.0', "Parameter 'days' must be from", 1),
    ('plant_simulator', '--ros-args -p effects:=gain', "Effect 'gain' is unknown", 1),
    ('plant_simulator', '--ros-args -p effects:=[1,2]', "'effects' must be a list of texts", 1),
    ('plant_simulator', '--ros-args -p rate:=60.0', "'rate' is 60, and plain values carry no", 1),
    ('plant_simulator', '--ros-args -p start:=yesterday', "'start' must be a time such as", 1),
    ('page', '--port TAKEN', 'choose one with --port.', 1),
    ('page', '--port 1 --webhook nowhere', '--webhook must be an address', 1),
    ('page', '--port 1 --token-file /no/such/file', '/no/such/file: cannot be read', 1),
    ('opcua_gateway', '--ros-args -p mapping_file:=perod', "did you mean 'period'?", 1),
    ('opcua_gateway', '', 'Name the mapping file', 1),
    ('opcua_gateway', '--ros-args -p mapping_file:=taken', 'cannot be offered: ', 1),
    ('monitor', '--ros-args --params-file negative', "Parameter 'refit_period' must be", 1),
    ('monitor', '--ros-args --params-file number', "Parameter 'unit_tag' must be a text, not 7; "
     "write unit_tag: '7' in a file, -p unit_tag:=\"'7'\" on a command line.", 1),
    ('monitor', '--unit U8', "'--unit' must follow --ros-args, as in: ros2 run", 2),
    ('monitor', '-p unit_tag:=U8', "'-p' must follow --ros-args", 2),
    ('plant_simulator', '--ros-args -p seed:=1 -- --days 1', "'--days' must follow --ros-args", 2),
    ('opcua_gateway', 'opcua.yaml', "'opcua.yaml' must follow --ros-args", 2),
    ('monitor', '--ros-args --params-file broken', 'ROS could not be started', 1),
]  # fmt: skip
PARAMETERS = {
    'negative': 'refit_period: -5.0', 'number': 'unit_tag: 7', 'broken': '[',
}  # fmt: skip


@pytest.mark.usefixtures('ros_environment')
@pytest.mark.parametrize(('name', 'words', 'said', 'status'), REFUSED)
def test_what_cannot_be_done_is_said_in_a_sentence(
    capfd, monkeypatch, tmp_path, name, words, said, status
):
    if not there(name):
        pytest.skip(f'{NEEDS[name]} is not installed')
    monkeypatch.chdir(tmp_path)
    for run in ('one', 'two'):
        Path('runs', run).mkdir(parents=True)
        Path('runs', run, 'log_0.mcap').touch()
    if 'plain.mcap' in words:
        write_samples(simulate(0.005, 3).table, Path('plain.mcap'))
    for file, text in PARAMETERS.items():
        Path(file).write_text(f'/**:\n  ros__parameters:\n    {text}\n')
    with socket.create_server(('127.0.0.1', 0)) as taken:
        port = taken.getsockname()[1]
        offer = {
            'endpoint': f'opc.tcp://127.0.0.1:{port}',
            'security': {'policy': 'None', 'allow_unencrypted': True},
        }
        Path('perod').write_text(json.dumps(mapping(1, perod=1)))
        Path('taken').write_text(json.dumps(mapping(1, server=offer)))
        arguments = shlex.split(words.replace('TAKEN', str(port)), posix=True)
        assert result_of(named(name), arguments) == status
    told = capfd.readouterr().err
    assert said in told
    assert told.count(f'valveflow {name}:') <= 1
    assert 'Traceback' not in told
