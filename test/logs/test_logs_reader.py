# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Recordings of ours and of others are read, and what cannot be read is one sentence."""

import json
import os
import struct
import zlib
from pathlib import Path

import lz4.frame
import mcap.records
import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from log_files import (
    FLOAT64,
    SAMPLE,
    START_NS,
    STOCK,
    Reading,
    float64,
    plant_sample,
    read_back,
    write_chunks,
    write_messages,
)
from mcap.writer import CompressionType, Writer

from valveflow_ros.errors import InputError, RecordingError
from valveflow_ros.logs import Message, RecordingWriter, open_log
from valveflow_ros.logs.mcap.chunk_file import ChunkBuilder
from valveflow_ros.logs.mcap.records import MAGIC, pack
from valveflow_ros.records import SIGNALS, Quality, Signal

SAMPLES, OPENING, POWER = '/plant_sample', '/valve_opening', '/generated_power'


def foreign(
    path, compression=CompressionType.ZSTD, count=50, topic='/hv1/valve_opening', **options
):
    """Write with another library, as other people's recorders do."""
    with path.open('wb') as stream:
        writer = Writer(stream, compression=compression, **options)
        writer.start(profile='ros2')
        schema = writer.register_schema(FLOAT64, 'ros2msg', b'float64 data')
        other = writer.register_schema('demo_msgs/msg/Odd', 'ros2idl', b'module demo {};')
        ours = writer.register_channel(topic, 'cdr', schema)
        camera = writer.register_channel('/camera', 'jpeg', other)
        for step in range(count):
            for channel, data in ((ours, float64(step)), (camera, b'not cdr')):
                writer.add_message(channel, START_NS + step, data, START_NS + step)
        writer.finish()
    return path


def test_the_inputs_of_a_monitor_are_those_that_it_names(tmp_path):
    """Also where a remapping gave them other names, as tags of a control system."""

    def written(folder, topics, **attachments):
        writer = RecordingWriter(tmp_path / folder, definitions=STOCK, attachments=attachments)
        for topic in topics:
            writer.add_topic(topic, FLOAT64)
        for step in range(5):
            for value, topic in enumerate(topics):
                at = START_NS + 10 * step + value
                writer.write(topic, float64(value + step), at, at)
        writer.close()
        return tmp_path / folder

    usual = [f'/{info.topic}' for info in SIGNALS if info.required]
    theirs = ['/gw/HV101', '/gw/PT101', usual[2], '/gw/main_steam_pressure']
    told = {name[1:]: topic for name, topic in zip(usual, theirs, strict=True)}
    told |= {'valve_command': '/gw/never_came', 'vacuum': '/gw/vacuum'}
    named = {'topics.json': json.dumps({'inputs': told}).encode()}
    plain = open_log(written('plain', usual))
    found = open_log(written('remapped', theirs, **named))
    assert read_back(found) == read_back(plain)
    assert set(found.signals.values()) == set(theirs)
    # What somebody asks for comes first, and what is no list of topics is no list.
    wanted = {'main_steam_pressure': '/gw/main_steam_pressure'}
    asked = open_log(tmp_path / 'remapped', columns=wanted)
    assert asked.signals[Signal.MAIN_STEAM_PRESSURE] == '/gw/main_steam_pressure'
    odd = open_log(written('odd', theirs, **{'topics.json': b'[1]'}))
    assert set(odd.signals) == {Signal.MAIN_STEAM_TEMPERATURE, Signal.MAIN_STEAM_PRESSURE}


def naive_readings(messages):
    """Read messages one by one, in the order of log time; `messages` are (log, publish, bytes)."""
    found = []
    for topic, data, log_ns, publish_ns in sorted(messages, key=lambda m: m.log_time_ns):
        order = '<' if data[1] else '>'
        if topic != SAMPLES:
            signal = next(info.signal for info in SIGNALS if topic.endswith(info.topic))
            value = struct.unpack(f'{order}d', data[4:])[0]
            found.append(Reading(log_ns, publish_ns, int(signal), value, 0))
            continue
        sec, nanosec, size = struct.unpack_from(f'{order}iII', data, 4)
        place = 12 + size
        for info in SIGNALS:
            place += -place % 8
            value, quality = struct.unpack_from(f'{order}dB', data, 4 + place)
            place += 9
            if info.required or (np.isfinite(value) and quality):
                time_ns = sec * 10**9 + nanosec
                code = {1: Quality.GOOD, 2: Quality.UNCERTAIN}.get(quality, Quality.BAD)
                found.append(Reading(log_ns, time_ns, int(info.signal), value, int(code)))
    return found


