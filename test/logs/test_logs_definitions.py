# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
import functools
import json
import os
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from log_files import STOCK

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs import Decoder, Definitions
from valveflow_ros.logs.mcap.definitions import (
    BUNDLED,
    SEPARATOR,
    Field,
    full_name,
    parse_all,
    parse_fields,
    type_hash,
)
from valveflow_ros.logs.mcap.records import LayoutError

typesys = pytest.importorskip('rosbags.typesys')

MESSAGES = Path(__file__).parents[2] / 'msg'
OWN = sorted(f'valveflow_msgs/msg/{path.stem}' for path in MESSAGES.glob('*.msg'))


@functools.cache
def typestore_of(name: str):
    store = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
    fresh = typesys.get_types_from_msg(STOCK.text(name), name)
    store.register({key: fields for key, fields in fresh.items() if key not in store.fielddefs})
    return store


@pytest.mark.parametrize('name', sorted(BUNDLED))
def test_stock_definitions_have_the_hashes_of_jazzy(name):
    store = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
    assert STOCK.type_hash(name) == store.hash_rihs01(name)


@pytest.mark.parametrize('name', OWN)
def test_own_definitions_are_complete_and_hash_as_an_independent_library_says(name):
    assert STOCK.type_hash(name) == typestore_of(name).hash_rihs01(name)
    needed = {
        field.type for fields in parse_all(name, STOCK.text(name)).values() for field in fields
    }
    assert {kind for kind in needed if '/' in kind} <= set(parse_all(name, STOCK.text(name)))


def installed_descriptions():
    prefixes = [Path(p) for p in os.environ.get('AMENT_PREFIX_PATH', '').split(':') if p]
    return [path for prefix in prefixes for path in prefix.glob('share/*/msg/*.json')]


@pytest.mark.skipif(not installed_descriptions(), reason='no ROS installation is sourced')
def test_every_installed_type_hashes_as_its_own_package_says():
    definitions = Definitions()
    for path in installed_descriptions():
        description = json.loads(path.read_text())
        name = description['type_description_msg']['type_description']['type_name']
        hashes = {item['type_name']: item['hash_string'] for item in description['type_hashes']}
        assert definitions.type_hash(name) == hashes[name]


def test_every_kind_of_field_hashes_as_an_independent_library_says():
    text = '\n'.join(
        [
            'int32 LIMIT=5',
            'string NAME="a # b"',
            'bool flag',
            'byte letter',
            'float32[3] fixed',
            'uint16[<=7] bounded',
            'string<=9 short',
            'string<=9[<=4] shorts',
            'builtin_interfaces/Time[] times',
            'int64 number 7',
            'string word "x"  # a default',
        ]
    )
    name = 'demo_msgs/msg/All'
    types = parse_all(name, text) | {
        'builtin_interfaces/msg/Time': parse_fields(
            BUNDLED['builtin_interfaces/msg/Time'], 'builtin_interfaces'
        )
    }
    store = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
    store.register(typesys.get_types_from_msg(text, name))
    assert type_hash(name, types) == store.hash_rihs01(name)


def test_installed_definitions_come_before_bundled_ones(tmp_path):
    folder = tmp_path / 'share/std_msgs/msg'
    folder.mkdir(parents=True)
    (folder / 'Float64.msg').write_text('# with a comment\nfloat64 data')
    assert (
        Definitions([tmp_path]).text('std_msgs/msg/Float64') == '# with a comment\nfloat64 data\n'
    )


def test_prefixes_come_from_the_environment(tmp_path, monkeypatch):
    folder = tmp_path / 'share/demo_msgs/msg'
    folder.mkdir(parents=True)
    (folder / 'One.msg').write_text('int8 one\n')
    monkeypatch.setenv('AMENT_PREFIX_PATH', f'/nowhere:{tmp_path}')
    assert Definitions().text('demo_msgs/msg/One') == 'int8 one\n'


def test_dependencies_follow_the_separator_in_the_way_of_recordings():
    head, time = STOCK.text('std_msgs/msg/Header').split(f'{SEPARATOR}\n')
    assert 'string frame_id' in head
    assert time.startswith('MSG: builtin_interfaces/Time\n')


@pytest.mark.parametrize(
    'name', ['std_msgs/msg/Nothing', '../../etc/passwd', 'std_msgs', '', 'a/b/c/d', 'x/msg/../y']
)
def test_an_unknown_type_is_one_sentence(name):
    with pytest.raises(RecordingError, match=r'message type .*\.$'):
        STOCK.text(name)


