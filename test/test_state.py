# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What an object remembers: a copy both ways, in the kinds it had, or a sentence."""

import enum
import hashlib
import io
import json
import os
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as limits
from hypothesis import strategies as st

from valveflow_ros.errors import DataError
from valveflow_ros.state import FORMAT, VERSION, Memory, from_bytes, put_back, to_bytes


class Colour(enum.IntEnum):
    RED = 1
    BLUE = 2


class Place(NamedTuple):
    x: float
    y: float


class Inner(Memory):
    REMEMBERED = ('count',)

    def __init__(self):
        self.count = 0


class Outer(Memory):
    REMEMBERED = ('one', '_two', 'inner', 'colour', 'place', 'ends', 'name', 'perhaps', 'absent')

    def __init__(self):
        self.one, self._two = np.zeros(2), np.zeros((2, 2), dtype=np.int64)
        self.inner, self.colour, self.place = Inner(), Colour.RED, Place(0.0, 0.0)
        self.ends, self.name, self.perhaps, self.absent = (0.0, 0.0), '', None, None


def changed():
    made = Outer()
    made.one += 1.0
    made._two[0, 1] = 7
    made.inner.count = 3
    made.colour, made.place, made.ends = Colour.BLUE, Place(1.0, 2.0), (3.0, 4.0)
    made.name, made.perhaps = 'n', 5
    return made


def test_what_is_remembered_comes_back_in_the_kinds_it_had():
    saved = from_bytes(to_bytes(changed().snapshot()))
    other = Outer()
    array, inner = other.one, other.inner
    other.restore({**saved, 'more': 'is not asked for'})
    assert (array is other.one, inner is other.inner) == (True, True)
    assert (other.one.tolist(), other._two.tolist()) == ([1.0, 1.0], [[0, 7], [0, 0]])
    assert (other.inner.count, other.name, other.perhaps, other.absent) == (3, 'n', 5, None)
    assert (other.colour, type(other.colour)) == (Colour.BLUE, Colour)
    assert (other.place, type(other.place)) == (Place(1.0, 2.0), Place)
    assert other.ends == (3.0, 4.0)
    assert to_bytes(other.snapshot()) == to_bytes(changed().snapshot())
    assert Memory().snapshot() == {}


def test_it_is_a_copy_both_ways():
    made, other = changed(), Outer()
    saved = made.snapshot()
    made.one += 1.0
    other.restore(saved)
    other.one += 5.0
    assert saved['one'].tolist() == [1.0, 1.0]


@pytest.mark.parametrize(
    ('change', 'sentence'),
    [
        ({'one': None}, "lacks 'one'"),
        ({'one': np.zeros(3)}, r"'one' as float64 \(3,\), float64 \(2,\) is wanted"),
        ({'two': np.zeros((2, 2))}, r"'two' as float64 \(2, 2\), int64 \(2, 2\) is wanted"),
        ({'inner': 3}, "'inner' of another kind"),
        ({'inner': {}}, "lacks 'count'"),
        ({'perhaps': {'count': 1}}, "'perhaps' of another kind"),
    ],
)
def test_what_does_not_fit_is_refused_with_a_sentence(change, sentence):
    with pytest.raises(DataError, match=sentence):
        Outer().restore({**changed().snapshot(), **change})


@pytest.mark.parametrize('given', [5, [1.0, 2.0], np.zeros(3), np.zeros(2, dtype=np.int64)])
def test_no_array_is_written_where_one_does_not_fit(given):
    kept = {'first': np.ones(2), 'second': np.ones(2)}
    with pytest.raises(DataError, match="'second'"):
        put_back(kept, {'first': np.zeros(2), 'second': given})
    np.testing.assert_array_equal(kept['first'], [1.0, 1.0])


# --- as bytes ---------------------------------------------------------------------------------

arrays = st.builds(
    lambda kind, shape: (np.arange(np.prod(shape, dtype=int)) % 2).reshape(shape).astype(kind),
    st.sampled_from(['f8', 'i8', 'u1', '?', 'f4']),
    st.lists(st.integers(0, 3), max_size=3).map(tuple),
)
INTEGERS = st.integers(-(2**63), 2**63 - 1)  # nothing in a state counts further
plain = st.one_of(
    st.none(), st.booleans(), INTEGERS, st.floats(allow_nan=False), st.text(), arrays
)
# A mapping of this key alone stands for an array in the file; nothing that is saved has it.
keys = st.text().filter(lambda key: key != '$array')
values = st.recursive(
    plain,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(keys, inner, max_size=4),
)


