# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
import os
import struct
import zlib
from pathlib import Path

import lz4.frame
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
from valveflow_ros.records import SIGNALS, Quality, Signal

NUMBERS = st.floats(width=64)
TIMES = st.integers(0, 2**62)
QUALITY = st.integers(0, 255)


def foreign(
    path, compression=CompressionType.ZSTD, count=50, topic='/hv1/valve_opening', **options
):
    """Write with another library, as other people's recorders do."""
    with path.open('wb') as stream:
        writer = Writer(stream, compression=compression, **options)
        writer.start(profile='ros2')
        schema = writer.register_schema(FLOAT64, 'ros2msg', b'float64 data')
        other = writer.register_schema('demo_msgs/msg/Odd', 'ros2idl', b'module demo {};')
        channels = [
            writer.register_channel(topic, 'cdr', schema),
            writer.register_channel('/camera', 'jpeg', other),
        ]
        for step in range(count):
            for channel in channels:
                data = float64(step) if channel == channels[0] else b'not cdr'
                writer.add_message(channel, START_NS + step, data, START_NS + step)
        writer.finish()
    return path


def naive_readings(messages):
    """Read messages one by one, in the order of log time; `messages` are (log, publish, bytes)."""
    found = []
    for topic, data, log_ns, publish_ns in sorted(messages, key=lambda m: m.log_time_ns):
        order = '<' if data[1] else '>'
        if topic != '/plant_sample':
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
    messages = []
    for _ in range(draw(st.integers(1, 40))):
        log_ns, order = draw(st.integers(0, 50)), draw(st.sampled_from('<>'))
        if draw(st.booleans()):
            values = draw(st.lists(NUMBERS, min_size=5, max_size=5))
            codes = draw(st.lists(QUALITY, min_size=5, max_size=5))
            stamp = draw(st.integers(0, 2**31 * 10**9 - 1))
            frame = draw(st.text(max_size=9).filter(lambda t: '\0' not in t))
            data = plant_sample(stamp, values, codes, frame, order)
            messages.append(Message('/plant_sample', data, log_ns, draw(TIMES)))
        else:
            topic = f'/{draw(st.sampled_from(SIGNALS)).topic}'
            data = float64(draw(NUMBERS), order)
            messages.append(Message(topic, data, log_ns, draw(TIMES)))
    return messages


@settings(max_examples=40, deadline=None)
@given(messages=message_lists(), flush_every=st.integers(1, 9), seed=st.integers(0, 10**9))
def test_reading_at_once_is_reading_one_by_one(tmp_path_factory, messages, flush_every, seed):
    folder = tmp_path_factory.mktemp('log') / f'log{seed}'
    with RecordingWriter(folder, definitions=STOCK) as writer:
        writer.add_topic('/plant_sample', SAMPLE)
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
    contents = open_log(path)
    assert read_back(contents) == wanted
    assert contents.signals == {info.signal: f'/unit1/{info.topic}' for info in SIGNALS[:4]}
    info = contents.topics['/unit1/generated_power']
    assert (info.type, info.count, info.signal) == (FLOAT64, 100, Signal.GENERATED_POWER)
    assert info.definition == STOCK.text(FLOAT64)
    assert info.type_hash == STOCK.type_hash(FLOAT64)
    assert contents.attachments == {'parameters.yaml': b'a: 1\n'}
    assert (contents.start_ns, contents.end_ns) == (wanted[0].log_time_ns, wanted[-1].log_time_ns)
    assert contents.warnings == ()
    assert contents.damaged_chunks == 0


def test_some_topics_only(tmp_path):
    path, wanted, _ = write_chunks(tmp_path / 'log')
    contents = open_log(path)
    found = list(contents.iter_messages(['/unit1/generated_power']))
    assert [m.data for m in found] == [
        float64(w.value) for w in wanted if w.signal == Signal.GENERATED_POWER
    ]
    assert {m.type for m in found} == {FLOAT64}
    with pytest.raises(InputError, match=r"has no topic '/gone'; it has: /unit1/"):
        contents.iter_messages(['/gone'])


@pytest.mark.parametrize(
    'compression', [CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD]
)
def test_recordings_of_others_are_read(tmp_path, compression):
    path = foreign(tmp_path / 'other.mcap', compression, chunk_size=500)
    contents = open_log(path)
    assert contents.readings.value.tolist() == list(range(50))
    assert {name: info.count for name, info in contents.topics.items()} == {
        '/hv1/valve_opening': 50,
        '/camera': 50,
    }
    assert len(list(contents.iter_messages(['/camera']))) == 50


