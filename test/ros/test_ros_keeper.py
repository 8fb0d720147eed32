"""What is kept between runs: one owner, whole or not at all, used only where it fits."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from valveflow_ros.errors import DataError, RecordingError
from valveflow_ros.monitoring.events import CurveAdopted
from valveflow_ros.parameters import Settings
from valveflow_ros.ros.diagnostics import Level
from valveflow_ros.ros.node.live import LiveEngine
from valveflow_ros.ros.node.recording import Recording
from valveflow_ros.ros.node.restart import Continuity
from valveflow_ros.ros.node.state_store import (
    ASIDE,
    STATE,
    Keeper,
    StateFolder,
    StateWriter,
    folder_of,
)
from valveflow_ros.ros.node.warmup import made_up_curve
from valveflow_ros.ros.outputs import Outputs
from valveflow_ros.ros.worker.worker import Outcome
from valveflow_ros.state import from_bytes, to_bytes

ENGINE = {'numbers': np.arange(3.0)}


def settings(folder: Path, **more: object) -> Settings:
    return Settings({'record_directory': str(folder), **more})


def written(folder: Path, **more: object) -> None:
    given = settings(folder, **more)
    keeper = Keeper(given)
    nothing = Recording(given.changed({'record': False}), {}, 0.0)
    keeper.write(given, ENGINE, 5, nothing, {})
    keeper.close()


def test_what_is_written_is_found_again_with_the_rights_of_its_owner(tmp_path: Path) -> None:
    written(tmp_path)
    found = Keeper(settings(tmp_path))
    assert found.saved is not None
    assert found.saved['log_ns'] == 5
    np.testing.assert_array_equal(found.saved['engine']['numbers'], ENGINE['numbers'])
    folder = folder_of(settings(tmp_path))
    assert folder is not None
    assert folder.stat().st_mode & 0o777 == 0o700
    assert {p.stat().st_mode & 0o777 for p in folder.iterdir()} == {0o600}
    found.close()


def test_only_one_at_a_time_and_the_next_as_soon_as_it_is_gone(tmp_path: Path) -> None:
    first = Keeper(settings(tmp_path))
    with pytest.raises(RecordingError, match=rf'another monitor \(process {os.getpid()}\)'):
        Keeper(settings(tmp_path))
    Keeper(settings(tmp_path, unit_tag='another')).close()
    Keeper(settings(tmp_path, state_directory=str(tmp_path / 'own'))).close()
    for none in ({'keep_state': False}, {'record': False}):
        keeper = Keeper(settings(tmp_path, **none))
        assert not keeper.on
        keeper.close()
    first.close()
    Keeper(settings(tmp_path)).close()


@pytest.mark.parametrize(
    ('more', 'words'),
    [
        ({'sample_period': 2.0}, 'It was made with another sample_period.'),
        ({'block': 20.0, 'window_days': 5.0}, 'It was made with another window_days and block.'),
        ({'alarm_limit': 3.0, 'refit_period': 60.0}, ''),
        ({'record_keep': 5, 'refit_timeout': 50.0}, ''),
    ],
)
def test_a_state_of_other_parameters_is_used_only_where_they_do_not_matter(
    tmp_path: Path, more: dict[str, float], words: str
) -> None:
    written(tmp_path)
    keeper = Keeper(settings(tmp_path, **more))
    assert (keeper.saved is None) == bool(words)
    assert words in keeper.sentence
    # It waits for a run that it fits.
    assert not keeper.lost
    keeper.close()


def test_a_mistyped_parameter_costs_no_state(tmp_path: Path) -> None:
    written(tmp_path)
    for _ in range(2):
        keeper = Keeper(settings(tmp_path, window_days=5.0))
        assert keeper.saved is None
        assert 'a run that it fits takes it up again' in keeper.sentence
        nothing = Recording(settings(tmp_path).changed({'record': False}), {}, 0.0)
        # A young state takes its place at once.
        keeper.write(
            settings(tmp_path, window_days=5.0), {'numbers': np.arange(1.0)}, 9, nothing, {}
        )
        keeper.close()
        mended = Keeper(settings(tmp_path))
        assert mended.sentence == ''
        assert mended.saved is not None
        np.testing.assert_array_equal(mended.saved['engine']['numbers'], ENGINE['numbers'])
        mended.close()
        # The other one is not lost either.
        again = Keeper(settings(tmp_path, window_days=5.0))
        assert again.saved is not None
        assert len(again.saved['engine']['numbers']) == 1
        again.close()
        written(tmp_path)
        (tmp_path / 'state_unit' / ASIDE).unlink()


@pytest.mark.parametrize('given', ['/proc/nothing', '~nobody_of_that_name/x'])
def test_where_nothing_can_be_saved_the_monitor_goes_on_and_says_so(given: str) -> None:
    keeper = Keeper(Settings({'state_directory': given}))
    assert not keeper.on
    assert keeper.problem.startswith('The state cannot be saved. ')
    assert not keeper.due
    keeper.close()


@pytest.mark.parametrize('how', ['cut', 'flipped', 'empty', 'junk', 'newer', 'folder', 'pipe'])
def test_a_state_that_is_not_whole_is_a_sentence_and_never_an_exception(
    tmp_path: Path, how: str
) -> None:
    written(tmp_path)
    path = tmp_path / 'state_unit' / STATE
    data = path.read_bytes()
    path.unlink()
    if how == 'folder':
        path.mkdir()
    elif how == 'pipe':
        os.mkfifo(path)
    else:
        half = len(data) // 2
        path.write_bytes(
            {
                'cut': data[:-1],
                'flipped': data[:half] + bytes([data[half] ^ 1]) + data[half + 1 :],
                'empty': b'',
                'junk': b'x' * 1000,
                'newer': data.replace(b'state 1 ', b'state 2 ', 1),
            }[how]
        )
    keeper = Keeper(settings(tmp_path))
    assert keeper.saved is None
    assert keeper.sentence.startswith('The state saved by an earlier run is not used. ')
    assert 'alarms and reference of before are gone' in keeper.sentence
    assert keeper.sentence.endswith('.')
    assert keeper.lost
    keeper.close()


def test_a_damaged_state_is_seen_in_the_health_until_the_next_start(tmp_path: Path) -> None:
    written(tmp_path)
    path = tmp_path / 'state_unit' / STATE
    path.write_bytes(path.read_bytes()[:-1])
    for level, words in ((Level.WARN, 'is not used.'), (Level.OK, 'is saved in its time.')):
        ours = Continuity(settings(tmp_path), {}, {}, lambda level, sentence: None)
        item = ours.item()
        assert item.level == level
        assert words in item.sentence
        ours.close()


def test_every_single_cut_and_many_flips_are_noticed() -> None:
    data = to_bytes({'a': [1, 2.5, None, 'text'], 'b': np.arange(5), 'c': {'d': np.eye(2)}})
    assert to_bytes(from_bytes(data)) == data
    for end in range(len(data)):
        with pytest.raises(DataError):
            from_bytes(data[:end])
    chance = np.random.default_rng(3)
    for _ in range(500):
        place, bit = int(chance.integers(len(data))), int(chance.integers(8))
        with pytest.raises(DataError):
            from_bytes(data[:place] + bytes([data[place] ^ 1 << bit]) + data[place + 1 :])


def test_a_state_waits_for_the_recording_and_a_full_disk_is_told(tmp_path: Path) -> None:
    folder = StateFolder(tmp_path / 'state')
    writer = StateWriter(folder)
    asked: list[float] = []

    def ready() -> bool:
        asked.append(time.monotonic())
        return len(asked) > 3

    writer.write(ENGINE, ready)
    writer.finish()
    assert len(asked) == 4
    assert from_bytes(folder.read() or b'')['numbers'].tolist() == [0.0, 1.0, 2.0]
    assert writer.problem == ''
    os.chmod(folder.folder, 0o700)
    folder.path.unlink()
    folder.path.mkdir()
    writer.write(ENGINE, lambda: True)
    writer.finish()
    assert 'the state cannot be saved (is a directory)' in writer.problem
    folder.close()


# Loaded once; each line it reads begins a writer of its own and tells its number.
_WRITES = """
import itertools, os, sys
import numpy as np
from pathlib import Path
from valveflow_ros.state import to_bytes
from valveflow_ros.ros.node.state_store import StateFolder
for line in iter(sys.stdin.readline, ''):
    child = os.fork()
    if child:
        os.waitpid(child, 0)
        os.write(1, b'ended\\n')
        continue
    folder = StateFolder(Path(line[:-1]))
    os.write(1, b'%d\\n' % os.getpid())
    for k in itertools.count(1):
        folder.write(to_bytes({'number': k, 'rows': np.full(200_000, k)}))
        os.write(1, b'%d\\n' % k)
