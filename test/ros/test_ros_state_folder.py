"""The folder of the state where it is not as it should be."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from valveflow_ros.errors import DataError, RecordingError
from valveflow_ros.logs.mcap import recorder
from valveflow_ros.parameters import Settings
from valveflow_ros.ros.node import state_store
from valveflow_ros.ros.node.state_store import STATE, InUseError, Keeper, StateFolder, StateWriter
from valveflow_ros.ros.node.warmup import made_up_curve
from valveflow_ros.state import from_bytes, put_back, to_bytes

CURVE = made_up_curve(Settings()).with_id()


def test_a_file_that_is_too_large_is_not_even_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = StateFolder(tmp_path)
    monkeypatch.setattr(state_store, '_MOST_BYTES', 3)
    folder.write(b'123')
    assert folder.read() == b'123'
    folder.write(b'1234')
    with pytest.raises(RecordingError, match='too large to be a saved state'):
        folder.read()
    folder.close()


def test_a_state_in_the_place_of_something_else_is_a_sentence(tmp_path: Path) -> None:
    folder = StateFolder(tmp_path)
    (tmp_path / 'elsewhere').write_bytes(b'somebody else keeps this')
    (tmp_path / STATE).symlink_to(tmp_path / 'elsewhere')
    with pytest.raises(RecordingError, match='cannot be read'):
        folder.read()
    # A new one takes the place of the link, not of what it points to.
    folder.write(b'mine')
    assert (folder.read(), (tmp_path / 'elsewhere').read_bytes()) == (
        b'mine',
        b'somebody else keeps this',
    )
    folder.close()


def test_closing_twice_lets_nobody_elses_descriptor_go(tmp_path: Path) -> None:
    folder = StateFolder(tmp_path)
    folder.close()
    other = os.open(tmp_path / 'lock', os.O_RDONLY)
    folder.close()
    os.fstat(other)
    os.close(other)
    again = StateFolder(tmp_path)
    with pytest.raises(InUseError):
        StateFolder(tmp_path)
    again.close()


def test_a_curve_under_anothers_name_is_not_that_curve(tmp_path: Path) -> None:
    folder = StateFolder(tmp_path)
    folder.keep_curve(CURVE)
    assert folder.curve(CURVE.model_id).model_id == CURVE.model_id
    kept = tmp_path / f'curve_{CURVE.model_id}.json'
    shutil.copy(kept, tmp_path / 'curve_other.json')
    for name in ('other', 'never_there'):
        with pytest.raises(DataError, match=f'Curve {name} was not saved'):
            folder.curve(name)
    kept.write_text('{"half": ')
    with pytest.raises(DataError, match='was not saved'):
        folder.curve(CURVE.model_id)
    folder.close()


def test_a_curve_that_cannot_be_kept_is_in_the_state_that_follows(tmp_path: Path) -> None:
    folder = StateFolder(tmp_path / 'state')
    shutil.rmtree(tmp_path / 'state')
    folder.keep_curve(CURVE)
    folder.close()
    assert not (tmp_path / 'state').exists()


def test_what_a_killed_writer_left_goes_at_the_next_start(tmp_path: Path) -> None:
    StateFolder(tmp_path).close()
    (tmp_path / '.monitor.state.1.2.tmp').write_bytes(b'half')
    (tmp_path / 'monitor.state').write_bytes(b'whole')
    folder = StateFolder(tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ['lock', 'monitor.state']
    folder.close()


def test_an_error_nobody_thought_of_is_a_problem_and_the_next_write_mends_it(
    tmp_path: Path,
) -> None:
    folder = StateFolder(tmp_path)
    writer = StateWriter(folder)
    writer.finish()
    assert (writer.busy, writer.saved_s) == (False, None)
    broken: dict[str, Any] = {'cannot be saved': object()}
    writer.write(broken, lambda: True)
    writer.finish()
    assert 'The state cannot be saved (TypeError' in writer.problem
    assert writer.saved_s is None
    assert folder.read() is None
    writer.write({'fine': 1}, lambda: True)
    writer.finish()
    assert writer.problem == ''
    assert writer.saved_s is not None
    assert from_bytes(folder.read() or b'') == {'fine': 1}
    folder.close()


def test_where_nothing_is_kept_nothing_is_asked_of_a_disk() -> None:
    keeper = Keeper(Settings({'record': False}))
    assert (keeper.on, keeper.problem, keeper.age_s, keeper.due) == (False, '', None, False)
    with pytest.raises(DataError, match='Curve abc was not saved'):
        keeper.curve('abc')
    keeper.close()


def test_the_age_of_a_state_counts_from_when_it_was_in_place(tmp_path: Path) -> None:
    keeper = Keeper(Settings({'record_directory': str(tmp_path)}))
    assert keeper.age_s is None
    keeper.close()
    assert keeper.age_s is None


@pytest.mark.parametrize('content', [[1, 2], 'text', 5, None])
def test_a_state_is_a_table_of_names(content: Any) -> None:
    with pytest.raises(DataError, match='The saved state is none'):
        from_bytes(to_bytes(content))


def test_arrays_and_numbers_of_numpy_come_back_as_they_were() -> None:
    state = {
        'array': np.arange(6.0).reshape(2, 3), 'number': np.float64(1.5), 'whole': np.int64(7),
        'true': np.bool_(True), 'list': [np.zeros(0), {'deep': np.ones(2, dtype=np.uint8)}],
        'tuple': (1, 2), 'nan': float('nan'),
    }  # fmt: skip
    found = from_bytes(to_bytes(state))
    np.testing.assert_array_equal(found['array'], state['array'])
    assert (found['number'], found['whole'], found['true']) == (1.5, 7, True)
    assert found['list'][0].shape == (0,)
    assert found['list'][1]['deep'].dtype == np.uint8
    assert found['tuple'] == [1, 2]
    assert np.isnan(found['nan'])


def test_a_state_that_names_an_array_it_does_not_hold_is_a_sentence() -> None:
    with pytest.raises(DataError, match=r'cannot be read \(KeyError\)'):
        from_bytes(to_bytes({'$array': 5}))


@pytest.mark.parametrize('given', [5, None, [1.0, 2.0], np.zeros(3), np.zeros(2, dtype=np.int64)])
def test_what_does_not_fit_an_array_changes_nothing(given: Any) -> None:
    arrays = {'first': np.ones(2), 'second': np.ones(2)}
    with pytest.raises(DataError, match="'second'"):
        put_back(arrays, {'first': np.zeros(2), 'second': given})
    np.testing.assert_array_equal(arrays['first'], [1.0, 1.0])


def test_free_space_is_that_of_the_folders_disk(tmp_path: Path) -> None:
    assert recorder.free_bytes_of(tmp_path) == pytest.approx(
        shutil.disk_usage(tmp_path).free, rel=0.2
    )
    with pytest.raises(OSError, match='No such file'):
        recorder.free_bytes_of(tmp_path / 'gone')
