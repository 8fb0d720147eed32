"""A recording is followed while it grows: every message once, whenever one looks."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from monitor_recording import START_NS, STOCK, TYPES, Monitor, cdr, diagnosis, recording, stamp

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs import open_log
from valveflow_ros.logs.cdr import Decoder
from valveflow_ros.logs.follow import Follower

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