def same(one, other):
    """Tell whether two values are equal to the type of each number."""
    if isinstance(one, np.ndarray):
        fits = isinstance(other, np.ndarray) and one.dtype == other.dtype
        return fits and one.shape == other.shape and bool(np.array_equal(one, other))
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[k], other[k]) for k in one)
    if isinstance(one, list):
        return len(one) == len(other) and all(map(same, one, other))
    return type(one) is type(other) and one == other


@given(st.dictionaries(keys, values, max_size=5))
@limits(max_examples=30)
def test_every_state_comes_back_and_its_first_line_tells_its_checksum(state):
    data = to_bytes(state)
    found = from_bytes(data)
    assert same(state, found)
    assert to_bytes(found) == data
    line, content = data.split(b'\n', 1)
    # What stands on disks already.
    assert line == b'valveflow-state 2 ' + hashlib.sha256(content).hexdigest().encode()


def signed(content, version=VERSION, name=FORMAT):
    digest = hashlib.sha256(content).hexdigest().encode()
    return name + b' %d ' % version + digest + b'\n' + content


def archived(**more):
    archive = io.BytesIO()
    np.savez(archive, **more)
    return archive.getvalue()


def tree(value):
    return np.frombuffer(json.dumps(value).encode(), dtype=np.uint8)


class Trap:
    """Would be executed by whoever unpickles it."""

    def __reduce__(self):
        return os.mkdir, ('executed',)


TRAP = np.array([Trap()], dtype=object)


NO_STATES = [
    (b'', 'is none, or its beginning is damaged'),
    (signed(b'', name=b'other-state'), 'is none, or its beginning is damaged'),
    (FORMAT + b' 1 abc\n', 'is none, or its beginning is damaged'),
    (FORMAT + b' 2 ' + b'0' * 64 + b'\nwhatever', 'its checksum is another one'),
    (signed(b'', version=3), 'has version 3, this program reads 2'),
    (signed(b'', version=1), r'cannot be read \('),
    (FORMAT + b' ' + b'9' * 50 + b' ' + b'0' * 64 + b'\n', f'version {"9" * 20}, this'),
    (FORMAT + b' \xff ' + b'0' * 64 + b'\n', 'version \ufffd, this'),
    (signed(b'no archive'), r'cannot be read \('),
    (signed(archived(other=tree({}))), r'cannot be read \(KeyError\)'),
    (signed(archived(tree=np.zeros(3, dtype=np.uint8))), r'cannot be read \('),
    # Nothing in a state is executed, however well it is signed.
    (signed(archived(tree=tree({'x': {'$array': 0}}), a0=TRAP)), 'cannot be read'),
    (signed(archived(tree=TRAP)), 'cannot be read'),
    (signed(archived(tree=tree([1]))), 'The saved state is none'),
    (signed(archived(tree=tree(None))), 'The saved state is none'),
    (to_bytes({'$array': 5}), r'cannot be read \(KeyError\)'),
]


def test_what_is_no_state_is_a_sentence(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for data, sentence in NO_STATES:
        with pytest.raises(DataError, match=sentence):
            from_bytes(data)
    assert list(tmp_path.iterdir()) == []


def test_every_single_cut_and_many_flips_are_noticed():
    data = to_bytes({'a': [1, 2.5, None, 'text'], 'b': np.arange(5), 'c': {'d': np.eye(2)}})
    for end in range(len(data)):
        with pytest.raises(DataError):
            from_bytes(data[:end])
    chance = np.random.default_rng(3)
    for _ in range(200):
        place, bit = int(chance.integers(len(data))), int(chance.integers(8))
        with pytest.raises(DataError):
            from_bytes(data[:place] + bytes([data[place] ^ 1 << bit]) + data[place + 1 :])


def test_numbers_of_numpy_and_tuples_come_back_as_plain_ones():
    state = {'number': np.float64(1.5), 'true': np.bool_(True), 'tuple': (1, 2), 'nan': np.nan,
             'table': {'$array': 0, 'y': 1}}  # fmt: skip
    found = from_bytes(to_bytes(state))
    assert np.isnan(found.pop('nan'))
    assert found == {'number': 1.5, 'true': True, 'tuple': [1, 2], 'table': state['table']}
