# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The messages read like documentation and keep to what tools can show, as do our layouts."""

import importlib
import json
import os
import re
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import pytest

from docs.page_tables import message
from valveflow_ros.logs import Definitions
from valveflow_ros.logs.mcap.definitions import parse_all
from valveflow_ros.monitoring.alarms import ResidualAlarm, ShiftAlarm

ROOT = Path(__file__).resolve().parent.parent
MSG, CONFIG = ROOT / 'msg', ROOT / 'config'
FILES = sorted(MSG.glob('*.msg'))
WITHOUT_HEADER = {'DiagnosisCause'}  # a part of another message

# The type that each kind of value has; what is measured is a float64.
KINDS = {
    'text': r'string', 'time': r'builtin_interfaces/Time', 'record': r'([A-Z]|\w+/)\w+',
    'state': r'uint8|bool', 'count': r'uint32|uint64',
}  # fmt: skip
UNITS = {
    '%', 'MPa', 'degC', 'MW', 'MW^2', 's', '% MPa^e', '% MPa^e / s', 'MW / (% MPa^e)', 'no unit',
}  # fmt: skip
# A value whose unit stands in a field beside it.
BESIDE = re.compile(r'unit: see (field )?(\w+)')
ENDINGS = {'_mw': 'MW', '_degc': 'degC', '_per_s': '% MPa^e / s', '_s': 's'}


def test_all_are_built():
    """Every file is named in CMakeLists.txt, and no other."""
    text = (MSG / 'CMakeLists.txt').read_text()
    named = re.findall(r'\$\{root\}:msg/(\w+)\.msg', text)
    assert sorted(named) == [p.stem for p in FILES]
    assert re.findall(r':(srv/\w+\.srv)', text) == ['srv/OperateAlarm.srv']


def test_every_line_names_its_unit_and_its_type_fits():
    """A text has no unit, a state is a small number, and only numbers are measured.

    Arrays have no bound, because plot tools fail on bounded ones.
    """
    for path in FILES:
        _, fields, constants = message(path)
        text = path.read_text(encoding='utf-8')
        lines = [line for line in text.splitlines() if line and not line.startswith('#')]
        for line in lines:
            assert re.fullmatch(r'\S+ \w+(=\S+)? +# \[[^\]]+\].*', line), line
        assert len(lines) == len(fields) + len(constants)
        names = {name for name, *_ in fields}
        for name, kind, unit, _ in fields:
            beside = BESIDE.fullmatch(unit)
            assert beside[2] in names if beside else unit in UNITS | set(KINDS), name
            assert re.fullmatch(KINDS.get(unit, 'float64'), kind.removesuffix('[]')), name
            ending = next((e for e in ENDINGS if name.endswith(e)), '')
            assert unit == ENDINGS.get(ending, unit), name
        name, kind, _, meaning = fields[0]
        if path.stem not in WITHOUT_HEADER:
            assert (kind, name) == ('std_msgs/Header', 'header')
            assert re.search('stamp:.*frame_id:', meaning)


def test_states_and_what_is_not_known_are_explained():
    """Every number that stands for a state has constants that name all it can be.

    The message says somewhere what stands for a number or text that is not there.
    """
    for path in FILES:
        _, fields, constants = message(path)
        states = [name for name, kind, unit, _ in fields if (kind, unit) == ('uint8', 'state')]
        assert bool(constants) == bool(states), path
        assert len({name for name, _, _ in constants}) == len(constants)
        assert all(meaning for _, _, meaning in constants)
        assert 'NaN' in path.read_text() or all(kind != 'float64' for _, kind, _, _ in fields)
        for name, _, _, meaning in fields:
            assert 'empty:' in meaning or not (name == 'model_id' or name.startswith('not_'))


def built(module: str, name: str) -> Any:
    """The built class, or a skip where the package is not built."""
    try:
        return getattr(importlib.import_module(module), name)
    except ImportError as error:
        if os.environ.get('VALVEFLOW_REQUIRE_ROS'):
            raise
        pytest.skip(f'valveflow_msgs is not built here ({error}); run make setup')


def test_the_service_answers_as_a_trigger_does_and_is_built_as_written():
    text = (MSG / 'srv' / 'OperateAlarm.srv').read_text(encoding='utf-8')
    parts = [
        re.findall(r'^(\w+) (\w+) +# \[\w+\] ', part, re.MULTILINE)
        for part in text.split('\n---\n')
    ]
    assert parts == [
        [('string', 'name'), ('string', 'action')], [('bool', 'success'), ('string', 'message')]
    ]  # fmt: skip
    kind = built('valveflow_msgs.srv', 'OperateAlarm')
    for half, part in zip((kind.Request, kind.Response), parts, strict=True):
        assert list(half.get_fields_and_field_types()) == [name for _, name in part]


def test_each_type_is_built_as_written():
    for path in FILES:
        cls = built('valveflow_msgs.msg', path.stem)
        _, fields, constants = message(path)
        assert list(cls.get_fields_and_field_types()) == [name for name, *_ in fields]
        assert {name: getattr(cls, name) for name, _, _ in constants} == {
            name: int(value) for name, value, _ in constants
        }
        assert all(len(getattr(cls(), f[0])) == 0 for f in fields if f[1].endswith('[]'))


# --- the layouts for Foxglove and PlotJuggler ------------------------------------------------

