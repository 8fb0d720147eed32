# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A recording is followed while it grows, and its end is read alone: every message once."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from log_files import FLOAT64, START_NS, STOCK, float64
from mcap.opcode import Opcode
from monitor_recording import Monitor, recording

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs import Message, RecordingWriter, messages_since, open_log
from valveflow_ros.logs.mcap import reading
from valveflow_ros.logs.mcap.folder import Split, finished_files
from valveflow_ros.logs.mcap.follow import Follower
from valveflow_ros.logs.mcap.scan import candidates
from valveflow_ros.logs.source import Source

DAY_NS = 24 * 3600 * 10**9
N = 900


def times(follower):
    """Return what a follower has not given before, as topic and log time."""
    return [
        (batch.topics.channels[channel].topic, log_time)
        for batch in follower.read()
        for channel, log_time in zip(
            batch.messages.channel.tolist(), batch.messages.log_time.tolist(), strict=True
        )
    ]


def chunks_of(path):
    with Source.open(path) as source:
        return list(candidates(source, 0, source.size))


def monitor_of(folder, flushes):
    """Return a monitor after flushes of ten messages each."""
    monitor = Monitor(folder)
    for _ in range(flushes):
        monitor.seconds(2)
    return monitor


def file_in(folder):
    (path,) = [*folder.glob('*.mcap'), *folder.glob('*.part')]
    return path


@settings(max_examples=15)
@given(st.lists(st.sampled_from(['write', 'look', 'rotate']), min_size=1, max_size=20))
def test_whenever_one_looks_every_message_comes_once(tmp_path_factory, steps):
    folder = tmp_path_factory.mktemp('grows')
    monitor, follower = Monitor(folder), Follower(folder)
    seen = []
    for step in steps:
        if step == 'write':
            monitor.seconds(2)
        elif step == 'rotate':
            monitor.writer.rotate()
        else:
            seen += times(follower)
    monitor.seconds(1)
    monitor.writer.close()
    seen += times(follower)
    assert seen == [(m.topic, m.log_time_ns) for m in open_log(folder).iter_messages()]
    assert follower.finished
    assert times(follower) == []


def test_a_single_file_is_followed_into_its_final_name(tmp_path):
    monitor = monitor_of(tmp_path / 'r', 2)
    follower = Follower(file_in(tmp_path / 'r'))
    first = times(follower)
    assert first
    assert (follower.written, follower.finished) == (True, False)
    monitor.seconds(2)
    monitor.writer.close()
    assert len(first + times(follower)) == 6 * 5
    assert (follower.written, follower.finished) == (False, True)


