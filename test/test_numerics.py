# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Work on several cores, and compiled code: used again while nothing that it is of changes."""

import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from streams import needs_jit

from valveflow_ros import numerics
from valveflow_ros.numerics import read_ahead, run_in_threads


@pytest.fixture(params=[1, 4])
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


def test_items_made_ahead_are_the_same_in_the_same_order_up_to_an_error(on_cores):
    seen = []
    assert list(read_ahead(numbers(50, seen))) == list(range(50))
    assert (threading.current_thread() in seen) == (on_cores == 1)
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


@pytest.mark.parametrize('count', [1, 2, 7])
def test_every_task_is_done_once_and_an_error_is_raised(count):
    done = []
    run_in_threads(done.append, [(k,) for k in range(20)], count)
    assert sorted(done) == list(range(20))
    with pytest.raises(ValueError, match='seven'):
        run_in_threads(lambda k: int('seven') if k == 7 else None, [(k,) for k in range(9)], count)
    # For one task no thread is started.
    run_in_threads(lambda: done.append(threading.current_thread()), [()], count)
    assert done[-1] is threading.current_thread()


def test_tasks_that_start_threads_share_them_and_give_them_back():
    before, seen = threading.active_count(), []

    def inner(a, b):
        seen.append((a, b, threading.active_count() - before))

    def outer(a):
        run_in_threads(lambda b: inner(a, b), [(b,) for b in range(6)], 3)

    for _ in range(3):
        run_in_threads(outer, [(a,) for a in range(6)], 3)
    assert sorted(s[:2] for s in seen) == sorted(3 * [(a, b) for a in range(6) for b in range(6)])
    assert max(s[2] for s in seen) <= 2
    assert numerics.each_in_threads(str, range(9)) == list('012345678')
    started = []
    barrier = threading.Barrier(3, timeout=10.0)
    run_in_threads(lambda k: started.append((k, barrier.wait())), [(k,) for k in range(3)], 3)
    assert len(started) == 3  # three at once again


# --- compiled code ---------------------------------------------------------------------------

HOW = ('inlined', 'helper', 'copied')
INNER = 'from valveflow_ros.numerics import inlined, helper, copied\n' + ''.join(
    f'@{how}\ndef {how}_step(x):\n    return x + {{step}}\n' for how in HOW
)
OUTER = """
from typing import NamedTuple
import numpy as np
from inner import inlined_step, helper_step, copied_step
from valveflow_ros.numerics import jit

class {name}(NamedTuple):
    x: np.ndarray
""" + ''.join(
    f"""
@jit
def run_{how}(state):
    return {how}_step(state.x[0])

print(run_{how}({{name}}(np.ones(1))), sum(run_{how}.stats.cache_hits.values()))
"""
    for how in HOW
)


def write(path: Path, text: str, at_s: float) -> None:
    path.write_text(text)
    os.utime(path, (at_s, at_s))


def run(folder: Path) -> list[str]:
    environment = {**os.environ, 'NUMBA_CACHE_DIR': str(folder / 'cache')}
    done = subprocess.run(
        [sys.executable, '-B', '-c', 'import outer'], cwd=folder, env=environment,
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    return done.stdout.split()


@needs_jit
def test_what_was_compiled_is_used_until_something_that_it_is_made_of_changes(tmp_path):
    inner, outer = tmp_path / 'inner.py', tmp_path / 'outer.py'
    write(inner, INNER.format(step=1.0), 1e9)
    write(outer, OUTER.format(name='State'), 1e9)
    assert run(tmp_path) == ['2.0', '0'] * 3
    os.utime(inner, (4e9, 4e9))
    assert run(tmp_path) == ['2.0', '1'] * 3, 'it is kept, although a file is from the future'
    inner.write_text(INNER.format(step=5.0))
    assert run(tmp_path) == ['6.0', '0'] * 3, 'a file that is called has changed'
    write(outer, OUTER.format(name='Renamed'), 2e9)
    assert run(tmp_path)[::2] == ['6.0'] * 3, 'a type of another name is no error'
    assert run(tmp_path) == ['6.0', '1'] * 3