def test_a_file_without_any_index_is_read(tmp_path):
    options = {'repeat_channels': False, 'repeat_schemas': False, 'use_statistics': False}
    path = foreign(tmp_path / 'other.mcap', use_summary_offsets=False, **options)
    assert len(open_log(path).readings) == 50


@pytest.mark.parametrize('option', ['enable_crcs', 'use_chunking'])
def test_a_file_without_checksums_is_read_with_a_warning(tmp_path, option):
    contents = open_log(foreign(tmp_path / 'other.mcap', **{option: False}))
    assert len(contents.readings) == 50
    assert contents.warnings[0].endswith('; damage there cannot be seen.')
    assert len(list(contents.iter_messages())) == 100


def test_foreign_topics_only_are_looked_at_and_not_read(tmp_path):
    contents = open_log(foreign(tmp_path / 'other.mcap', topic='/cabin/noise'))
    assert len(contents.readings) == 0
    assert '--column valve_opening=TOPIC' in contents.warnings[0]
    assert contents.topics['/cabin/noise'].count == 50


def test_an_explicit_topic_is_taken(tmp_path):
    path = foreign(tmp_path / 'other.mcap', topic='/cabin/noise')
    for name in ('valve_opening', 'valve_opening_percent'):
        contents = open_log(path, columns={name: 'cabin/noise'})
        assert contents.signals == {Signal.VALVE_OPENING: '/cabin/noise'}
        assert len(contents.readings) == 50


@pytest.mark.parametrize(
    ('columns', 'error', 'match'),
    [
        (
            {'valve_opening': '/gone'},
            InputError,
            r"no topic '/gone' for valve_opening; .* /camera",
        ),
        ({'valve_openings': '/x'}, InputError, "no signal 'valve_openings'"),
        ({'generated_power': '/camera'}, RecordingError, 'is of type demo_msgs/msg/Odd'),
    ],
)
def test_a_wrong_choice_is_one_sentence(tmp_path, columns, error, match):
    with pytest.raises(error, match=match):
        open_log(foreign(tmp_path / 'other.mcap'), columns=columns)


def two_units(folder):
    names = [f'/unit{k}/valve_opening' for k in (1, 2)]
    messages = [Message(name, float64(1.0), START_NS, START_NS) for name in names]
    return write_messages(folder, dict.fromkeys(names, FLOAT64), messages)


def test_two_topics_for_one_signal_are_not_guessed_between(tmp_path):
    path = two_units(tmp_path / 'log')
    with pytest.raises(
        InputError, match=r"'/unit1/valve_opening' and '/unit2/valve_opening'.*--column"
    ):
        open_log(path)
    contents = open_log(path, columns={'valve_opening': '/unit2/valve_opening'})
    assert contents.signals == {Signal.VALVE_OPENING: '/unit2/valve_opening'}
    assert len(contents.readings) == 1


def test_a_name_of_an_input_with_another_type(tmp_path):
    right, wrong = '/generated_power', '/valve_opening'
    messages = [
        Message(wrong, b'\0\1\0\0\1', START_NS, START_NS),
        Message(right, float64(1.0), START_NS, START_NS),
    ]
    mixed = write_messages(
        tmp_path / 'mixed', {wrong: 'std_msgs/msg/Bool', right: FLOAT64}, messages
    )
    contents = open_log(mixed)
    assert contents.readings.value.tolist() == [1.0]
    assert "'/valve_opening' is of type std_msgs/msg/Bool" in contents.warnings[0]
    alone = write_messages(tmp_path / 'alone', {wrong: 'std_msgs/msg/Bool'}, messages[:1])
    with pytest.raises(RecordingError, match='is of type std_msgs/msg/Bool where'):
        open_log(alone)


def test_messages_that_do_not_fit_their_type_are_counted(tmp_path):
    good = plant_sample(START_NS, [1.0] * 5, [1] * 5)
    bad = [good[:-1], good[:20], b'', b'\0\7\0\0' + good[4:], good[:12] + b'\xff' * 4 + good[16:]]
    messages = [Message('/plant_sample', data, START_NS, START_NS) for data in [good, *bad]]
    messages += [
        Message('/valve_command', data, START_NS, START_NS)
        for data in (float64(2.0), b'\0\1\0\0', b'\0\5\0\0' + bytes(8), float64(2.0) + bytes(9))
    ]
    path = write_messages(
        tmp_path / 'log', {'/plant_sample': SAMPLE, '/valve_command': FLOAT64}, messages
    )
    contents = open_log(path)
    assert contents.readings.value.tolist() == [1.0] * 5 + [2.0]
    assert any("5 messages on '/plant_sample' do not fit" in w for w in contents.warnings)
    assert any("3 messages on '/valve_command' do not fit" in w for w in contents.warnings)