@pytest.mark.parametrize('number', [0, 3, -1])
def test_one_flipped_bit_of_a_chunks_length_loses_that_chunk_alone(tmp_path, number):
    monitor_of(tmp_path / 'r', 7).writer.close()
    path = file_in(tmp_path / 'r')
    raw, start = path.read_bytes(), chunks_of(path)[number]
    whole = len(times(Follower(path)))
    for bit in range(64):
        hurt = bytearray(raw)
        hurt[start + 1 + bit // 8] ^= 1 << bit % 8
        path.write_bytes(hurt)
        follower = Follower(path)
        seen = times(follower)
        assert len(seen) == whole - 10, bit
        assert (follower.damaged, follower.finished) == (1, True), bit
        assert len(seen) == sum(1 for _ in open_log(path).iter_messages())


@pytest.mark.parametrize('place', ['content', 'kind'])
def test_a_damaged_chunk_is_left_out_and_counted_even_if_it_looks_like_the_end(tmp_path, place):
    path = file_in(recording(tmp_path / 'r'))
    raw, start = bytearray(path.read_bytes()), chunks_of(path)[0]
    if place == 'kind':
        raw[start] = Opcode.FOOTER  # one bit from that of a chunk
    else:
        raw[raw.index(b'zstd') + 40] ^= 0xFF
    path.write_bytes(raw)
    follower = Follower(path)
    assert times(follower)
    assert (follower.damaged, follower.finished) == (1, True)


def test_a_damaged_length_in_a_file_of_a_dead_writer_is_passed_by(tmp_path):
    monitor = monitor_of(tmp_path / 'r', 5)
    part = file_in(tmp_path / 'r')
    raw, chunks = bytearray(part.read_bytes()), chunks_of(part)
    raw[chunks[1] + 3] ^= 0x40
    left = tmp_path / 'left.mcap.part'
    left.write_bytes(raw[: chunks[-1] + 30])
    follower = Follower(left)
    assert len(times(follower)) == 3 * 10
    assert (follower.damaged, follower.finished, follower.written) == (1, False, False)
    monitor.writer.close()


def test_a_file_cut_off_is_waited_for(tmp_path):
    path = file_in(recording(tmp_path / 'r'))
    raw, follower, seen = path.read_bytes(), None, 0
    for size in (8, 100, len(raw) // 2, len(raw) - 10, len(raw)):
        path.write_bytes(raw[:size])
        follower = follower or Follower(path)
        # Written anew under the same name it is the same file.
        seen += len(times(follower))
    assert (follower.finished, follower.damaged, seen) == (True, 0, 60 * 5 + 3)


def test_old_files_of_a_long_recording_are_not_read(tmp_path):
    monitor = Monitor(tmp_path)
    for _ in range(4):
        monitor.seconds(1)
        monitor.writer.rotate()
        monitor.now_ns += DAY_NS
    monitor.seconds(1)
    monitor.writer.close()
    assert len({log_time // DAY_NS for _, log_time in times(Follower(tmp_path))}) == 2


@pytest.mark.parametrize('content', [b'', b'not an mcap file at all'])
def test_what_is_no_recording_is_refused(tmp_path, content):
    path = tmp_path / 'x.mcap'
    path.write_bytes(content)
    with pytest.raises(RecordingError):
        list(Follower(path).read())


# The end of a recording -----------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path):
    """A recording of four splits, the last one unfinished."""
    writer = RecordingWriter(tmp_path / 'recording', definitions=STOCK)
    for topic in ('/a', '/b'):
        writer.add_topic(topic, FLOAT64)
    for k in range(N):
        writer.write(('/a', '/b')[k % 2], float64(k), START_NS + k, START_NS + 2 * k)
        if k % 200 == 199 and k < 700:
            writer.rotate()
    writer.flush()
    writer.abandon()
    return tmp_path / 'recording'


def since(folder, after):
    """Return which of the messages come after one, by their log times."""
    return [m.log_time_ns - START_NS for m in messages_since(folder, START_NS + after)]


def test_it_is_what_a_reader_of_everything_finds_after_the_moment(folder):
    everything, definitions = list(open_log(folder).iter_messages()), {}
    assert len(everything) == N
    for after in [0, START_NS - 1, *(START_NS + k for k in range(0, N, 37)), START_NS + N - 1]:
        expected = [m for m in everything if m.log_time_ns > after]
        assert list(messages_since(folder, after, definitions)) == expected
    assert definitions == dict.fromkeys(('/a', '/b'), STOCK.text(FLOAT64))


def test_old_splits_are_not_even_opened(folder):
    min(folder.glob('*.mcap')).write_bytes(b'damaged' * 100)
    assert since(folder, 500) == list(range(501, N))


@pytest.mark.parametrize('shut', [True, False])
def test_what_a_split_repeats_at_its_head_is_not_news(tmp_path, shut):
    latched, fresh, made = {}, {}, tmp_path / 'recording'
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
    writer.flush()
    (writer.close if shut else writer.abandon)()
    # What stands in the files beside the originals: the repetitions are there to be told apart.
    splits = [s for s in map(Split.read, finished_files(made)) if s is not None]
    assert sum(split.counts['/once'] for split in splits) == len(splits) > 3
    for after in range(-1, N, 29):
        np.testing.assert_array_equal(since(made, after), np.arange(after + 1, N))


def test_a_split_that_is_finished_while_it_is_looked_for_is_read_under_its_new_name(
    folder, monkeypatch
):
    read, tries = reading.read_recording, []

    def finished_meanwhile(wanted, *more):
        tries.append(wanted)
        for part in folder.glob('*.part'):
            part.rename(part.with_suffix(''))
        return read(wanted, *more)

    monkeypatch.setattr(reading, 'read_recording', finished_meanwhile)
    assert since(folder, 500) == list(range(501, N))
    assert len(tries) == 2


def test_what_cannot_be_read_is_a_sentence_and_an_empty_folder_gives_nothing(tmp_path):
    assert since(tmp_path, 0) == []
    with pytest.raises(RecordingError, match='cannot be read'):
        since(tmp_path / 'gone', 0)
    (tmp_path / 'recording_0.mcap').write_bytes(b'nothing of the kind')
    with pytest.raises(RecordingError, match=r'recording_0\.mcap'):
        since(tmp_path, 0)