def test_names_are_written_either_way():
    assert full_name('std_msgs/Header') == full_name('std_msgs/msg/Header')
    assert parse_fields('Header header', 'demo_msgs') == (Field('header', 'std_msgs/msg/Header'),)
    assert parse_fields('Other other', 'demo_msgs') == (Field('other', 'demo_msgs/msg/Other'),)


@pytest.mark.parametrize('line', ['float64', 'float64 [3] x', '= 4', 'float64<=x y', 'int8 9x'])
def test_an_unclear_line_is_refused(line):
    with pytest.raises(LayoutError, match='not clear'):
        parse_fields(line, 'demo_msgs')


def plain(value):
    """Turn a message of the other library into what `Decoder` gives."""
    if isinstance(value, np.ndarray):
        return value.tobytes() if value.dtype == np.uint8 else value.tolist()
    if isinstance(value, list):
        return [plain(item) for item in value]
    if hasattr(value, '__dataclass_fields__'):
        names = [name for name in value.__dataclass_fields__ if not name.startswith('__')]
        return {name: plain(getattr(value, name)) for name in names if not name.isupper()}
    return value


NUMBER = st.floats(allow_nan=False)
TEXT = st.text(st.characters(codec='utf-8', exclude_characters='\0'), max_size=12)


@settings(max_examples=100, deadline=None)
@given(data=st.data(), little=st.booleans())
def test_decoding_agrees_with_an_independent_library(data, little):
    name = data.draw(st.sampled_from(['std_msgs/msg/Float64MultiArray', *OWN]))
    store = typestore_of(name)

    def build(kind):
        made = {}
        for field, (node, detail) in store.fielddefs[kind][1]:
            made[field] = value_of(node, detail)
        return store.types[kind](**made)

    def value_of(node, detail):
        if int(node) == 1:
            return scalar(detail[0])
        if int(node) == 2:
            return build(detail)
        inner, _ = detail
        count = data.draw(st.integers(0, 3))
        if int(inner[0]) == 2:
            return [build(inner[1]) for _ in range(count)]
        values = [scalar(inner[1][0]) for _ in range(count)]
        return values if inner[1][0] == 'string' else np.array(values, dtype=inner[1][0])

    def scalar(kind):
        if kind == 'string':
            return data.draw(TEXT)
        if kind == 'bool':
            return data.draw(st.booleans())
        if kind.startswith('float'):
            return data.draw(NUMBER)
        info = np.iinfo(kind)
        return data.draw(st.integers(int(info.min), int(info.max)))

    message = build(name)
    raw = bytes(store.serialize_cdr(message, name, little_endian=little))
    assert Decoder(name, STOCK.text(name)).decode(raw) == plain(message)


@settings(max_examples=300, deadline=None)
@given(raw=st.binary(max_size=200), mark=st.sampled_from([b'\0\0\0\0', b'\0\1\0\0', b'']))
def test_any_bytes_are_a_message_or_one_sentence(raw, mark):
    name = 'std_msgs/msg/Float64MultiArray'
    sentence, message = '', None
    try:
        message = Decoder(name, STOCK.text(name)).decode(mark + raw)
    except RecordingError as error:
        sentence = str(error)
    if message is None:
        assert sentence.startswith('a message of type std_msgs/msg/Float64MultiArray: ')
    else:
        assert set(message) == {'layout', 'data'}


def test_an_endless_array_costs_nothing():
    name = 'std_msgs/msg/Float64MultiArray'
    raw = b'\0\1\0\0' + struct.pack('<III', 0, 0, 2**32 - 1)
    with pytest.raises(RecordingError, match='fewer bytes'):
        Decoder(name, STOCK.text(name)).decode(raw)


def test_a_type_that_holds_itself_is_refused():
    text = f'Node inner\n{SEPARATOR}\nMSG: demo_msgs/Node\nNode inner\n'
    with pytest.raises(RecordingError, match='nested'):
        Decoder('demo_msgs/msg/Top', text).decode(b'\0\1\0\0' + bytes(1000))


def test_an_incomplete_definition_is_refused():
    with pytest.raises(RecordingError, match='missing'):
        Decoder('demo_msgs/msg/Top', 'demo_msgs/Gone gone\n')
