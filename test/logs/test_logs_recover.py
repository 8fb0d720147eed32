# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
import os
import shutil
import subprocess
import sys

import pytest
import yaml
from damage import records
from log_files import FLOAT64, START_NS, STOCK, float64, read_back, write_chunks
from mcap.opcode import Opcode
from mcap.reader import make_reader

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs import RecordingWriter, open_log, recover_leftovers
from valveflow_ros.logs.mcap.recover import recover
from valveflow_ros.logs.part_file import is_held

AnyReader = pytest.importorskip('rosbags.highlevel').AnyReader

DIE_WRITING = """
import os, sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from log_files import write_chunks
write_chunks(Path(sys.argv[2]), close=False)
os._exit(0)
"""


@pytest.fixture(scope='module')
def dead(tmp_path_factory):
    """Return what a process left that ended without a word."""
    folder = tmp_path_factory.mktemp('dead') / 'log'
    here = os.path.dirname(__file__)
    paths = os.pathsep.join([os.path.dirname(os.path.dirname(here)), *sys.path])
    environment = {**os.environ, 'PYTHONPATH': paths}
    command = [sys.executable, '-c', DIE_WRITING, here, str(folder)]
    subprocess.run(command, check=True, env=environment)
    return folder


@pytest.fixture
def folder(dead, tmp_path):
    """Return a folder with that in it."""
    return shutil.copytree(dead, tmp_path / 'log')


def left_in(folder):
    return folder / f'{folder.name}_0.mcap.part'


def test_an_unfinished_file_becomes_one_that_stock_readers_open(tmp_path):
    part, wanted, writer = write_chunks(tmp_path / 'log', close=False)
    writer.abandon()
    out = tmp_path / 'new' / 'whole.mcap'
    steps = []
    report = recover(part, out, progress=lambda done, total: steps.append((done, total)))
    assert (report.messages, report.chunks, report.damaged_chunks) == (len(wanted), 20, 0)
    assert (report.bytes_read, report.bytes_written) == (part.stat().st_size, out.stat().st_size)
    assert 'was not finished' in report.warnings[0]
    assert steps[-1][0] <= steps[-1][1] == part.stat().st_size
    with out.open('rb') as stream:
        reader = make_reader(stream, validate_crcs=True)
        times = [message.log_time for _, _, message in reader.iter_messages()]
        attachments = [a.data for a in reader.iter_attachments()]
    assert times == [w.log_time_ns for w in wanted]
    assert attachments == [b'a: 1\n']
    with AnyReader([out]) as reader:
        assert reader.message_count == len(wanted)
    assert read_back(open_log(out)) == wanted


def test_chunks_are_copied_as_they_are(tmp_path):
    path, _, _ = write_chunks(tmp_path / 'log')
    recover(path, tmp_path / 'copy.mcap')
    first, second = path.read_bytes(), (tmp_path / 'copy.mcap').read_bytes()
    name = b'\4\0\0\0zstd'
    places = range(len(first))
    marks = [k for k in places if first[k] == 6 and first[k + 37 : k + 45] == name]
    assert len(marks) >= 20
    for mark in marks:
        size = int.from_bytes(first[mark + 1 : mark + 9], 'little')
        assert first[mark : mark + 9 + size] in second


def test_nothing_is_overwritten(tmp_path):
    path, _, _ = write_chunks(tmp_path / 'log')
    before = path.read_bytes()
    with pytest.raises(RecordingError, match='exists already'):
        recover(path, path)
    assert path.read_bytes() == before


@pytest.mark.parametrize('content', [b'', b'\x89MCAP0\r\n', bytes(4000)])
def test_where_nothing_is_intact_nothing_is_made(tmp_path, content):
    (tmp_path / 'bad.mcap').write_bytes(content)
    with pytest.raises(RecordingError, match=r'\.$'):
        recover(tmp_path / 'bad.mcap', tmp_path / 'out.mcap')
    assert [p.name for p in tmp_path.iterdir()] == ['bad.mcap']


def test_an_output_that_cannot_be_written_is_one_sentence(tmp_path):
    path, _, _ = write_chunks(tmp_path / 'log')
    (tmp_path / 'file').write_text('')
    with pytest.raises(RecordingError, match='cannot be written'):
        recover(path, tmp_path / 'file' / 'out.mcap')


def test_leftovers_of_the_dead_are_finished(folder):
    part = left_in(folder)
    assert part.exists()
    (folder / 'log_7.mcap.part').write_bytes(b'')
    [report] = recover_leftovers(folder)
    assert (report.source, report.out) == (part, folder / 'log_0.mcap')
    assert sorted(p.name for p in folder.iterdir()) == ['log_0.mcap', 'metadata.yaml']
    contents = open_log(folder)
    assert contents.warnings == ()
    assert len(contents.readings) == report.messages == 400
    info = yaml.safe_load((folder / 'metadata.yaml').read_text())['rosbag2_bagfile_information']
    assert info['message_count'] == 400
    assert info['relative_file_paths'] == ['log_0.mcap']
    with AnyReader([folder]) as reader:
        assert reader.message_count == 400
    assert recover_leftovers(folder) == ()


def test_the_name_within_the_recovered_file_is_its_own(folder):
    recover_leftovers(folder)
    text = open_log(folder / 'log_0.mcap').metadata['rosbag2']['serialized_metadata']
    assert yaml.safe_load(text)['relative_file_paths'] == ['log_0.mcap']


def test_a_living_recorder_is_left_alone(tmp_path):
    part, _, writer = write_chunks(tmp_path / 'log', close=False)
    assert is_held(part)
    assert recover_leftovers(tmp_path / 'log') == ()
    assert part.exists()
    writer.abandon()
    assert not is_held(part)
    assert len(recover_leftovers(tmp_path / 'log')) == 1


def test_a_crash_between_the_two_steps_of_a_recovery_loses_nothing(folder):
    part = left_in(folder)
    copy = part.read_bytes()
    recover_leftovers(folder)
    part.write_bytes(copy)
    assert len(open_log(folder).readings) == 400
    [report] = recover_leftovers(folder)
    assert report.messages == 400
    assert len(open_log(folder).readings) == 400


def test_what_cannot_be_recovered_stays_and_does_not_stop_a_recorder(folder):
    part = left_in(folder)
    raw = bytearray(part.read_bytes()[:3000])
    for place in range(200, len(raw), 50):
        raw[place] ^= 255
    part.write_bytes(raw)
    assert recover_leftovers(folder) == ()
    assert part.exists()
    with RecordingWriter(folder, definitions=STOCK) as writer:
        writer.add_topic('/valve_opening', FLOAT64)
        writer.write('/valve_opening', float64(1.0), START_NS, START_NS)
    assert (folder / 'log_1.mcap').exists()
    assert part.read_bytes() == raw


def test_a_part_whose_only_chunk_was_begun_goes(folder):
    """What was never whole was never counted as written; a damaged chunk stays for its owner."""
    part = left_in(folder)
    raw = part.read_bytes()
    first = next(begin for op, begin, _ in records(raw + bytes(8)) if op == Opcode.CHUNK)
    for size in (9, 40, first, first + 5, first + 60, first + 300):
        part.write_bytes(raw[:size])
        assert recover_leftovers(folder) == ()
        assert not part.exists(), size
    damaged = bytearray(raw[: first + 300])
    damaged[first + 2] ^= 1
    part.write_bytes(damaged)
    assert recover_leftovers(folder) == ()
    assert part.exists()