@st.composite
def message_lists(draw):
    number, times = st.floats(width=64), st.integers(0, 2**62)
    messages = []
    for _ in range(draw(st.integers(1, 40))):
        log_ns, order = draw(st.integers(0, 50)), draw(st.sampled_from('<>'))
        if draw(st.booleans()):
            values = draw(st.lists(number, min_size=5, max_size=5))
            codes = draw(st.lists(st.integers(0, 255), min_size=5, max_size=5))
            stamp = draw(st.integers(0, 2**31 * 10**9 - 1))
            frame = draw(st.text(max_size=9).filter(lambda t: '\0' not in t))
            data = plant_sample(stamp, values, codes, frame, order)
            messages.append(Message(SAMPLES, data, log_ns, draw(times)))
        else:
            topic = f'/{draw(st.sampled_from(SIGNALS)).topic}'
            messages.append(Message(topic, float64(draw(number), order), log_ns, draw(times)))
    return messages


@settings(max_examples=25)
@given(messages=message_lists(), flush_every=st.integers(1, 9))
def test_reading_at_once_is_reading_one_by_one(tmp_path_factory, messages, flush_every):
    folder = tmp_path_factory.mktemp('log')
    with RecordingWriter(folder, definitions=STOCK) as writer:
        writer.add_topic(SAMPLES, SAMPLE)
        for info in SIGNALS:
            writer.add_topic(f'/{info.topic}', FLOAT64)
        for number, message in enumerate(messages):
            writer.write(*message)
            if number % flush_every == 0:
                writer.flush()
            if number % 17 == 16:
                writer.rotate()
    contents = open_log(folder)
    expected = naive_readings(messages)
    # What never got a time is left out, where others have one.
    expected = [r for r in expected if r.time_ns > 0] or expected
    assert str(read_back(contents)) == str(expected)
    raw = [(m.topic, m.data, m.log_time_ns, m.publish_time_ns) for m in contents.iter_messages()]
    assert raw == [tuple(m) for m in sorted(messages, key=lambda m: m.log_time_ns)]
    assert contents.warnings == () or 'both' in contents.warnings[0]


def test_everything_known_about_the_file_is_told(tmp_path):
    path, wanted, _ = write_chunks(tmp_path / 'log')
    contents, topic = open_log(path), '/unit1/generated_power'
    assert read_back(contents) == wanted
    assert contents.signals == {info.signal: f'/unit1/{info.topic}' for info in SIGNALS[:4]}
    info = contents.topics[topic]
    assert (info.type, info.count, info.signal) == (FLOAT64, 100, Signal.GENERATED_POWER)
    assert info.definition == STOCK.text(FLOAT64)
    assert info.type_hash == STOCK.type_hash(FLOAT64)
    assert contents.attachments == {'parameters.yaml': b'a: 1\n'}
    assert (contents.start_ns, contents.end_ns) == (wanted[0].log_time_ns, wanted[-1].log_time_ns)
    assert (contents.warnings, contents.damaged_chunks) == ((), 0)
    found = list(contents.iter_messages([topic]))
    powers = [float64(w.value) for w in wanted if w.signal == Signal.GENERATED_POWER]
    assert [m.data for m in found] == powers
    assert {m.type for m in found} == {FLOAT64}
    with pytest.raises(InputError, match=r"has no topic '/gone'; it has: /unit1/"):
        contents.iter_messages(['/gone'])
    path.write_bytes(bytes(path.stat().st_size))
    with pytest.raises(RecordingError, match='has changed while it was read'):
        list(contents.iter_messages())


def test_topics_of_other_names_are_read_where_they_are_named(tmp_path):
    path = foreign(tmp_path / 'other.mcap', topic='/cabin/noise')
    contents = open_log(path)
    assert len(contents.readings) == 0
    assert '--column valve_opening=TOPIC' in contents.warnings[0]
    assert contents.topics['/cabin/noise'].count == 50
    for name in ('valve_opening', 'valve_opening_percent'):
        contents = open_log(path, columns={name: 'cabin/noise'})
        assert contents.signals == {Signal.VALVE_OPENING: '/cabin/noise'}
        assert len(contents.readings) == 50
    for columns, error, said in (
        ({'valve_opening': '/gone'}, InputError, r"no topic '/gone' for valve_opening; .*/camera"),
        ({'valve_openings': '/x'}, InputError, "no signal 'valve_openings'"),
        ({'generated_power': '/camera'}, RecordingError, 'is of type demo_msgs/msg/Odd'),
    ):
        with pytest.raises(error, match=said):
            open_log(path, columns=columns)


