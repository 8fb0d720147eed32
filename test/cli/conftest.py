# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Logs to run the command on, and a way to run it in this process."""

import io
import json
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace

import pytest
from curves import curve

from valveflow_ros.cli.main import main
from valveflow_ros.curve.characteristic import RegionDynamics
from valveflow_ros.curve.characteristic_json import to_json

# The curve and the dynamics of the paper's plant.
KNOTS, SLOPES = (1000.0, 1250.0, 1600.0, 1900.0, 2600.0), (0.24, 0.18, 0.09, 0.01)
REGIONS = (
    RegionDynamics(100.0, 240.0, 10.0, 3.0, 1.0, 1.0),
    RegionDynamics(240.0, 320.0, 80.0, 10.0, 1.0, 1.0),
)


@dataclass(frozen=True)
class Ran:
    """What one run of the command left."""

    status: int
    out: str
    err: str

    def done(self):
        """Assert that it was done; return it."""
        assert self.status == 0, self.err
        return self

    @property
    def json(self):
        def refuse(word):
            raise AssertionError(f'{word} is no JSON')

        return json.loads(self.done().out, parse_constant=refuse)

    def refused(self, status=1):
        """Assert that it was refused with one sentence (or a list below one); return it."""
        assert self.status == status, self.err
        assert self.out == ''
        assert 'Traceback' not in self.err
        lines = self.err.rstrip('\n').splitlines()
        listed = [k for k, line in enumerate(lines) if line.startswith('valveflow: ')]
        assert listed, self.err
        said = lines[listed[-1] :]
        first = said[0]
        assert first.endswith(('.', '?', '"') if len(said) == 1 else ('.', ':')), first
        # What follows is a list, or a command in a line of its own.
        assert all(line.startswith(('  ', 'Then this', 'Add ')) for line in said[1:]), said
        text = '\n'.join(said)
        assert 'nan' not in text.split()
        return text


Run = Callable[..., Ran]


def run_command(*words):
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        status = main([str(word) for word in words])
    return Ran(status, out.getvalue(), err.getvalue())


@pytest.fixture(scope='session')
def run():
    return run_command


@pytest.fixture(scope='session')
def logs(run, tmp_path_factory):
    """Return a folder with one log as plant.csv, .parquet and .mcap, and other days.

    Ten hours are long enough for a curve of several pieces, short enough for a test.
    """
    folder = tmp_path_factory.mktemp('logs')
    for name in ('plant.csv', 'plant.parquet', 'plant.mcap', 'other.mcap'):
        seed = 2 if name == 'other.mcap' else 1
        run('simulate', '-o', folder / name, '--days', '0.4', '--seed', seed).done()
    return folder


@pytest.fixture(scope='session')
def identification(run, logs, tmp_path_factory):
    """Return what identify said of plant.csv, and its folder."""
    folder = tmp_path_factory.mktemp('identified')
    return run('identify', logs / 'plant.csv', '-o', folder).done(), folder


@pytest.fixture(scope='session')
def identified(identification):
    return identification[1] / 'characteristic.json'


@pytest.fixture
def write_csv(tmp_path):
    def write(header, rows):
        path = tmp_path / 'history.csv'
        path.write_text('\n'.join([header, *rows]) + '\n', encoding='utf-8')
        return path

    return write


@pytest.fixture
def model(tmp_path):
    """Return a writer of curves as files: knots, slopes, and any field of a characteristic."""

    def write(
        name='model.json', knots=KNOTS, slopes=SLOPES, start=140.0, **fields
    ):  # fmt: skip
        made = curve(knots, slopes, start=start, stderr=5e-4, samples=5000)
        content = to_json(replace(made, dynamics=REGIONS, **fields))
        path = tmp_path / name
        path.write_text(json.dumps(content), encoding='utf-8')
        return path

    return write