"""


def test_killed_at_any_moment_it_is_the_old_or_the_new_state(tmp_path: Path) -> None:
    chance = np.random.default_rng(1)
    with subprocess.Popen(
        [sys.executable, '-c', _WRITES], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as nursery:
        assert nursery.stdin is not None
        assert nursery.stdout is not None
        for _ in range(8):
            nursery.stdin.write(f'{tmp_path}\n')
            nursery.stdin.flush()
            writer, first = int(nursery.stdout.readline()), int(nursery.stdout.readline())
            time.sleep(float(chance.uniform(0.0, 0.15)))
            os.kill(writer, signal.SIGKILL)
            told = [first, *map(int, iter(nursery.stdout.readline, 'ended\n'))]
            folder = StateFolder(tmp_path)
            state = from_bytes(folder.read() or b'')
            folder.close()
            assert state['number'] in (told[-1], told[-1] + 1)
            assert (state['rows'] == state['number']).all()
            assert not list(tmp_path.glob('.*.tmp'))
        nursery.stdin.close()


def test_a_state_written_while_another_is_being_written_waits_for_it(tmp_path: Path) -> None:
    given = settings(tmp_path)
    keeper = Keeper(given)
    nothing = Recording(given.changed({'record': False}), {}, 0.0)
    for k in range(5):
        keeper.write(given, {'numbers': np.full(300_000, float(k))}, k, nothing, {})
    keeper.close()
    found = Keeper(given)
    assert found.saved is not None
    assert found.saved['log_ns'] == 4
    assert (found.saved['engine']['numbers'] == 4.0).all()
    assert not list((tmp_path / 'state_unit').glob('.*'))
    found.close()


def test_a_curve_is_kept_at_once_and_only_the_last_ones_stay(tmp_path: Path) -> None:
    curve = made_up_curve(Settings())
    curves = [replace(curve, notes=(f'number {k}',)).with_id() for k in range(8)]
    keeper = Keeper(settings(tmp_path))
    for one in curves:
        keeper.note([CurveAdopted(one)])
        assert repr(keeper.curve(one.model_id)) == repr(one)
    assert len(list((tmp_path / 'state_unit').glob('curve_*'))) == 5
    with pytest.raises(DataError, match='was not saved'):
        keeper.curve(curves[0].model_id)
    (tmp_path / 'state_unit' / f'curve_{curves[7].model_id}.json').write_text('{"format": 1}')
    with pytest.raises(DataError, match='was not saved'):
        keeper.curve(curves[7].model_id)
    keeper.close()


def test_nothing_is_saved_before_the_earlier_run_is_gone_on_with(tmp_path: Path) -> None:
    given = settings(tmp_path, state_period=1.0)
    nothing = Recording(given.changed({'record': False}), {}, 0.0)
    ours = Continuity(given, {}, {}, lambda level, sentence: None)
    engine = ours.engine(lambda found: LiveEngine(found, NoWorker()))
    path = tmp_path / 'state_unit' / STATE
    ours.save(given, engine, 1, nothing)
    ours.step(given, engine, 1, nothing)
    assert not path.exists()
    list(ours.begin(given, engine, Outputs('unit')))
    ours.save(given, engine, 1, nothing)
    ours.close()
    assert path.exists()


class NoWorker:
    def submit(self, task: object) -> None:
        raise AssertionError('nothing is to be fitted')

    def poll(self) -> list[Outcome]:
        return []