def test_two_topics_for_one_signal_are_not_guessed_between(tmp_path):
    names = [f'/unit{k}/valve_opening' for k in (1, 2)]
    messages = [Message(name, float64(1.0), START_NS, START_NS) for name in names]
    path = write_messages(tmp_path / 'log', dict.fromkeys(names, FLOAT64), messages)
    with pytest.raises(InputError, match=f"'{names[0]}' and '{names[1]}'.*--column"):
        open_log(path)
    contents = open_log(path, columns={'valve_opening': names[1]})
    assert contents.signals == {Signal.VALVE_OPENING: names[1]}
    assert len(contents.readings) == 1


def test_a_name_of_an_input_with_another_type(tmp_path):
    wrong = {OPENING: 'std_msgs/msg/Bool'}
    messages = [
        Message(OPENING, b'\0\1\0\0\1', START_NS, START_NS),
        Message(POWER, float64(1.0), START_NS, START_NS),
    ]
    contents = open_log(write_messages(tmp_path / 'mixed', wrong | {POWER: FLOAT64}, messages))
    assert contents.readings.value.tolist() == [1.0]
    assert "'/valve_opening' is of type std_msgs/msg/Bool" in contents.warnings[0]
    with pytest.raises(RecordingError, match='is of type std_msgs/msg/Bool where'):
        open_log(write_messages(tmp_path / 'alone', wrong, messages[:1]))


def test_messages_that_do_not_fit_their_type_are_counted(tmp_path):
    good = plant_sample(START_NS, [1.0] * 5, [1] * 5)
    bad = [good[:-1], good[:20], b'', b'\0\7\0\0' + good[4:], good[:12] + b'\xff' * 4 + good[16:]]
    doubles = [float64(2.0), b'\0\1\0\0', b'\0\5\0\0' + bytes(8), float64(2.0) + bytes(9)]
    messages = [(SAMPLES, data) for data in [good, *bad]]
    messages += [('/valve_command', data) for data in doubles]
    path = write_messages(
        tmp_path / 'log', {SAMPLES: SAMPLE, '/valve_command': FLOAT64},
        [Message(*message, START_NS, START_NS) for message in messages],
    )  # fmt: skip
    contents = open_log(path)
    assert contents.readings.value.tolist() == [1.0] * 5 + [2.0]
    for count, topic in ((5, SAMPLES), (3, '/valve_command')):
        told = f"{count} messages on '{topic}' do not fit"
        assert any(told in w for w in contents.warnings)


def sample_log(folder, definition, data):
    return write_messages(folder, {SAMPLES: SAMPLE}, [Message(SAMPLES, data, 9, 9)], definition)


def test_the_layout_of_samples_is_taken_from_the_file(tmp_path):
    names = [info.topic for info in reversed(SIGNALS)]
    fields = '\n'.join(f'uint8 {name}_quality\nfloat64 {name}' for name in names)
    text = f'int16 version\nstd_msgs/Header header\n{fields}\nfloat64[] more\n'
    line = f'\n{"=" * 80}\n'
    header, time = STOCK.text('std_msgs/msg/Header').split(line)
    body = struct.pack('<hxxiII3s', 7, 5, 6, 3, b'ab\0')
    for number in range(5):
        body += struct.pack('<B', 2)
        body += b'\0' * (-len(body) % 8) + struct.pack('<d', 10.0 + number)
    definition = line.join([text, f'MSG: std_msgs/Header\n{header}', time])
    found = read_back(open_log(sample_log(tmp_path, definition, b'\0\1\0\0' + body)))
    assert found == [Reading(9, 5 * 10**9 + 6, k, 14.0 - k, 1) for k in range(5)]


def test_qualities_of_recordings_before_there_was_one_for_unknown(tmp_path):
    now = STOCK.text(SAMPLE)
    then = now.replace('uint8 QUALITY_UNKNOWN=0', '')
    for k, name in enumerate(('GOOD', 'UNCERTAIN', 'BAD')):
        then = then.replace(f'QUALITY_{name}={k + 1}', f'QUALITY_{name}={k}')
    for text, sent in ((now, [1, 2, 3, 0, 1]), (then, [0, 1, 2, 2, 0])):
        data = plant_sample(START_NS, [1.0] * 5, sent)
        found = open_log(sample_log(tmp_path / str(sent[0]), text, data)).readings.quality
        assert found.tolist() == [Quality.GOOD, Quality.UNCERTAIN, Quality.BAD, Quality.BAD, 0]


