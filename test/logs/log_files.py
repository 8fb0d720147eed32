# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Small recordings, the reader of others, and slow truths for the tests of logs."""

import os
import struct
import time
from io import BytesIO
from typing import NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader, SeekingReader

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs import (
    Definitions,
    Recorder,
    RecorderSettings,
    RecordingWriter,
    open_log,
)
from valveflow_ros.logs.mcap.records import MAGIC, RECORD_HEAD
from valveflow_ros.records import SIGNALS, SampleTable, Signal

START_NS = 1_700_000_000_000_000_000
FLOAT64 = 'std_msgs/msg/Float64'
SAMPLE = 'valveflow_msgs/msg/PlantSample'
# No ROS installation may change what a test sees.
STOCK = Definitions([])
QUICK = RecorderSettings(
    flush_period_s=0.002, sync_period_s=0.01, retry_s=0.002, retry_max_s=0.01, free_floor_bytes=0
)
PATIENCE_S = float(os.environ.get('VALVEFLOW_TEST_PATIENCE_S', 20.0))


class Reading(NamedTuple):
    log_time_ns: int
    time_ns: int
    signal: int
    value: float
    quality: int


class Told(NamedTuple):
    topic: str
    log_ns: int
    publish_ns: int
    data: bytes


def float64(value, order='<'):
    mark = b'\x00\x01\x00\x00' if order == '<' else b'\x00\x00\x00\x00'
    return mark + struct.pack(f'{order}d', value)


