"""Logs to run the command on, and a way to run it in this process."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from valveflow_ros.cli.main import main

# Long enough for a curve of several pieces, short enough for a test.
DAYS, SEED = '0.4', '1'


@dataclass(frozen=True)
class Ran:
    """What one run of the command left."""

    status: int
    out: str
    err: str

    @property
    def json(self) -> dict[str, Any]:
        def refuse(word: str) -> None:
            raise AssertionError(f'{word} is no JSON')

        content: dict[str, Any] = json.loads(self.out, parse_constant=refuse)
        return content

    def refused(self, status: int = 1) -> str:
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


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    def command(*words: object) -> Ran:
        capsys.readouterr()
        status = main([str(word) for word in words])
        out, err = capsys.readouterr()
        return Ran(status, out, err)

    return command


@pytest.fixture(scope='session')
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with one simulated log as plant.csv, plant.parquet and plant.mcap."""
    folder = tmp_path_factory.mktemp('logs')
    for name in ('plant.csv', 'plant.parquet', 'plant.mcap'):
        words = ['simulate', '-o', str(folder / name), '--days', DAYS, '--seed', SEED, '--quiet']
        assert main(words) == 0
    return folder


@pytest.fixture(scope='session')
def identified(logs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the characteristic.json of the simulated log."""
    folder = tmp_path_factory.mktemp('identified')
    assert main(['identify', str(logs / 'plant.csv'), '-o', str(folder), '--quiet']) == 0
    return folder / 'characteristic.json'


@pytest.fixture(scope='session')
def shared_data() -> Path:
    """Return the folder of measured data that are not part of the project."""
    place = os.environ.get('VALVEFLOW_SHARED_DATA')
    folder = Path(place) if place else Path(__file__).resolve().parents[3] / 'shared' / 'data'
    if not folder.is_dir():
        pytest.skip(f'no measured data at {folder}; VALVEFLOW_SHARED_DATA names another place')
    return folder


@pytest.fixture
def write_csv(tmp_path: Path) -> Callable[[str, list[str]], Path]:
    def write(header: str, rows: list[str]) -> Path:
        path = tmp_path / 'history.csv'
        path.write_text('\n'.join([header, *rows]) + '\n', encoding='utf-8')
        return path

    return write
