# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import threading

import pytest

from valveflow_ros import numerics
from valveflow_ros.numerics import read_ahead, run_in_threads


@pytest.fixture(params=[1, 2, 4])
def on_cores(request, monkeypatch):
    monkeypatch.setattr(numerics, 'cores', lambda: request.param)
    return request.param


@pytest.mark.parametrize(('told', 'most'), [('1', 1), ('', 64), ('0', 1), ('nonsense', 64)])
def test_numbas_limit_is_ours(monkeypatch, told, most):
    monkeypatch.setattr(numerics.os, 'sched_getaffinity', lambda _: set(range(64)), raising=False)
    monkeypatch.setenv('NUMBA_NUM_THREADS', told)
    assert numerics.cores() == most


def numbers(n, seen, wrong_at=None):
    for k in range(n):
        seen.append(threading.current_thread())
        if k == wrong_at:
            raise ValueError(f'number {k}')
        yield k


def test_items_made_ahead_are_the_same_in_the_same_order(on_cores):
    seen = []
    assert list(read_ahead(numbers(50, seen))) == list(range(50))
    assert (threading.current_thread() in seen) == (on_cores == 1)


def test_an_error_comes_behind_what_was_made_before_it(on_cores):
    items = read_ahead(numbers(50, [], wrong_at=5))
    assert [next(items) for _ in range(5)] == [0, 1, 2, 3, 4]
    with pytest.raises(ValueError, match='number 5'):
        next(items)


def test_no_more_is_made_ahead_than_asked_for_and_who_stops_early_ends_the_thread(on_cores):
    seen = []
    before = threading.active_count()
    items = read_ahead(numbers(1000, seen), depth=3)
    assert [next(items) for _ in range(4)] == [0, 1, 2, 3]
    items.close()
    makers = {t for t in seen if t is not threading.current_thread()}
    for maker in makers:
        maker.join(10.0)
    assert not any(maker.is_alive() for maker in makers)
    assert threading.active_count() == before
    # Four were taken, three may wait, one may stand in the door.
    assert len(seen) <= 8


def test_every_task_is_done_once_whatever_the_threads():
    for count in (1, 2, 7):
        done, lock = [], threading.Lock()

        def work(k, done=done, lock=lock):
            with lock:
                done.append(k)

        run_in_threads(work, [(k,) for k in range(20)], count)
        assert sorted(done) == list(range(20))


def test_no_thread_is_started_for_which_there_is_no_task():
    names = set()
    run_in_threads(lambda: names.add(threading.current_thread()), [()], 8)
    assert names == {threading.current_thread()}


def test_the_error_of_a_task_is_raised():
    with pytest.raises(ValueError, match='seven'):
        run_in_threads(lambda k: int('seven') if k == 7 else None, [(k,) for k in range(9)], 3)
