# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What was compiled before is used again only while nothing that it was made of has changed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from streams import needs_jit

pytestmark = needs_jit
INNER = """
from valveflow_ros.numerics import inlined

@inlined
def step(x):
    return x + {step}
"""
OUTER = """
from typing import NamedTuple
import numpy as np
from inner import step
from valveflow_ros.numerics import jit

class {name}(NamedTuple):
    x: np.ndarray

@jit
def run(state):
    return step(state.x[0])

print(run({name}(np.ones(1))), sum(run.stats.cache_hits.values()))
"""


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


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write(tmp_path / 'inner.py', INNER.format(step=1.0), 1e9)
    write(tmp_path / 'outer.py', OUTER.format(name='State'), 1e9)
    assert run(tmp_path) == ['2.0', '0']
    assert run(tmp_path) == ['2.0', '1'], 'it is kept'
    return tmp_path


def test_a_change_in_a_file_that_is_called_counts(folder: Path) -> None:
    (folder / 'inner.py').write_text(INNER.format(step=5.0))
    assert run(folder) == ['6.0', '0']
    assert run(folder) == ['6.0', '1']


def test_a_type_of_another_name_is_no_error(folder: Path) -> None:
    write(folder / 'outer.py', OUTER.format(name='Renamed'), 2e9)
    assert run(folder)[0] == '2.0'
    assert run(folder) == ['2.0', '1']


def test_a_file_from_the_future_is_not_compiled_at_each_start(folder: Path) -> None:
    os.utime(folder / 'inner.py', (4e9, 4e9))
    assert run(folder) == ['2.0', '1']