def test_the_layout_of_samples_is_taken_from_the_file(tmp_path):
    names = [info.topic for info in reversed(SIGNALS)]
    fields = '\n'.join(f'uint8 {name}_quality\nfloat64 {name}' for name in names)
    text = f'int16 version\nstd_msgs/Header header\n{fields}\nfloat64[] more\n'
    header = STOCK.text('std_msgs/msg/Header').split(f'\n{"=" * 80}\n')
    parts = [text, f'MSG: std_msgs/Header\n{header[0]}', header[1]]
    body = struct.pack('<hxxiII3s', 7, 5, 6, 3, b'ab\0')
    for number in range(5):
        body += struct.pack('<B', 2)
        body += b'\0' * (-len(body) % 8) + struct.pack('<d', 10.0 + number)
    with RecordingWriter(tmp_path / 'log', definitions=STOCK) as writer:
        writer.add_topic('/plant_sample', SAMPLE, definition=f'\n{"=" * 80}\n'.join(parts))
        writer.write('/plant_sample', b'\0\1\0\0' + body, 9, 9)
    found = read_back(open_log(tmp_path / 'log'))
    assert found == [Reading(9, 5 * 10**9 + 6, k, 14.0 - k, 1) for k in range(5)]


def test_qualities_of_recordings_before_there_was_one_for_unknown(tmp_path):
    codes = {1: [1, 2, 3, 0, 1], 2: [0, 1, 2, 2, 0]}  # what 0 to 2 meant then, by those of now
    now = STOCK.text(SAMPLE)
    then = now.replace('uint8 QUALITY_UNKNOWN=0', '')
    for k, name in enumerate(('GOOD', 'UNCERTAIN', 'BAD')):
        then = then.replace(f'QUALITY_{name}={k + 1}', f'QUALITY_{name}={k}')
    found = []
    for text, sent in ((now, codes[1]), (then, codes[2])):
        folder = tmp_path / str(len(found))
        with RecordingWriter(folder, definitions=STOCK) as writer:
            writer.add_topic('/plant_sample', SAMPLE, definition=text)
            writer.write('/plant_sample', plant_sample(START_NS, [1.0] * 5, sent), 9, 9)
        found.append(open_log(folder).readings.quality.tolist())
    assert found[0] == found[1] == [Quality.GOOD, Quality.UNCERTAIN, Quality.BAD, Quality.BAD, 0]


def test_samples_without_a_signal_are_refused(tmp_path):
    with RecordingWriter(tmp_path / 'log', definitions=STOCK) as writer:
        writer.add_topic('/plant_sample', SAMPLE, definition='float64 valve_opening\n')
        writer.write('/plant_sample', float64(1.0), 9, 9)
    with pytest.raises(RecordingError, match=r"'/plant_sample' cannot be read: .*header"):
        open_log(tmp_path / 'log')


# Folders ---------------------------------------------------------------------------------------


def test_splits_are_read_in_the_order_of_their_numbers(tmp_path):
    folder = tmp_path / 'log'
    with RecordingWriter(folder, definitions=STOCK) as writer:
        writer.add_topic('/valve_opening', FLOAT64)
        for step in range(12):
            writer.write('/valve_opening', float64(step), START_NS, START_NS)
            writer.rotate()
    assert open_log(folder).readings.value.tolist() == list(range(12))
    (folder / 'metadata.yaml').unlink()
    assert open_log(folder).readings.value.tolist() == list(range(12))


@pytest.mark.parametrize('text', ['', 'a: [', 'rosbag2_bagfile_information: 3', '&a [*a, *a]'])
def test_a_broken_metadata_file_does_no_harm(tmp_path, text):
    path, wanted, _ = write_chunks(tmp_path / 'log')
    (path.parent / 'metadata.yaml').write_text(text)
    assert read_back(open_log(path.parent)) == wanted


