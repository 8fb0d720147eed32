# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The messages read like documentation, and keep to what the tools can show."""

from __future__ import annotations

import importlib
import os
import re
from dataclasses import dataclass
from pathlib import Path

import pytest

MSG = Path(__file__).resolve().parent.parent / 'msg'
FILES = sorted(MSG.glob('*.msg'))
WITHOUT_HEADER = {'DiagnosisCause'}  # a part of another message

UNITS = {
    '%', 'MPa', 'degC', 'MW', 'MW^2', 's', '% MPa^e', '% MPa^e / s', 'MW / (% MPa^e)', 'no unit',
}  # fmt: skip
KINDS = {'count', 'record', 'state', 'text', 'time'}
# A value whose unit stands in a field beside it.
BESIDE = re.compile(r'unit: see (field )?(\w+)')


@dataclass(frozen=True)
class Line:
    """A field or constant of a message."""

    type: str
    name: str
    value: str | None
    unit: str
    comment: str


def read(path: Path) -> list[Line]:
    """Take a message apart; every line that is no comment must be a documented field."""
    lines = []
    for text in path.read_text(encoding='utf-8').splitlines():
        if not text.strip() or text.startswith('#'):
            continue
        found = re.fullmatch(r'(\S+) (\w+)(?:=(\S+))? +# \[([^\]]+)\] ?(.*)', text)
        assert found, f'{path.name}: no unit in brackets behind: {text}'
        lines.append(Line(*found.groups()))
    return lines


def fields(path: Path) -> list[Line]:
    return [line for line in read(path) if line.value is None]


each_file = pytest.mark.parametrize('path', FILES, ids=lambda p: p.stem)


def test_all_are_built():
    """Every file is named in CMakeLists.txt, and no other."""
    text = (MSG / 'CMakeLists.txt').read_text()
    named = re.findall(r'\$\{root\}:msg/(\w+)\.msg', text)
    assert sorted(named) == [p.stem for p in FILES]
    assert re.findall(r':(srv/\w+\.srv)', text) == ['srv/OperateAlarm.srv']
    assert len(FILES) == 8


@each_file
def test_every_line_names_its_unit(path):
    names = {line.name for line in fields(path)}
    for line in read(path):
        beside = BESIDE.fullmatch(line.unit)
        if beside:
            assert beside[2] in names
        else:
            assert line.unit in UNITS | KINDS, f'{path.name}: {line.name} [{line.unit}]'


@each_file
def test_the_kind_fits_the_type(path):
    """A text has no unit, a state is a small number, and only numbers are measured."""
    for line in read(path):
        scalar = line.type.removesuffix('[]')
        if line.unit == 'text':
            assert scalar == 'string'
        elif line.unit == 'time':
            assert scalar == 'builtin_interfaces/Time'
        elif line.unit == 'record':
            assert scalar[0].isupper() or '/' in scalar
        elif line.unit == 'state':
            assert scalar in ('uint8', 'bool')
        elif line.unit == 'count':
            assert scalar in ('uint32', 'uint64')
        else:
            assert scalar == 'float64', f'{path.name}: {line.name}'


@each_file
def test_names_end_in_the_unit_they_carry(path):
    """A name that carries a unit carries the right one."""
    endings = {'_mw': 'MW', '_degc': 'degC', '_s': 's', '_per_s': '% MPa^e / s'}
    for line in fields(path):
        for ending in sorted(endings, key=len, reverse=True):
            if line.name.endswith(ending):
                assert line.unit == endings[ending], f'{path.name}: {line.name}'
                break


@each_file
def test_states_are_named_by_constants(path):
    """Every number that stands for a state has constants that name all it can be."""
    constants = [line for line in read(path) if line.value is not None]
    states = [line for line in fields(path) if line.unit == 'state' and line.type == 'uint8']
    assert bool(constants) == bool(states)
    assert all(line.type == 'uint8' for line in constants)
    assert len({line.name for line in constants}) == len(constants)
    assert all(line.comment for line in constants)


