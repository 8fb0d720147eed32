# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Definitions, their hashes, and messages decoded by them, against an independent library."""

import json
import os
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from log_files import FLOAT64, STOCK

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
ARRAY = 'std_msgs/msg/Float64MultiArray'
LITTLE = b'\0\1\0\0'


@pytest.fixture(scope='module')
def store():
    """Return the types that the other library has, and ours as it reads them."""
    made = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
    for name in (*BUNDLED, *OWN):
        fresh = typesys.get_types_from_msg(STOCK.text(name), name)
        made.register({key: fields for key, fields in fresh.items() if key not in made.fielddefs})
    return made


def test_definitions_hash_as_an_independent_library_says(store):
    for name in (*BUNDLED, *OWN):
        assert STOCK.type_hash(name) == store.hash_rihs01(name)


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


def test_every_kind_of_field_hashes_as_an_independent_library_says(store):
    text = """
int32 LIMIT=5
string NAME="a # b"
bool flag
byte letter
float32[3] fixed
uint16[<=7] bounded
string<=9 short
string<=9[<=4] shorts
builtin_interfaces/Time[] times
int64 number 7
string word "x"  # a default
"""
    name, time = 'demo_msgs/msg/All', 'builtin_interfaces/msg/Time'
    types = parse_all(name, text) | {time: parse_fields(BUNDLED[time], 'builtin_interfaces')}
    store.register(typesys.get_types_from_msg(text, name))
    assert type_hash(name, types) == store.hash_rihs01(name)


def test_installed_definitions_come_before_bundled_ones(tmp_path, monkeypatch):
    folder = tmp_path / 'share/std_msgs/msg'
    folder.mkdir(parents=True)
    (folder / 'Float64.msg').write_text('# with a comment\nfloat64 data')
    monkeypatch.setenv('AMENT_PREFIX_PATH', f'/nowhere:{tmp_path}')
    for definitions in (Definitions([tmp_path]), Definitions()):
        assert definitions.text(FLOAT64) == '# with a comment\nfloat64 data\n'


def test_names_are_written_either_way():
    assert full_name('std_msgs/Header') == full_name('std_msgs/msg/Header')
    assert parse_fields('Header header', 'demo_msgs') == (Field('header', 'std_msgs/msg/Header'),)
    assert parse_fields('Other other', 'demo_msgs') == (Field('other', 'demo_msgs/msg/Other'),)


def test_an_unknown_type_and_an_unclear_line_are_refused():
    for name in (
        'std_msgs/msg/Nothing', '../../etc/passwd', 'std_msgs', '', 'a/b/c/d', 'x/msg/../y'
    ):  # fmt: skip
        with pytest.raises(RecordingError, match=r'message type .*\.$'):
            STOCK.text(name)
    for line in ('float64', 'float64 [3] x', '= 4', 'float64<=x y', 'int8 9x'):
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


SCALARS = {
    'string': st.text(st.characters(codec='utf-8', exclude_characters='\0'), max_size=12),
    'bool': st.booleans(),
    'float32': st.floats(allow_nan=False),
    'float64': st.floats(allow_nan=False),
}


def scalar(kind):
    if kind in SCALARS:
        return SCALARS[kind]
    info = np.iinfo(kind)
    return st.integers(int(info.min), int(info.max))


@settings(max_examples=50)
@given(data=st.data(), little=st.booleans())
def test_decoding_agrees_with_an_independent_library(store, data, little):
    name = data.draw(st.sampled_from([ARRAY, *OWN]))

    def build(kind):
        fields = store.fielddefs[kind][1]
        return store.types[kind](**{field: value_of(*what) for field, what in fields})

    def value_of(node, detail):
        if int(node) == 1:
            return data.draw(scalar(detail[0]))
        if int(node) == 2:
            return build(detail)
        inner, _ = detail
        values = [value_of(*inner) for _ in range(data.draw(st.integers(0, 3)))]
        listed = int(inner[0]) == 2 or inner[1][0] == 'string'
        return values if listed else np.array(values, dtype=inner[1][0])

    message = build(name)
    raw = bytes(store.serialize_cdr(message, name, little_endian=little))
    assert Decoder(name, STOCK.text(name)).decode(raw) == plain(message)


@settings(max_examples=300)
@given(raw=st.binary(max_size=200), mark=st.sampled_from([b'\0\0\0\0', LITTLE, b'']))
def test_any_bytes_are_a_message_or_one_sentence(raw, mark):
    try:
        message = Decoder(ARRAY, STOCK.text(ARRAY)).decode(mark + raw)
    except RecordingError as error:
        assert str(error).startswith(f'a message of type {ARRAY}: ')
    else:
        assert set(message) == {'layout', 'data'}


NODES = f'Node inner\n{SEPARATOR}\nMSG: std_msgs/Node\nNode inner\n'


def test_what_cannot_be_decoded_is_one_sentence():
    for text, raw, why in (
        (STOCK.text(ARRAY), LITTLE + struct.pack('<III', 0, 0, 2**32 - 1), 'fewer bytes'),
        (NODES, LITTLE + bytes(1000), 'nested'),
        ('demo_msgs/Gone gone\n', LITTLE, 'missing'),
        ('float64 data', b'\x07\x00\x00\x00', 'not plain CDR'),
        ('wstring text', LITTLE + bytes(8), 'wstring'),
    ):
        with pytest.raises(RecordingError, match=why):
            Decoder('std_msgs/msg/A', text).decode(raw)
    # A message without fields is one byte.
    assert Decoder('a/msg/A', '').decode(LITTLE + b'\0') == {}