def test_what_is_missing_or_not_named_is_told(tmp_path):
    path, wanted, _ = write_chunks(tmp_path / 'log')
    foreign(path.parent / 'other.mcap')
    path.with_name('log_1.mcap.part').write_bytes(b'')
    metadata = path.parent / 'metadata.yaml'
    text = metadata.read_text().replace('"log_0.mcap"\n', '"log_0.mcap"\n    - "log_7.mcap"\n', 1)
    metadata.write_text(text)
    contents = open_log(path.parent)
    assert read_back(contents) == wanted
    assert "'log_7.mcap' is named in metadata.yaml and is not there." in contents.warnings
    assert 'other.mcap: not named in metadata.yaml, not read.' in contents.warnings
    assert any('log_1.mcap.part: is empty' in warning for warning in contents.warnings)


def test_names_in_the_metadata_file_do_not_lead_out_of_the_folder(tmp_path):
    path, wanted, _ = write_chunks(tmp_path / 'log')
    secret = foreign(tmp_path / 'secret.mcap')
    metadata = path.parent / 'metadata.yaml'
    metadata.write_text(metadata.read_text().replace('"log_0.mcap"\n', f'"{secret}"\n', 1))
    assert len(read_back(open_log(path.parent))) == len(wanted)


def test_compression_of_rosbag2_is_refused_with_the_cure(tmp_path):
    path, _, _ = write_chunks(tmp_path / 'log')
    metadata = path.parent / 'metadata.yaml'
    text = metadata.read_text().replace('compression_mode: ""', 'compression_mode: FILE')
    metadata.write_text(text)
    with pytest.raises(RecordingError, match=r"compressed file by file.*'ros2 bag convert'"):
        open_log(path.parent)


def test_files_that_disagree_about_a_topic_are_refused(tmp_path):
    folder = tmp_path / 'log'
    for number, kind in ((0, FLOAT64), (1, 'std_msgs/msg/Bool')):
        with RecordingWriter(folder, name='log', definitions=STOCK) as writer:
            writer.add_topic('/x', kind)
            writer.write('/x', float64(1.0), number, number)
    with pytest.raises(RecordingError, match="'/x' has two types"):
        open_log(folder)


# Bad inputs ------------------------------------------------------------------------------------


def bad_inputs(folder):
    (folder / 'empty.mcap').write_bytes(b'')
    (folder / 'zeros.mcap').write_bytes(bytes(5000))
    (folder / 'text.mcap').write_text('time,valve_opening_percent\n')
    (folder / 'magic.mcap').write_bytes(b'\x89MCAP0\r\n')
    (folder / 'strange.bin').write_bytes(b'abcdefgh')
    (folder / 'old.db3').write_bytes(b'SQLite format 3\0')
    (folder / 'nothing').mkdir()
    (folder / 'sqlite').mkdir()
    (folder / 'sqlite' / 'a.db3').write_bytes(b'SQLite format 3\0')
    os.mkfifo(folder / 'fifo.mcap')
    (folder / 'device.mcap').symlink_to('/dev/zero')
    (folder / 'loop.mcap').symlink_to(folder / 'loop.mcap')
    foreign(folder / 'silent.mcap', count=0)
    return [
        ('empty.mcap', 'is empty'),
        ('zeros.mcap', 'is not an MCAP file'),
        ('text.mcap', 'is not an MCAP file'),
        ('magic.mcap', 'holds no messages'),
        ('strange.bin', 'neither an .mcap file nor'),
        ('old.db3', 'sqlite3'),
        ('nothing', 'has no .mcap file'),
        ('sqlite', 'sqlite3'),
        ('fifo.mcap', 'is not a regular file'),
        ('device.mcap', 'is not a regular file'),
        ('loop.mcap', 'cannot be opened'),
        ('silent.mcap', 'holds no messages'),
        ('gone.mcap', 'cannot be opened (no such file or directory)'),
        ('x' * 300 + '.mcap', 'cannot be opened (file name too long)'),
        ('a\0b.mcap', 'is not a name of a file'),
    ]


def test_every_bad_input_is_one_sentence(tmp_path):
    for name, problem in bad_inputs(tmp_path):
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


def chunk(content, compression=b'zstd', size=None, packed=None, crc=None):
    packed = zstandard.ZstdCompressor().compress(content) if packed is None else packed
    size = len(content) if size is None else size
    crc = zlib.crc32(content) if crc is None else crc
    body = struct.pack('<QQQI', 0, 0, size, crc)
    body += struct.pack('<I', len(compression)) + compression + struct.pack('<Q', len(packed))
    body += packed
    return struct.pack('<BQ', 6, len(body)) + body


