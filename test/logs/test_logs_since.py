"""The end of a recording, against the slow truth of reading all of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from log_files import FLOAT64, START_NS, STOCK, float64

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs import RecordingWriter, messages_since, open_log

N = 900


@pytest.fixture(scope='module')
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of four splits, the last one unfinished."""
    made = tmp_path_factory.mktemp('since') / 'recording'
    writer = RecordingWriter(made, definitions=STOCK)
    for topic in ('/a', '/b'):
        writer.add_topic(topic, FLOAT64)
    for k in range(N):
        writer.write(('/a', '/b')[k % 2], float64(k), START_NS + k, START_NS + 2 * k)
        if k % 200 == 199 and k < 700:
            writer.rotate()
    writer.flush()
    writer.abandon()
    assert len(list(made.glob('*.mcap'))) == 3
    assert len(list(made.glob('*.part'))) == 1
    return made


def test_it_is_what_a_reader_of_everything_finds_after_the_moment(folder: Path) -> None:
    everything = list(open_log(folder).iter_messages())
    assert len(everything) == N
    for after in [0, START_NS - 1, *(START_NS + k for k in range(0, N, 37)), START_NS + N - 1]:
        expected = [m for m in everything if m.log_time_ns > after]
        assert list(messages_since(folder, after)) == expected


def test_old_splits_are_not_even_opened(folder: Path, tmp_path: Path) -> None:
    for path in folder.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    oldest = sorted(tmp_path.glob('*.mcap'))[0]
    oldest.write_bytes(b'damaged' * 100)
    found = [m.log_time_ns for m in messages_since(tmp_path, START_NS + 500)]
    np.testing.assert_array_equal(found, START_NS + np.arange(501, N))


def test_a_folder_that_is_not_there_is_a_sentence_and_an_empty_one_gives_nothing(
    tmp_path: Path,
) -> None:
    assert list(messages_since(tmp_path, 0)) == []
    with pytest.raises(RecordingError, match='cannot be read'):
        list(messages_since(tmp_path / 'gone', 0))