NODE = '/valveflow_monitor'
TYPES = {
    'characteristic': 'valveflow_msgs/msg/FlowCharacteristic',
    'prediction': 'valveflow_msgs/msg/Prediction',
    'alarms': 'valveflow_msgs/msg/Alarm',
    'diagnosis': 'valveflow_msgs/msg/Diagnosis',
}
NUMBERS = {'bool', 'uint8', 'uint32', 'uint64', 'float64', 'int32'}
# A topic, a filter on it, then fields with slices.
PATH = re.compile(
    rf'{NODE}/(?P<topic>\w+)(?:\{{(?P<filter>\w+)==[^}}]+\}})?(?P<fields>(?:\.\w+(?:\[[0-9:]*\])?)*)\Z'
)


def found(topic: str, *steps: str) -> str:
    """Return the type of the field that a path of names leads to; an array is sliced."""
    types = parse_all(TYPES[topic], Definitions([]).text(TYPES[topic]))
    kind = TYPES[topic]
    for step in steps:
        fields = {f.name: f for f in types[kind]}
        name = step.partition('[')[0]
        assert name in fields, f'{topic} has no field {name}'
        assert bool(fields[name].array) == ('[' in step), f'{topic}.{step}'
        kind = fields[name].type
    return kind


def resolved(path: str) -> str:
    match = PATH.match(path)
    assert match, f'{path} is no path of a topic of ours'
    if match['filter']:
        assert found(match['topic'], match['filter']) == 'string'
    return found(match['topic'], *match['fields'].split('.')[1:])


@pytest.fixture(scope='module')
def foxglove() -> dict[str, Any]:
    return dict(json.loads((CONFIG / 'foxglove_layout.json').read_text()))


@pytest.fixture(scope='module')
def plotjuggler() -> ET.Element:
    return ET.parse(CONFIG / 'plotjuggler_layout.xml').getroot()


def test_every_path_of_foxglove_leads_to_a_field(foxglove):
    plotted = set()
    for name, panel in foxglove['configById'].items():
        # A replay has stamps of another day; over those its plots would be empty.
        assert {p['timestampMethod'] for p in panel.get('paths', ())} <= {'receiveTime'}
        assert panel.get('topicToRender') in (None, '/diagnostics')
        if panel.get('topicPath'):
            resolved(panel['topicPath'])
        for path in [*panel.get('paths', ()), *filter(None, [panel.get('xAxisPath')])]:
            try:
                float(path['value'])  # a reference line
            except ValueError:
                assert resolved(path['value']) in NUMBERS, name
                plotted.add(path['value'].removeprefix(f'{NODE}/'))
    wanted = (
        'characteristic.values[:]', 'characteristic.breakpoints[:]', 'prediction.measured_mw',
        'prediction.dynamic_mw', 'prediction.residual_mw', 'prediction.limit_low_mw',
        'prediction.limit_high_mw', 'diagnosis.verdict',
    )  # fmt: skip
    assert set(wanted) <= plotted
    named = set(re.findall(r'name==\\"([^"\\]+)\\"', json.dumps(foxglove)))
    assert named == {ResidualAlarm.NAME, ShiftAlarm.NAME}


def test_every_series_of_plotjuggler_is_a_number_of_a_message(plotjuggler):
    curves = plotjuggler.findall(".//plot[@mode='TimeSeries']/curve")
    names = {curve.attrib['name'] for curve in curves}
    assert {f'{NODE}/prediction/measured_mw', f'{NODE}/diagnosis/verdict'} <= names
    for name in names:
        assert found(*name.removeprefix(f'{NODE}/').split('/', 1)) in NUMBERS, name
    # It drops NaN, and then refuses to pair two series that do not have the same times.
    assert all('curve_x' not in curve.attrib for curve in plotjuggler.iter('curve'))


def test_the_script_of_plotjuggler_draws_the_curve_of_the_message(plotjuggler):
    (script,) = plotjuggler.iter('script')
    code = script.attrib['global']
    made = set(re.findall(r'ScatterXY\.new\("([^"]+)"\)', code))
    drawn = [c.attrib['name'] for c in plotjuggler.iterfind(".//plot[@mode='XYPlot']/curve")]
    assert sorted(drawn) == sorted(made)
    for topic, fields in (
        ('characteristic', ('breakpoints[]', 'values[]', 'pieces')),
        ('prediction', ('integrated_input', 'measured_mw')),
    ):
        assert f'"{NODE}/{topic}"' in code
        for field in fields:
            assert f'/{field.removesuffix("[]")}' in code
            found(topic, field)


def test_plotjuggler_takes_the_topics_that_it_draws(plotjuggler):
    wanted = ';'.join(f'{NODE}/{topic}' for topic in TYPES)
    plugins = {p.attrib['ID']: p for p in plotjuggler.iter('plugin')}
    assert plugins['DataLoad MCAP'][0].attrib['selected_topics'] == wanted
    subscriber = plugins['ROS2 Topic Subscriber'].find('selected_topics')
    assert subscriber.attrib['value'] == wanted


@pytest.mark.ros
def test_the_topics_of_the_layouts_are_those_of_the_node():
    outputs = pytest.importorskip('valveflow_ros.ros.node.outputs').OUTPUTS
    assert {name: outputs[name].type_name for name in TYPES} == TYPES