def plant_sample(stamp_ns, values, quality, frame_id='HV101', order='<'):
    """Encode a PlantSample field by field."""
    body = struct.pack(f'{order}iI', stamp_ns // 10**9, stamp_ns % 10**9)
    text = frame_id.encode() + b'\0'
    body += struct.pack(f'{order}I', len(text)) + text
    for value, code in zip(values, quality, strict=True):
        body += b'\0' * (-len(body) % 8) + struct.pack(f'{order}dB', value, code)
    return (b'\x00\x01\x00\x00' if order == '<' else b'\x00\x00\x00\x00') + body


def read_back(contents):
    r = contents.readings
    columns = contents.log_time_ns, r.time_ns, r.signal, r.value, r.quality
    return [Reading(*row) for row in zip(*(c.tolist() for c in columns), strict=True)]


def messages_of(contents):
    return [Told(m.topic, *m[2:]) for m in contents.iter_messages()]


def write_chunks(folder, chunks=20, per_chunk=5, close=True):
    """Write four Float64 topics; every value and time is told apart from every other."""
    writer = RecordingWriter(folder, definitions=STOCK, attachments={'parameters.yaml': b'a: 1\n'})
    wanted = []
    for info in SIGNALS[:4]:
        writer.add_topic(f'/unit1/{info.topic}', FLOAT64)
    for step in range(chunks * per_chunk):
        for info in SIGNALS[:4]:
            number = 4 * step + int(info.signal)
            time_ns = START_NS + step * 10**9
            value = 1.0 + number * 0.001
            log_ns = time_ns + 1000 + int(info.signal)
            writer.write(f'/unit1/{info.topic}', float64(value), log_ns, time_ns)
            wanted.append(Reading(log_ns, time_ns, int(info.signal), value, 0))
        if step % per_chunk == per_chunk - 1:
            writer.flush()
    if close:
        writer.close()
    path = folder / f'{folder.name}_0.mcap'
    return (path if close else path.with_name(path.name + '.part')), wanted, writer


def write_part(folder, chunks=20):
    part, wanted, writer = write_chunks(folder, chunks, close=False)
    writer.abandon()
    return part, wanted


def write_messages(folder, topics, messages, definition=None):
    with RecordingWriter(folder, definitions=STOCK) as writer:
        for topic, type_name in topics.items():
            writer.add_topic(topic, type_name, definition=definition)
        for message in messages:
            writer.write(*message)
    return folder / f'{folder.name}_0.mcap'


def same_arrays(first, second):
    """Return whether two records of arrays are equal, NaN to NaN."""
    names = list(first.__dataclass_fields__)
    pairs = [(np.asarray(getattr(r, n)) for r in (first, second)) for n in names]
    return all(np.array_equal(a, b, equal_nan=a.dtype.kind == 'f') for a, b in pairs)


def wander(n, seed, command=False):
    """Return a table of wandering signals, some of whose values are missing or doubtful."""
    rng = np.random.default_rng(seed)
    time_ns = START_NS + np.cumsum(rng.integers(1, 3_000_000_000, n))
    columns = {Signal(k): 50 + np.cumsum(rng.normal(size=n)) for k in range(5 if command else 4)}
    for column in columns.values():
        column[rng.random(n) < 0.05] = np.nan
    doubts = {s: (rng.random(n) < 0.1).astype(np.uint8) for s in columns}
    return SampleTable.from_columns(time_ns, columns, doubts)


def stock(file, seek=True, sort=True):
    """Return what the library `mcap` reads, every checksum compared."""
    return [told for told, _ in numbered(file, seek, sort)]


def numbered(file, seek=True, sort=True):
    """Return the same, each with its sequence number."""
    raw = file if isinstance(file, bytes) else file.read_bytes()
    reader = (SeekingReader if seek else NonSeekingReader)(BytesIO(raw), validate_crcs=True)
    return [
        (Told(channel.topic, m.log_time, m.publish_time, bytes(m.data)), m.sequence)
        for _, channel, m in reader.iter_messages(log_time_order=sort)
    ]


def records(raw):
    """Return kind, begin and end of every record of an intact file, finished or not."""
    position, found = len(MAGIC), []
    while position < len(raw) - len(MAGIC):
        op, length = RECORD_HEAD.unpack_from(raw, position)
        end = position + RECORD_HEAD.size + length
        found.append((op, position, end))
        position = end
    return found


def chunk_ends(raw):
    return [end for op, _, end in records(raw) if op == Opcode.CHUNK]


def record_heads(raw):
    """Return every byte that belongs to the kind or the length of a record."""
    size = RECORD_HEAD.size
    return [place for _, begin, _ in records(raw) for place in range(begin, begin + size)]


def names_in(folder):
    return sorted(p.name for p in folder.iterdir())


def against_chunks(found, wanted, per_chunk):
    """Return how many whole chunks are missing, and what was found that is in no whole chunk."""
    left, missing = list(found), 0
    for first in range(0, len(wanted), per_chunk):
        chunk = list(wanted[first : first + per_chunk])
        if left[: len(chunk)] == chunk:
            left = left[len(chunk) :]
        else:
            missing += 1
    return missing, left


def wait_for(condition):
    end_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end_s, 'waited in vain'
        time.sleep(0.001)


def recorder_of(folder, settings=QUICK, **more):
    recorder = Recorder(folder, settings, definitions=STOCK, **more)
    recorder.add_topic('/valve_opening', FLOAT64)
    return recorder


def record(recorder, first, count=1, topic='/valve_opening'):
    """Hand in messages whose values are their numbers, one each nanosecond."""
    for number in range(first, first + count):
        recorder.record(topic, float64(number), START_NS + number, START_NS + number)


def put(recorder, first, count=1):
    """Do the same and wait until all before are on disk, too."""
    record(recorder, first, count)
    wait_for(lambda: recorder.status().written == first + count)


def rotate(recorder):
    wait_for(lambda: recorder.status().queued == 0)
    finished = recorder.status().files_finished
    recorder.rotate()
    wait_for(lambda: recorder.status().files_finished > finished)


def balanced(status):
    columns = status.written + status.queued + status.lost + status.removed
    return status.received == columns + sum(status.dropped.values())


def values_in(folder):
    try:
        return open_log(folder).readings.value.tolist()
    except RecordingError:
        return []


def numbers_in_chunks(raw):
    """Return the number of messages of each chunk, by the indexes that follow it."""
    counts = []
    for op, begin, end in records(raw):
        if op == Opcode.CHUNK:
            counts.append(0)
        elif op == Opcode.MESSAGE_INDEX:
            counts[-1] += (end - begin - RECORD_HEAD.size - 6) // 16
    return counts