@each_file
def test_header_first(path):
    first = fields(path)[0]
    if path.stem in WITHOUT_HEADER:
        assert all('Header' not in line.type for line in fields(path))
    else:
        assert (first.type, first.name) == ('std_msgs/Header', 'header')
        assert 'stamp:' in first.comment
        assert 'frame_id:' in first.comment


@each_file
def test_what_unknown_looks_like_is_said(path):
    """The message says somewhere what stands for a number or text that is not there."""
    text = path.read_text(encoding='utf-8')
    types = {line.type for line in fields(path)}
    if 'float64' in types:
        assert 'NaN' in text
    for line in fields(path):
        if line.name == 'model_id' or line.name.startswith('not_'):
            assert 'empty:' in line.comment


@each_file
def test_arrays_have_no_bound(path):
    """Plot tools fail on bounded ones."""
    for line in fields(path):
        assert re.fullmatch(r'[\w/]+(\[\])?', line.type), f'{path.name}: {line.type}'


@each_file
def test_text_form(path):
    text = path.read_text(encoding='utf-8')
    assert text.startswith('# ')
    assert text.endswith('\n')
    assert not text.endswith('\n\n')
    assert text.isascii()
    assert '\t' not in text
    assert max(map(len, text.splitlines())) <= 112


def message_class(name: str) -> type:
    """The built class, or a skip where the package is not built."""
    try:
        module = importlib.import_module('valveflow_msgs.msg')
    except ImportError as error:
        if os.environ.get('VALVEFLOW_REQUIRE_ROS'):
            raise
        pytest.skip(f'valveflow_msgs is not built here ({error}); run make setup')
    return getattr(module, name)


def test_the_service_answers_as_a_trigger_does_and_is_built_as_written():
    text = (MSG / 'srv' / 'OperateAlarm.srv').read_text(encoding='utf-8')
    parts = [
        re.findall(r'^(\w+) (\w+) +# \[\w+\] ', part, re.MULTILINE)
        for part in text.split('\n---\n')
    ]
    assert parts == [
        [('string', 'name'), ('string', 'action')], [('bool', 'success'), ('string', 'message')]
    ]  # fmt: skip
    try:
        kind = importlib.import_module('valveflow_msgs.srv').OperateAlarm
    except ImportError as error:
        if os.environ.get('VALVEFLOW_REQUIRE_ROS'):
            raise
        pytest.skip(f'valveflow_msgs is not built here ({error}); run make setup')
    built = (kind.Request, kind.Response)
    assert [list(b.get_fields_and_field_types()) for b in built] == [
        [name for _, name in part] for part in parts
    ]


@each_file
def test_each_type_is_built_as_written(path):
    """The built class has the fields, constants and no others, and starts empty."""
    cls = message_class(path.stem)
    built = cls.get_fields_and_field_types()
    assert list(built) == [line.name for line in fields(path)]
    for line in read(path):
        if line.value is not None:
            assert getattr(cls, line.name) == int(line.value)
    message = cls()
    assert all(len(getattr(message, f.name)) == 0 for f in fields(path) if f.type.endswith('[]'))


def test_values_survive_the_wire():
    """Filled messages come back equal after a round trip through CDR."""
    cause_type, diagnosis_type = message_class('DiagnosisCause'), message_class('Diagnosis')
    serialization = importlib.import_module('rclpy.serialization')
    cause = cause_type(name='sticking', parameter_names=['width'], parameter_values=[0.5])
    message = diagnosis_type(causes=[cause, cause], verdict=diagnosis_type.NAMED)
    message.header.frame_id = 'unit 1'
    data = serialization.serialize_message(message)
    assert serialization.deserialize_message(data, diagnosis_type) == message
    assert serialization.deserialize_message(data, diagnosis_type).causes[1].name == 'sticking'
