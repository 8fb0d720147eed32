# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A recording is followed while it grows: every message once, whenever one looks."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from monitor_recording import START_NS, STOCK, TYPES, Monitor, cdr, diagnosis, recording, stamp

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs import open_log
from valveflow_ros.logs.mcap.cdr import Decoder
from valveflow_ros.logs.mcap.follow import Follower
from valveflow_ros.logs.mcap.scan import candidates
from valveflow_ros.logs.source import Source

SECOND = 10**9


def test_the_made_up_messages_are_read_as_they_were_meant():
    for kind in set(TYPES.values()) - {'std_msgs/msg/Float64'}:
        Decoder(kind, STOCK.text(kind)).decode(cdr(kind, {}))
    kind = 'valveflow_msgs/msg/Diagnosis'
    fields = Decoder(kind, STOCK.text(kind)).decode(diagnosis(START_NS, 2, 'It sticks.', 'a', 'b'))
    assert [cause['name'] for cause in fields['causes']] == ['a', 'b']
    assert fields['header'] == {'stamp': stamp(START_NS), 'frame_id': 'U1'}


def times(follower: Follower) -> list[tuple[str, int]]:
    """Return what a follower has not given before, as topic and log time."""
    return [
        (batch.topics.channels[channel].topic, log_time)
        for batch in follower.read()
        for channel, log_time in zip(
            batch.messages.channel.tolist(), batch.messages.log_time.tolist(), strict=True
        )
    ]


@settings(max_examples=15, deadline=None)
@given(st.lists(st.sampled_from(['write', 'look', 'rotate']), min_size=1, max_size=20))
def test_whenever_one_looks_every_message_comes_once(tmp_path_factory, steps):
    folder = tmp_path_factory.mktemp('grows')
    monitor = Monitor(folder)
    follower = Follower(folder)
    seen: list[tuple[str, int]] = []
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
    truth = [(m.topic, m.log_time_ns) for m in open_log(folder).iter_messages()]
    assert seen == truth
    assert follower.finished
    assert times(follower) == []


def test_a_single_file_is_followed_into_its_final_name(tmp_path):
    monitor = Monitor(tmp_path / 'r')
    monitor.seconds(3)
    (part,) = (tmp_path / 'r').glob('*.part')
    follower = Follower(part)
    first = times(follower)
    assert first
    assert follower.written
    assert not follower.finished
    monitor.seconds(2)
    monitor.writer.close()
    assert len(first + times(follower)) == 5 * 5
    assert follower.finished
    assert not follower.written


def test_a_damaged_place_is_left_out_and_counted(tmp_path):
    folder = recording(tmp_path / 'r')
    (path,) = folder.glob('*.mcap')
    raw = bytearray(path.read_bytes())
    raw[raw.index(b'zstd') + 40] ^= 0xFF
    path.write_bytes(bytes(raw))
    follower = Follower(path)
    times(follower)
    assert follower.damaged == 1
    assert follower.finished


@pytest.mark.parametrize('number', [0, 3, -1])
def test_one_flipped_bit_of_a_chunks_length_loses_that_chunk_alone(tmp_path, number):
    monitor = Monitor(tmp_path / 'r')
    for _ in range(7):
        monitor.seconds(2)
    monitor.writer.close()
    (path,) = (tmp_path / 'r').glob('*.mcap')
    raw = path.read_bytes()
    with Source.open(path) as source:
        start = list(candidates(source, 0, source.size))[number]
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


def test_a_chunk_that_looks_like_the_end_does_not_end_the_file(tmp_path):
    folder = recording(tmp_path / 'r')
    (path,) = folder.glob('*.mcap')
    with Source.open(path) as source:
        start = next(candidates(source, 0, source.size))
    raw = bytearray(path.read_bytes())
    raw[start] = Opcode.FOOTER  # one bit from that of a chunk
    path.write_bytes(raw)
    follower = Follower(path)
    assert times(follower)
    assert (follower.damaged, follower.finished) == (1, True)


def test_a_damaged_length_in_a_file_of_a_dead_writer_is_passed_by(tmp_path):
    monitor = Monitor(tmp_path / 'r')
    for _ in range(5):
        monitor.seconds(2)
    (part,) = (tmp_path / 'r').glob('*.part')
    raw = bytearray(part.read_bytes())
    with Source.open(part) as source:
        start, last = [list(candidates(source, 0, source.size))[k] for k in (1, -1)]
    raw[start + 3] ^= 0x40
    left = tmp_path / 'left.mcap.part'
    left.write_bytes(raw[: last + 30])
    follower = Follower(left)
    assert len(times(follower)) == 3 * 10
    assert (follower.damaged, follower.finished, follower.written) == (1, False, False)
    monitor.writer.close()


def test_a_file_cut_off_is_waited_for(tmp_path):
    folder = recording(tmp_path / 'r')
    (path,) = folder.glob('*.mcap')
    raw = path.read_bytes()
    follower = None
    seen: list[tuple[str, int]] = []
    for size in (8, 100, len(raw) // 2, len(raw) - 10, len(raw)):
        path.write_bytes(raw[:size])
        follower = follower or Follower(path)
        # Written anew under the same name it is the same file.
        seen += times(follower)
    assert follower is not None
    assert follower.finished
    assert follower.damaged == 0
    assert len(seen) == 60 * 5 + 3


def test_old_files_of_a_long_recording_are_not_read(tmp_path):
    monitor = Monitor(tmp_path)
    for _ in range(4):
        monitor.seconds(1)
        monitor.writer.rotate()
        monitor.now_ns += 24 * 3600 * SECOND
    monitor.seconds(1)
    monitor.writer.close()
    days = {log_time // (24 * 3600 * SECOND) for _, log_time in times(Follower(tmp_path))}
    assert len(days) == 2


@pytest.mark.parametrize('content', [b'', b'not an mcap file at all'])
def test_what_is_no_recording_is_refused(tmp_path, content):
    path = tmp_path / 'x.mcap'
    path.write_bytes(content)
    with pytest.raises(RecordingError):
        list(Follower(path).read())