def test_samples_without_a_signal_are_refused(tmp_path):
    with pytest.raises(RecordingError, match=r"'/plant_sample' cannot be read: .*header"):
        open_log(sample_log(tmp_path / 'log', 'float64 valve_opening\n', float64(1.0)))


@pytest.mark.parametrize('schema_id', [0, 7])
def test_a_channel_without_a_schema_is_left_out_and_ends(tmp_path, schema_id):
    """Reading it again and again for its schema would never end."""
    schema = mcap.records.Schema(1, STOCK.text(FLOAT64).encode(), 'ros2msg', FLOAT64)
    lone = mcap.records.Channel(2, POWER, 'cdr', {}, schema_id)
    good = mcap.records.Channel(1, OPENING, 'cdr', {}, 1)
    builder = ChunkBuilder()
    for channel in (1, 2):
        builder.add(channel, 1, START_NS, START_NS, float64(channel))
    path = tmp_path / 'lone.mcap'
    head = MAGIC + pack(mcap.records.Header('ros2', 'x'))
    path.write_bytes(head + builder.build(pack(schema, good, lone)).record)
    contents = open_log(path)
    assert contents.readings.value.tolist() == [1.0]
    assert [m.data for m in contents.iter_messages([OPENING])] == [float64(1)]


def test_more_of_one_time_than_can_wait_is_one_sentence(tmp_path, monkeypatch):
    monkeypatch.setattr('valveflow_ros.logs.mcap.reading.MAX_WAITING_BYTES', 1 << 20)
    with RecordingWriter(tmp_path / 'log', definitions=STOCK) as writer:
        writer.add_topic(OPENING, FLOAT64)
        writer.add_topic('/note', 'std_msgs/msg/String')
        for number in range(5):
            for step in (0, 5 - number):
                time_ns = START_NS + step
                writer.write(OPENING, float64(number), time_ns, time_ns)
                writer.write('/note', bytes(1 << 20), time_ns, time_ns)
            writer.flush()
    contents = open_log(tmp_path / 'log')
    assert len(contents.readings) == 10
    with pytest.raises(RecordingError, match='side by side'):
        list(contents.iter_messages())


def test_values_that_never_got_a_time_are_left_out_and_counted(tmp_path):
    """So a monitor records what came before the first /clock; it does not use it either."""
    topics = {f'/{info.topic}': FLOAT64 for info in SIGNALS if info.required}
    rows = [
        Message(topic, float64(float(k)), START_NS + k, 0 if k < 3 else START_NS + k)
        for k in range(10)
        for topic in topics
    ]
    log = open_log(write_messages(tmp_path, topics, rows))
    assert log.readings.time_ns.min() == START_NS + 3
    assert len(log.readings) == 7 * len(topics) == len(log.log_time_ns)
    assert any(f'{3 * len(topics)} values recorded without a time' in w for w in log.warnings)


# Folders ---------------------------------------------------------------------------------------


def test_splits_are_read_in_the_order_of_their_numbers(tmp_path):
    with RecordingWriter(tmp_path, definitions=STOCK) as writer:
        writer.add_topic(OPENING, FLOAT64)
        for step in range(12):
            writer.write(OPENING, float64(step), START_NS, START_NS)
            writer.rotate()
    assert open_log(tmp_path).readings.value.tolist() == list(range(12))
    (tmp_path / 'metadata.yaml').unlink()
    assert open_log(tmp_path).readings.value.tolist() == list(range(12))


@pytest.fixture
def folder(tmp_path):
    """Return a recording, what is in it, and a function that changes its `metadata.yaml`."""
    path, wanted, _ = write_chunks(tmp_path / 'log')
    metadata = path.parent / 'metadata.yaml'

    def change(old, new):
        text = metadata.read_text()
        assert old in text
        metadata.write_text(text.replace(old, new, 1))

    return path.parent, wanted, change


def test_a_broken_metadata_file_does_no_harm(folder):
    home, wanted, _ = folder
    for text in ('', 'a: [', 'rosbag2_bagfile_information: 3', '&a [*a, *a]'):
        (home / 'metadata.yaml').write_text(text)
        assert read_back(open_log(home)) == wanted, text


