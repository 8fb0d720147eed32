# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The launch files: what they declare, and that every argument is explained."""

from pathlib import Path

import pytest
import yaml

from valveflow_ros.errors import ValveflowError
from valveflow_ros.ros.process import read_units

ROOT = Path(__file__).resolve().parents[2]
LAUNCH = ROOT / 'launch'
PYTHON = ['monitor.launch.py', 'replay.launch.py', 'demo.launch.py', 'units.launch.py']


def test_the_yaml_twin_explains_its_arguments_and_uses_them_all():
    text = (LAUNCH / 'monitor.launch.yaml').read_text()
    content = yaml.safe_load(text)['launch']
    arguments = {entry['arg']['name']: entry['arg'] for entry in content if 'arg' in entry}
    assert {'namespace', 'params_file', 'use_sim_time', 'autostart', 'record'} <= set(arguments)
    for name, argument in arguments.items():
        assert argument['description'].endswith('.')
        assert f'$(var {name})' in text
    (node,) = [entry['node'] for entry in content if 'node' in entry]
    assert (node['pkg'], node['exec']) == ('valveflow_ros', 'monitor')


@pytest.mark.parametrize('name', PYTHON)
def test_python_launch_files_explain_their_arguments(name):
    code = compile((LAUNCH / name).read_text(), name, 'exec')
    assert 'generate_launch_description' in code.co_names
    pytest.importorskip('launch_ros', reason='needs ros2/launch_ros, of which there is no wheel')
    from launch.launch_description_sources import PythonLaunchDescriptionSource

    from launch import LaunchContext

    description = PythonLaunchDescriptionSource(str(LAUNCH / name)).get_launch_description(
        LaunchContext()
    )
    arguments = description.get_launch_arguments()
    which = 'units' if name.startswith('units') else 'namespace'
    assert {which, 'log_level'} <= {argument.name for argument in arguments}
    for argument in arguments:
        assert argument.description.strip().endswith('.'), argument.name


def test_the_list_of_units_is_read_beside_its_files(tmp_path):
    for name in ('u1.yaml', 'u2.yaml', 'opcua.yaml'):
        (tmp_path / name).touch()
    path = tmp_path / 'units.yaml'
    path.write_text((ROOT / 'config' / 'units.yaml').read_text())
    first, second = read_units(path)
    assert (first.namespace, second.namespace) == ('/u1', '/u2')
    assert first.params_file == str(tmp_path / 'u1.yaml')
    assert first.gateway == second.gateway == str(tmp_path / 'opcua.yaml')


@pytest.mark.parametrize(
    ('text', 'sentence'),
    [
        ('[', 'cannot be read as a list of units'),
        ('{}', 'a list of units is expected'),
        ('- {namespace: /u1}', 'unit 1: namespace and params_file are expected'),
        ('- {namespace: /u1, params_file: x, port: 1}', 'unit 1: namespace and params_file are'),
        ('- {namespace: /u1, params_file: no.yaml}', 'is not there; unit 1 of units.yaml'),
        ('[{namespace: u1, params_file: units.yaml}, {namespace: /u1, params_file: units.yaml}]',
         "two units have the namespace '/u1'"),
    ],
)  # fmt: skip
def test_a_list_that_cannot_be_used_is_refused(tmp_path, text, sentence):
    path = tmp_path / 'units.yaml'
    path.write_text(text)
    with pytest.raises(ValveflowError, match=sentence):
        read_units(path)
