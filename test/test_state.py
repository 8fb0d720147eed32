# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What an object remembers: a copy both ways, in the kinds it had, or a sentence."""

from __future__ import annotations

import enum
from typing import NamedTuple

import numpy as np
import pytest

from valveflow_ros.errors import DataError
from valveflow_ros.state import Memory, from_bytes, put_back, to_bytes


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


def test_no_array_is_written_where_one_does_not_fit():
    arrays = {'first': np.zeros(2), 'second': np.zeros(2)}
    with pytest.raises(DataError, match="'second'"):
        put_back(arrays, {'first': np.ones(2), 'second': np.ones(3)})
    assert arrays['first'].tolist() == [0.0, 0.0]