def test_what_is_missing_or_not_named_is_told(folder):
    home, wanted, change = folder
    foreign(home / 'other.mcap')
    (home / 'log_1.mcap.part').write_bytes(b'')
    change('"log_0.mcap"\n', '"log_0.mcap"\n    - "log_7.mcap"\n')
    contents = open_log(home)
    assert read_back(contents) == wanted
    assert "'log_7.mcap' is named in metadata.yaml and is not there." in contents.warnings
    assert 'other.mcap: not named in metadata.yaml, not read.' in contents.warnings
    assert any('log_1.mcap.part: is empty' in warning for warning in contents.warnings)


def test_a_folder_whose_metadata_names_nothing_that_is_there_is_read_and_says_so(folder):
    home, wanted, change = folder
    change('"log_0.mcap"\n', '"gone.mcap"\n')
    log = open_log(home)
    assert read_back(log) == wanted
    told = ' '.join(log.warnings)
    assert 'all are read' in told
    assert 'not read' not in told


def test_names_in_the_metadata_file_do_not_lead_out_of_the_folder(folder):
    home, wanted, change = folder
    change('"log_0.mcap"\n', f'"{foreign(home.parent / "secret.mcap")}"\n')
    assert read_back(open_log(home)) == wanted


def test_compression_of_rosbag2_is_refused_with_the_cure(folder):
    home, _, change = folder
    change('compression_mode: ""', 'compression_mode: FILE')
    with pytest.raises(RecordingError, match=r"compressed file by file.*'ros2 bag convert'"):
        open_log(home)


def test_files_that_disagree_about_a_topic_are_refused(tmp_path):
    for number, kind in ((0, FLOAT64), (1, 'std_msgs/msg/Bool')):
        write_messages(tmp_path, {'/x': kind}, [Message('/x', float64(1.0), number, number)])
    with pytest.raises(RecordingError, match="'/x' has two types"):
        open_log(tmp_path)


# Bad inputs ------------------------------------------------------------------------------------


def bad_inputs(folder):
    (folder / 'empty.mcap').write_bytes(b'')
    (folder / 'zeros.mcap').write_bytes(bytes(5000))
    (folder / 'text.mcap').write_text('time,valve_opening_percent\n')
    (folder / 'magic.mcap').write_bytes(MAGIC)
    (folder / 'strange.bin').write_bytes(b'abcdefgh')
    (folder / 'old.db3').write_bytes(b'SQLite format 3\0')
    (folder / 'nothing').mkdir()
    (folder / 'sqlite').mkdir()
    (folder / 'sqlite' / 'a.db3').write_bytes(b'SQLite format 3\0')
    os.mkfifo(folder / 'fifo.mcap')
    (folder / 'device.mcap').symlink_to('/dev/zero')
    (folder / 'loop.mcap').symlink_to(folder / 'loop.mcap')
    foreign(folder / 'silent.mcap', count=0)
    return {
        'empty.mcap': 'is empty',
        'zeros.mcap': 'is not an MCAP file',
        'text.mcap': 'is not an MCAP file',
        'magic.mcap': 'holds no messages',
        'strange.bin': 'neither an .mcap file nor',
        'old.db3': 'sqlite3',
        'nothing': 'has no .mcap file',
        'sqlite': 'sqlite3',
        'fifo.mcap': 'is not a regular file',
        'device.mcap': 'is not a regular file',
        'loop.mcap': 'cannot be opened',
        'silent.mcap': 'holds no messages',
        'gone.mcap': 'cannot be opened (no such file or directory)',
        'line\nbreak.mcap': 'line?break.mcap',
        'x' * 300 + '.mcap': 'cannot be opened (file name too long)',
        'a\0b.mcap': 'is not a name of a file',
    }


def test_every_bad_input_is_one_sentence(tmp_path):
    for name, problem in bad_inputs(tmp_path).items():
        with pytest.raises(RecordingError) as caught:
            open_log(Path(f'{tmp_path}/{name}'))
        assert problem in str(caught.value)
        assert str(caught.value).endswith('.')
        assert '\n' not in str(caught.value)