def hostile_files():
    gib = 1 << 30
    zeros = bytes(1 << 20)
    bomb = zstandard.ZstdCompressor(level=1).compressobj(size=gib)
    packed = b''.join(bomb.compress(zeros) for _ in range(gib >> 20)) + bomb.flush()
    nameless = zstandard.ZstdCompressor(write_content_size=False).compressobj()
    unsized = b''.join(nameless.compress(zeros) for _ in range(gib >> 20)) + nameless.flush()
    channel = struct.pack('<HHI1sI3sI', 1, 0, 1, b'x', 3, b'cdr', 0)
    channels = b''.join(
        struct.pack('<BQHHIII', 4, 16, number % 65536, 0, 0, 0, 0) for number in range(10**6)
    )
    twice = b''.join(
        struct.pack('<BQ', 4, len(body)) + body for body in (channel, channel.replace(b'x', b'y'))
    )
    record = struct.pack('<BQ', 5, 2**63)
    schema = struct.pack('<H', 1) + b''.join(
        struct.pack('<I', len(text)) + text
        for text in (FLOAT64.encode(), b'ros2msg', b'float64 data')
    )
    opening = b'/valve_opening'
    channel = struct.pack('<HHI14sI3sI', 1, 1, len(opening), opening, 3, b'cdr', 0)
    topic = b''.join(
        struct.pack('<BQ', op, len(body)) + body for op, body in ((3, schema), (4, channel))
    )
    message = struct.pack('<BQHIQQ', 5, 34, 1, 0, 1, 1) + float64(1.0)
    return {
        'honest zstd bomb': chunk(b'', size=gib, packed=packed),
        'lying zstd bomb': chunk(b'', size=100, packed=packed),
        'zstd bomb of no stated size': chunk(b'', size=60 << 20, packed=unsized),
        'lz4 bomb': chunk(b'', b'lz4', 100, lz4.frame.compress(bytes(200 << 20))),
        'many full chunks of zeros': chunk(bytes(60 << 20)) * 2000,
        'unknown compression': chunk(b'', b'xz\0\0', 10, b'abc'),
        'a million channels': chunk(channels),
        'a channel defined twice': chunk(twice),
        'a message longer than the world': chunk(record),
        'nested chunks': chunk(chunk(chunk(b''))),
        'overlapping heads': chunk(b'', b'', 10, b'abc', 7)[:49] * 40000,
        'endless lengths': (b'\x06' + b'\xff' * 8) * 10000,
        'records of no length': struct.pack('<BQ', 12, 0) * 50000,
        'a chunk of nothing': chunk(b''),
        'the same message without end': chunk(topic + message * 600_000) * 20,
    }


@pytest.fixture(scope='module')
def hostile():
    return hostile_files()


HOSTILE = (
    'honest zstd bomb',
    'lying zstd bomb',
    'zstd bomb of no stated size',
    'lz4 bomb',
    'many full chunks of zeros',
    'unknown compression',
    'a million channels',
    'a channel defined twice',
    'a message longer than the world',
    'nested chunks',
    'overlapping heads',
    'endless lengths',
    'records of no length',
    'a chunk of nothing',
)
# Read in part, as far as their size justifies.
CUT_SHORT = ('the same message without end',)


def test_all_hostile_files_are_tried(hostile):
    assert sorted(hostile) == sorted(HOSTILE + CUT_SHORT)


@pytest.mark.parametrize('name', HOSTILE)
def test_hostile_files_are_refused(tmp_path, hostile, name):
    path = tmp_path / 'hostile.mcap'
    path.write_bytes(b'\x89MCAP0\r\n' + hostile[name])
    with pytest.raises(RecordingError):
        open_log(path)


@pytest.mark.parametrize('name', CUT_SHORT)
def test_hostile_files_are_cut_short_and_it_is_told(tmp_path, hostile, name):
    path = tmp_path / 'hostile.mcap'
    path.write_bytes(b'\x89MCAP0\r\n' + hostile[name])
    contents = open_log(path)
    assert 0 < len(contents.readings) < 4_000_000
    assert any('far more than its size justifies' in warning for warning in contents.warnings)


def test_a_folder_whose_metadata_names_nothing_that_is_there_is_read_and_says_so(tmp_path):
    first, *_ = write_chunks(tmp_path / 'first')
    moved = tmp_path / 'first' / 'second.mcap'
    first.rename(moved)
    (tmp_path / 'first' / 'metadata.yaml').write_text(
        'rosbag2_bagfile_information:\n  storage_identifier: mcap\n'
        '  relative_file_paths: [gone.mcap]\n'
    )
    log = open_log(tmp_path / 'first')
    assert len(log.readings)
    told = ' '.join(log.warnings)
    assert 'all are read' in told
    assert 'not read' not in told
