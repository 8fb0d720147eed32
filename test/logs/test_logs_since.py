# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The end of a recording, against the slow truth of reading all of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from log_files import FLOAT64, START_NS, STOCK, float64

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs import LogContents, RecordingWriter, messages_since, open_log
from valveflow_ros.logs.mcap import reading
from valveflow_ros.logs.mcap.folder import Split, finished_files
from valveflow_ros.logs.mcap.writer import Message

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


def latched_folder(made: Path, shut: bool) -> Path:
    """A recording whose splits begin with what stands on two latched topics, one told but once."""
    latched: dict[str, Message] = {}
    fresh: dict[str, Message] = {}
    writer = RecordingWriter(made, definitions=STOCK, head_messages=lambda: latched.values())
    for topic in ('/once', '/now_and_then', '/often'):
        writer.add_topic(topic, FLOAT64)
    for k in range(N):
        topic = '/once' if k == 7 else '/now_and_then' if k % 90 == 3 else '/often'
        message = Message(topic, float64(k), START_NS + k, START_NS + 2 * k)
        writer.write(*message)
        if topic != '/often':
            fresh[topic] = message
        if k % 150 == 149:
            # Only what stands in a split already is a repetition in the next.
            writer.flush()
            latched.update(fresh)
            writer.rotate()
    if shut:
        writer.close()
    else:
        writer.flush()
        writer.abandon()
    return made


@pytest.mark.parametrize('shut', [True, False])
def test_what_a_split_repeats_at_its_head_is_not_news(tmp_path: Path, shut: bool) -> None:
    made = latched_folder(tmp_path / 'recording', shut)
    # What stands in the files beside the originals: the repetitions are there to be told apart.
    splits = [s for s in map(Split.read, finished_files(made)) if s is not None]
    assert sum(split.counts['/once'] for split in splits) == len(splits) > 3
    for after in range(START_NS - 1, START_NS + N, 29):
        found = [int(m.log_time_ns) for m in messages_since(made, after)]
        np.testing.assert_array_equal(found, np.arange(max(after + 1, START_NS), START_NS + N))


def test_a_split_that_is_finished_while_it_is_looked_for_is_read_under_its_new_name(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for path in folder.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    read = reading.read_recording
    tries: list[list[Path]] = []

    def finished_meanwhile(wanted: list[Path], *more: Any) -> LogContents:
        tries.append(wanted)
        for part in tmp_path.glob('*.part'):
            part.rename(part.with_suffix(''))
        return read(wanted, *more)

    monkeypatch.setattr(reading, 'read_recording', finished_meanwhile)
    found = [m.log_time_ns for m in messages_since(tmp_path, START_NS + 500)]
    np.testing.assert_array_equal(found, START_NS + np.arange(501, N))
    assert len(tries) == 2


def test_a_file_that_cannot_be_read_and_stays_is_said_at_once(tmp_path: Path) -> None:
    (tmp_path / 'recording_0.mcap').write_bytes(b'nothing of the kind')
    with pytest.raises(RecordingError, match=r'recording_0\.mcap'):
        list(messages_since(tmp_path, 0))


def test_the_definitions_of_what_follows_are_told(tmp_path):
    with RecordingWriter(tmp_path, definitions=STOCK) as writer:
        writer.add_topic('/a', FLOAT64)
        writer.write('/a', float64(1.0), START_NS, START_NS)
    found = {}
    assert len(list(messages_since(tmp_path, 0, found))) == 1
    assert found == {'/a': STOCK.text(FLOAT64)}