def test_the_recordings_in_a_folder_of_several_are_named(tmp_path):
    for name in ('a', 'b', 'notes'):
        (tmp_path / name).mkdir()
    (tmp_path / 'a' / 'a_0.mcap').touch()
    (tmp_path / 'b' / 'b_0.mcap.part').touch()
    with pytest.raises(RecordingError) as caught:
        open_log(tmp_path)
    assert str(caught.value).endswith(f'; give one of: {tmp_path / "a"}, {tmp_path / "b"}.')
    for number in range(10):
        (tmp_path / f'c{number}').mkdir()
        (tmp_path / f'c{number}' / 'log.db3').touch()
    with pytest.raises(RecordingError, match=r'give one of: 2 earlier ones, /.*/c0, .*/c9\.$'):
        open_log(tmp_path)


@pytest.mark.skipif(os.geteuid() == 0, reason='nothing is unreadable for root')
def test_an_unreadable_file_is_one_sentence(tmp_path):
    path, _, _ = write_chunks(tmp_path / 'log')
    path.chmod(0)
    with pytest.raises(RecordingError, match='permission denied'):
        open_log(path)


def record(op, body):
    return struct.pack('<BQ', op, len(body)) + body


def chunk(content, compression=b'zstd', size=None, packed=None, crc=None):
    packed = zstandard.compress(content) if packed is None else packed
    size = len(content) if size is None else size
    crc = zlib.crc32(content) if crc is None else crc
    name = struct.pack('<I', len(compression)) + compression
    return record(6, struct.pack('<QQQI', 0, 0, size, crc) + name
                  + struct.pack('<Q', len(packed)) + packed)  # fmt: skip


def channel(number=1, topic=b'x', schema=0):
    return record(4, struct.pack('<HHI', number, schema, len(topic)) + topic + b'\3\0\0\0cdr'
                  + bytes(4))  # fmt: skip


def bomb(stated):
    packer = zstandard.ZstdCompressor(level=1, write_content_size=stated)
    with_size = packer.compressobj(size=1 << 30) if stated else packer.compressobj()
    zeros = bytes(1 << 20)
    return b''.join(with_size.compress(zeros) for _ in range(1 << 10)) + with_size.flush()


HOSTILE = {
    'honest zstd bomb': lambda: chunk(b'', size=1 << 30, packed=bomb(True)),
    'lying zstd bomb': lambda: chunk(b'', size=100, packed=bomb(True)),
    'zstd bomb of no stated size': lambda: chunk(b'', size=60 << 20, packed=bomb(False)),
    'lz4 bomb': lambda: chunk(b'', b'lz4', 100, lz4.frame.compress(bytes(200 << 20))),
    'many full chunks of zeros': lambda: chunk(bytes(60 << 20)) * 2000,
    'unknown compression': lambda: chunk(b'', b'xz\0\0', 10, b'abc'),
    'a million channels': lambda: chunk(b''.join(channel(k % 65536) for k in range(10**6))),
    'a channel defined twice': lambda: chunk(channel(topic=b'x') + channel(topic=b'y')),
    'a message longer than the world': lambda: chunk(struct.pack('<BQ', 5, 2**63)),
    'nested chunks': lambda: chunk(chunk(chunk(b''))),
    'overlapping heads': lambda: chunk(b'', b'', 10, b'abc', 7)[:49] * 40000,
    'endless lengths': lambda: (b'\x06' + b'\xff' * 8) * 10000,
    'records of no length': lambda: struct.pack('<BQ', 12, 0) * 50000,
    'a chunk of nothing': lambda: chunk(b''),
}


@pytest.mark.parametrize('name', HOSTILE)
def test_hostile_files_are_refused(tmp_path, name):
    path = tmp_path / 'hostile.mcap'
    path.write_bytes(MAGIC + HOSTILE[name]())
    with pytest.raises(RecordingError):
        open_log(path)


def test_the_same_message_without_end_is_read_as_far_as_its_size_justifies(tmp_path):
    texts = (FLOAT64.encode(), b'ros2msg', b'float64 data')
    schema = struct.pack('<H', 1) + b''.join(struct.pack('<I', len(t)) + t for t in texts)
    message = record(5, struct.pack('<HIQQ', 1, 0, 1, 1) + float64(1.0))
    topic = record(3, schema) + channel(topic=b'/valve_opening', schema=1)
    path = tmp_path / 'hostile.mcap'
    path.write_bytes(MAGIC + chunk(topic + message * 600_000) * 20)
    contents = open_log(path)
    assert 0 < len(contents.readings) < 4_000_000
    assert any('far more than its size justifies' in warning for warning in contents.warnings)
