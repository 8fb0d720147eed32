# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The layouts for Foxglove and PlotJuggler name what our messages have, and are installed."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from valveflow_ros.logs import Definitions
from valveflow_ros.logs.mcap.definitions import parse_all

ROOT = Path(__file__).resolve().parent.parent
CONFIG = ROOT / 'config'
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


def fields_of(topic: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the fields of a topic's type by name, and those of every type it needs."""
    kind = TYPES[topic]
    types = parse_all(kind, Definitions([]).text(kind))
    return {f.name: f for f in types[kind]}, types


def found(topic: str, steps: list[tuple[str, bool]]) -> Any:
    """Return the field that a path of names leads to; a step tells whether it is sliced."""
    fields, types = fields_of(topic)
    field = None
    for name, sliced in steps:
        assert name in fields, f'{topic} has no field {name}'
        field = fields[name]
        assert bool(field.array) == sliced, f'{topic}.{name} is {field.array or "no array"}'
        fields = {f.name: f for f in types.get(field.type, ())}
    return field


def resolved(path: str) -> Any:
    match = PATH.match(path)
    assert match, f'{path} is no path of a topic of ours'
    if match['filter']:
        assert found(match['topic'], [(match['filter'], False)]).type == 'string'
    steps = re.findall(r'\.(\w+)(\[[0-9:]*\])?', match['fields'])
    return found(match['topic'], [(name, bool(cut)) for name, cut in steps])


def foxglove() -> dict[str, Any]:
    content: dict[str, Any] = json.loads((CONFIG / 'foxglove_layout.json').read_text())
    return content


def leaves(node: Any) -> Iterator[str]:
    if isinstance(node, str):
        yield node
        return
    assert node['direction'] in ('row', 'column')
    assert 0 < node['splitPercentage'] < 100
    yield from leaves(node['first'])
    yield from leaves(node['second'])


def test_every_panel_of_foxglove_is_shown_once_and_known():
    layout = foxglove()
    shown = list(leaves(layout['layout']))
    assert sorted(shown) == sorted(layout['configById'])
    kinds = {'Plot', 'StateTransitions', 'RawMessages', 'DiagnosticSummary', 'Table'}
    assert {name.split('!')[0] for name in shown} == kinds


def test_every_path_of_foxglove_leads_to_a_field():
    plotted = set()
    for name, panel in foxglove()['configById'].items():
        if panel.get('topicToRender'):
            assert panel['topicToRender'] == '/diagnostics'
        if panel.get('topicPath'):
            resolved(panel['topicPath'])
        for path in [*panel.get('paths', ()), *filter(None, [panel.get('xAxisPath')])]:
            try:
                float(path['value'])  # a reference line
            except ValueError:
                assert resolved(path['value']).type in NUMBERS, name
                plotted.add(path['value'])
    wanted = {
        f'{NODE}/characteristic.values[:]', f'{NODE}/characteristic.breakpoints[:]',
        f'{NODE}/prediction.measured_mw', f'{NODE}/prediction.dynamic_mw',
        f'{NODE}/prediction.residual_mw', f'{NODE}/prediction.limit_low_mw',
        f'{NODE}/prediction.limit_high_mw', f'{NODE}/diagnosis.verdict',
    }  # fmt: skip
    assert wanted <= plotted


def test_foxglove_draws_over_the_time_of_the_recording():
    """A replay has stamps of another day; over those its plots would be empty."""
    for panel in foxglove()['configById'].values():
        for path in panel.get('paths', ()):
            assert path['timestampMethod'] == 'receiveTime'


def test_every_panel_of_foxglove_is_titled_in_lichtblick_too():
    for panel in foxglove()['configById'].values():
        assert panel['foxglovePanelTitle'] == panel['lichtblickPanelTitle']


def test_the_curve_of_foxglove_is_drawn_over_its_own_breakpoints():
    curve = foxglove()['configById']['Plot!curve']
    assert curve['xAxisVal'] == 'currentCustom'
    assert curve['xAxisPath']['value'].startswith(f'{NODE}/characteristic.')


def test_alarms_are_named_as_the_engine_names_them():
    from valveflow_ros.monitoring.alarms import ResidualAlarm, ShiftAlarm

    text = (CONFIG / 'foxglove_layout.json').read_text()
    named = set(re.findall(r'name==\\"([^"\\]+)\\"', text))
    assert named == {ResidualAlarm.NAME, ShiftAlarm.NAME}


def plotjuggler() -> ET.Element:
    return ET.parse(CONFIG / 'plotjuggler_layout.xml').getroot()


def series_of_plotjuggler() -> set[str]:
    names: set[str] = set()
    for plot in plotjuggler().iter('plot'):
        for curve in plot.iter('curve'):
            if plot.get('mode') == 'TimeSeries':
                names.add(curve.attrib['name'])
    return names


def test_every_series_of_plotjuggler_is_a_number_of_a_message():
    names = series_of_plotjuggler()
    assert {f'{NODE}/prediction/measured_mw', f'{NODE}/diagnosis/verdict'} <= names
    for name in names:
        topic, field = name.removeprefix(f'{NODE}/').split('/', 1)
        assert found(topic, [(field, False)]).type in NUMBERS, name


def test_the_script_of_plotjuggler_draws_the_curve_of_the_message():
    root = plotjuggler()
    (script,) = root.iter('script')
    made = set(re.findall(r'ScatterXY\.new\("([^"]+)"\)', script.attrib['global']))
    drawn = [c.attrib['name'] for c in root.iterfind(".//plot[@mode='XYPlot']/curve")]
    assert sorted(drawn) == sorted(made)
    code = script.attrib['global']
    for topic, fields in (
        ('characteristic', {'breakpoints': True, 'values': True, 'pieces': False}),
        ('prediction', {'integrated_input': False, 'measured_mw': False}),
    ):
        assert f'"{NODE}/{topic}"' in code
        for field, sliced in fields.items():
            assert f'/{field}' in code
            found(topic, [(field, sliced)])


def test_no_plot_of_plotjuggler_pairs_series_itself():
    """It drops NaN, and then refuses to pair two series that do not have the same times."""
    for curve in plotjuggler().iter('curve'):
        assert 'curve_x' not in curve.attrib


def test_sizes_and_topics_of_plotjuggler_add_up():
    root = plotjuggler()
    for splitter in root.iter('DockSplitter'):
        sizes = [float(part) for part in splitter.attrib['sizes'].split(';')]
        assert len(sizes) == int(splitter.attrib['count']) == len(splitter.findall('DockArea'))
        assert sum(sizes) == pytest.approx(1.0)
    wanted = ';'.join(f'{NODE}/{topic}' for topic in TYPES)
    plugins = {p.attrib['ID']: p for p in root.iter('plugin')}
    assert plugins['DataLoad MCAP'][0].attrib['selected_topics'] == wanted
    subscriber = plugins['ROS2 Topic Subscriber'].find('selected_topics')
    assert subscriber is not None
    assert subscriber.attrib['value'] == wanted


def test_installation_ships_them():
    assert "files('config/*')" in (ROOT / 'setup.py').read_text()
    for name in ('foxglove_layout.json', 'plotjuggler_layout.xml'):
        assert (CONFIG / name).is_file()


@pytest.mark.ros
def test_the_topics_are_those_of_the_node():
    outputs = pytest.importorskip('valveflow_ros.ros.node.outputs').OUTPUTS
    assert {name: outputs[name].type_name for name in TYPES} == TYPES
