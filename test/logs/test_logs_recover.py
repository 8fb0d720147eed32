# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Recovery, part files and small files: nothing is lost wherever the disk fails."""

import errno
import fcntl
import gc
import os
import shutil
import stat
import subprocess
import sys
import threading
from pathlib import Path

import pytest
import yaml
from fault_points import Faults
from log_files import (
    FLOAT64,
    START_NS,
    STOCK,
    chunk_ends,
    float64,
    names_in,
    read_back,
    records,
    stock,
    write_chunks,
    write_part,
)
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, Schema

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs import RecordingWriter, open_log, part_file, recover, recover_leftovers
from valveflow_ros.logs.mcap.chunk_file import ChunkBuilder, ChunkFile
from valveflow_ros.logs.mcap.records import MAGIC, TopicTable, pack
from valveflow_ros.logs.part_file import (
    PartFile,
    is_held,
    make_folder,
    sync_folder,
    taken,
    write_whole,
)

AnyReader = pytest.importorskip('rosbags.highlevel').AnyReader

MAIN = threading.main_thread().name
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
    """Return the part that a process left that ended without a word: 400 messages, 20 chunks."""
    folder = tmp_path_factory.mktemp('dead') / 'log'
    here = Path(__file__).parent
    paths = os.pathsep.join([str(here.parents[1]), *sys.path])
    command = [sys.executable, '-c', DIE_WRITING, str(here), str(folder)]
    subprocess.run(command, check=True, env={**os.environ, 'PYTHONPATH': paths})
    return folder / 'log_0.mcap.part'


@pytest.fixture
def part(dead, tmp_path):
    """Return a copy of it in a folder of its own."""
    (tmp_path / 'log').mkdir()
    return Path(shutil.copy(dead, tmp_path / 'log'))


def placed(part, *numbers):
    """Put further copies of a part into its folder."""
    names = [f'log_{k}.mcap.part' for k in numbers]
    return [Path(shutil.copy(part, part.with_name(name))) for name in names]


@pytest.fixture(scope='module', autouse=True)
def spared():
    """Spare the collector what earlier tests left: it is asked before and after each recovery."""
    gc.collect()
    gc.freeze()
    yield
    gc.unfreeze()


def open_descriptors():
    # What earlier tests left to the collector may go at any moment.
    gc.collect()
    return len(os.listdir('/proc/self/fd'))


def listed(folder):
    """Return the files that the folder's list names, with their messages."""
    text = (folder / 'metadata.yaml').read_text()
    info = yaml.safe_load(text)['rosbag2_bagfile_information']
    return {f['path']: f['message_count'] for f in info['files']}


# --- recovery -------------------------------------------------------------------------------


def test_an_unfinished_file_becomes_one_that_stock_readers_open(tmp_path):
    part, wanted = write_part(tmp_path / 'log')
    out = tmp_path / 'new' / 'whole.mcap'
    steps = []
    report = recover(part, out, progress=lambda *step: steps.append(step))
    raw = part.read_bytes()
    assert (report.messages, report.chunks, report.damaged_chunks) == (len(wanted), 20, 0)
    assert (report.bytes_read, report.bytes_written) == (len(raw), out.stat().st_size)
    assert 'was not finished' in report.warnings[0]
    assert steps == [(end, len(raw)) for end in chunk_ends(raw)]
    assert [m.log_ns for m in stock(out)] == [w.log_time_ns for w in wanted]
    with out.open('rb') as stream:
        found = make_reader(stream, validate_crcs=True).iter_attachments()
        assert [a.data for a in found] == [b'a: 1\n']
    with AnyReader([out]) as reader:
        assert reader.message_count == len(wanted)
    assert read_back(open_log(out)) == wanted


def test_chunks_are_copied_as_they_are_and_recovering_again_changes_nothing(tmp_path):
    first, _, _ = write_chunks(tmp_path / 'log')
    for source, out in ((first, 'b.mcap'), (tmp_path / 'b.mcap', 'c.mcap')):
        recover(source, tmp_path / out)
    raw, again, third = (p.read_bytes() for p in (first, tmp_path / 'b.mcap', tmp_path / 'c.mcap'))
    chunks = [raw[begin:end] for op, begin, end in records(raw) if op == Opcode.CHUNK]
    assert len(chunks) >= 20
    assert all(chunk in again for chunk in chunks)
    assert len(again) == len(third)
    logs = [open_log(tmp_path / name) for name in ('b.mcap', 'c.mcap')]
    assert read_back(logs[0]) == read_back(logs[1])
    assert logs[0].attachments == logs[1].attachments
    assert set(logs[0].metadata) == set(logs[1].metadata)


@pytest.mark.parametrize('content', [b'', MAGIC, bytes(4000)])
def test_where_nothing_is_intact_nothing_is_made(tmp_path, content):
    (tmp_path / 'bad.mcap').write_bytes(content)
    with pytest.raises(RecordingError, match=r'\.$'):
        recover(tmp_path / 'bad.mcap', tmp_path / 'out.mcap')
    assert names_in(tmp_path) == ['bad.mcap']


def test_what_stands_in_the_way_of_the_output_is_kept(part, tmp_path):
    before = part.read_bytes()
    with pytest.raises(RecordingError, match='exists already'):
        recover(part, part)
    assert part.read_bytes() == before
    (tmp_path / 'file').write_text('')
    with pytest.raises(RecordingError, match='cannot be written'):
        recover(part, tmp_path / 'file' / 'out.mcap')
    # A part that somebody holds under the name of the output is theirs.
    held = PartFile(tmp_path / 'b.mcap')
    held.write(b'theirs')
    with pytest.raises(RecordingError, match=r'cannot be written \(file exists\)'):
        recover(part, tmp_path / 'b.mcap')
    assert held.part.read_bytes() == b'theirs'
    held.close()
    recover(part, tmp_path / 'b.mcap')
    assert len(open_log(tmp_path / 'b.mcap').readings) == 400


def chunk(number, topic):
    """Return a chunk of one message, with the tables it needs."""
    builder = ChunkBuilder()
    builder.add(1, number, START_NS + number, START_NS + number, float64(number))
    return builder.build(pack(*topics(topic)))


def topics(topic):
    return Schema(1, b'float64 data', 'ros2msg', FLOAT64), Channel(1, topic, 'cdr', {}, 1)


def test_a_chunk_that_contradicts_an_earlier_one_is_left_out_counted_and_told(tmp_path):
    """Its checksum is right, but its message would be taken for one of another topic."""
    file = ChunkFile(PartFile(tmp_path / 'a.mcap'), 'test')
    for k, topic in enumerate(['/valve_opening', '/other', '/valve_opening']):
        file.put_chunk(chunk(k, topic))
    file.abandon()
    report = recover(tmp_path / 'a.mcap.part', tmp_path / 'b.mcap')
    assert (report.messages, report.chunks, report.damaged_chunks) == (2, 2, 1)
    assert any('damaged' in sentence for sentence in report.warnings)
    found = open_log(tmp_path / 'b.mcap')
    assert found.readings.value.tolist() == [0.0, 2.0]
    assert list(found.topics) == ['/valve_opening']


@pytest.mark.parametrize('topic', ['/valve_opening', '/other'])
def test_a_summary_adds_the_topics_that_no_chunk_names_or_the_file_is_refused(tmp_path, topic):
    """Where chunk and summary give one channel two names, neither is believed."""
    file = ChunkFile(PartFile(tmp_path / 'a.mcap'), 'test')
    file.put_chunk(chunk(0, '/valve_opening'))
    summary = TopicTable()
    for known in (*topics(topic), Channel(2, '/silent', 'cdr', {}, 1)):
        summary.take(known)
    file.finish(summary)
    before = open_descriptors()
    if topic == '/other':
        with pytest.raises(RecordingError, match=r'a\.mcap: contradicts itself'):
            recover(tmp_path / 'a.mcap', tmp_path / 'b.mcap')
        assert names_in(tmp_path) == ['a.mcap']
    else:
        recover(tmp_path / 'a.mcap', tmp_path / 'b.mcap')
        assert sorted(open_log(tmp_path / 'b.mcap').topics) == ['/silent', '/valve_opening']
    assert open_descriptors() == before


def test_an_output_that_fails_half_way_leaves_nothing(part, tmp_path):
    before, calls = open_descriptors(), 0
    for call in range(1, 80):
        out = tmp_path / f'out{call}' / 'b.mcap'
        with Faults(MAIN, call, errno.ENOSPC, once=True).active():
            try:
                recover(part, out)
            except RecordingError as error:
                calls += 1
                opened = f'{part}: cannot be opened (no space left on device).'
                written = f'{out}: cannot be written (no space left on device).'
                assert str(error) in (opened, written)
                # The last step may have given it its name; then it is whole.
                if out.exists():
                    assert len(open_log(out).readings) == 400
        # One that was never begun may stay, and goes as soon as somebody looks.
        assert not [p for p in tmp_path.glob(f'out{call}/*.part') if p.stat().st_size]
        assert open_descriptors() == before
    assert calls > 10


# --- leftovers ------------------------------------------------------------------------------


def test_leftovers_of_the_dead_are_finished(part):
    """Each is finished on its own, one that is in use or damaged stays, and others are no file."""
    folder = part.parent
    placed(part, 2, 5)
    (folder / 'log_1.mcap.part').write_bytes(os.urandom(3000))
    (folder / 'log_4.mcap.part').write_bytes(b'')
    (folder / 'foreign.txt.part').write_bytes(b'not ours')
    (folder / 'link_0.mcap.part').symlink_to(part)
    (folder / 'folder_0.mcap.part').mkdir()
    held = PartFile(folder / 'log_7.mcap')
    reports = recover_leftovers(folder)
    whole = [folder / f'log_{k}.mcap' for k in (0, 2, 5)]
    assert [r.source for r in reports] == [path.with_name(f'{path.name}.part') for path in whole]
    assert [r.out for r in reports] == whole
    assert {(r.messages, r.chunks, r.damaged_chunks) for r in reports} == {(400, 20, 0)}
    assert listed(folder) == {path.name: 400 for path in whole}
    stay = ['folder_0.mcap.part', 'foreign.txt.part', 'link_0.mcap.part', 'log_1.mcap.part']
    assert sorted(p.name for p in folder.glob('*.part')) == [*stay, 'log_7.mcap.part']
    assert recover_leftovers(folder) == ()
    held.discard()
    for path in whole:
        contents = open_log(path)
        assert (contents.warnings, len(contents.readings)) == ((), 400)
        text = contents.metadata['rosbag2']['serialized_metadata']
        assert yaml.safe_load(text)['relative_file_paths'] == [path.name]


def test_wherever_a_recovery_fails_the_next_one_completes_it(tmp_path):
    """All messages stand in the part or in the whole file at every moment, never in neither."""
    (left, wanted), before = write_part(tmp_path / 'log', chunks=3), open_descriptors()
    for call in range(1, 200):
        folder = tmp_path / f'{call}'
        folder.mkdir()
        parts = [Path(shutil.copy(left, folder / f'log_{k}.mcap.part')) for k in (0, 3)]
        faults = Faults(MAIN, call, errno.EIO)
        with faults.active():
            try:
                recover_leftovers(folder)
            except RecordingError as error:
                assert 'input/output error' in str(error).lower()
        assert open_descriptors() == before, call
        whole = [path.with_suffix('') for path in parts]
        for unfinished, finished in zip(parts, whole, strict=True):
            assert unfinished.exists() or finished.exists()
            if finished.exists():
                assert len(open_log(finished).readings) == len(wanted), call
        reports = recover_leftovers(folder)
        assert all(report.messages == len(wanted) for report in reports), call
        names = {name for name in names_in(folder) if not name.startswith('.')}
        assert names == {'log_0.mcap', 'log_3.mcap', 'metadata.yaml'} or not reports, call
        assert [len(open_log(path).readings) for path in whole] == 2 * [len(wanted)], call
        assert not any(folder.glob('*.part'))
        if faults.failed_at_s is None:
            break
    assert 20 < call < 199


def test_a_folder_without_leftovers_is_not_touched(tmp_path):
    folder = tmp_path / 'log'
    write_chunks(folder)
    (folder / 'metadata.yaml').write_text('mine')
    times = {p: p.stat().st_mtime_ns for p in folder.iterdir()}
    assert recover_leftovers(folder) == ()
    assert {p: p.stat().st_mtime_ns for p in folder.iterdir()} == times


def test_what_cannot_be_recovered_stays_and_does_not_stop_a_recorder(part):
    raw = bytearray(part.read_bytes()[:3000])
    for place in range(200, len(raw), 50):
        raw[place] ^= 255
    part.write_bytes(raw)
    assert recover_leftovers(part.parent) == ()
    with RecordingWriter(part.parent, definitions=STOCK) as writer:
        writer.add_topic('/valve_opening', FLOAT64)
        writer.write('/valve_opening', float64(1.0), START_NS, START_NS)
    assert (part.parent / 'log_1.mcap').exists()
    assert part.read_bytes() == raw


def test_a_part_whose_only_chunk_was_begun_goes(part):
    """What was never whole was never counted as written; a damaged chunk stays for its owner."""
    raw = part.read_bytes()
    first = next(begin for op, begin, _ in records(raw) if op == Opcode.CHUNK)
    damaged = bytearray(raw[: first + 300])
    damaged[first + 2] ^= 1
    sizes = (9, 40, first, first + 5, first + 60, first + 300)
    for content in [*(raw[:size] for size in sizes), damaged]:
        part.write_bytes(content)
        assert recover_leftovers(part.parent) == ()
        assert part.exists() == (content is damaged), len(content)


def test_two_at_a_time_finish_each_leftover_once(part):
    placed(part, 1, 2, 3)
    found = []

    def work():
        found.extend(report.messages for report in recover_leftovers(part.parent))

    threads = [threading.Thread(target=work) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == [400] * 4
    names = {p.name for p in part.parent.glob('log*')}
    assert names == {f'log_{k}.mcap' for k in range(4)}


# --- files ----------------------------------------------------------------------------------


def mode(path):
    return stat.S_IMODE(path.stat().st_mode)


def test_every_folder_that_is_made_is_its_owners_and_others_stay(tmp_path):
    (tmp_path / 'there').mkdir()
    (tmp_path / 'there').chmod(0o755)
    before = os.umask(0)
    make_folder(tmp_path / 'there' / 'a' / 'b')
    make_folder(tmp_path / 'there' / 'a' / 'b')
    os.umask(before)
    assert [mode(tmp_path / 'there' / p) for p in ('.', 'a', 'a/b')] == [0o755, 0o700, 0o700]


def test_a_folder_that_another_makes_at_the_same_moment_is_as_good(tmp_path, monkeypatch):
    """Between looking and making, each folder on the way may have come into being."""
    (tmp_path / 'a' / 'b').mkdir(parents=True)
    monkeypatch.setattr(os.path, 'isdir', lambda _path: False)
    make_folder(tmp_path / 'a' / 'b' / 'c')
    assert (tmp_path / 'a' / 'b' / 'c').is_dir()
    (tmp_path / 'file').write_bytes(b'')
    with pytest.raises(NotADirectoryError):
        make_folder(tmp_path / 'file')


def small(folder):
    write_whole(folder / 'small', b'new and longer')


def whole_part(folder):
    (folder / 'a.mcap').unlink(missing_ok=True)
    file = PartFile(folder / 'a.mcap')
    try:
        file.write(b'some')
        file.sync()
        file.publish()
    finally:
        file.close()


def look(folder):
    (folder / 'b.mcap.part').write_bytes(b'')
    is_held(folder / 'b.mcap.part')


def again(folder):
    (folder / 'c.mcap.part').write_bytes(b'left')
    PartFile(folder / 'c.mcap', replace=True).discard()


@pytest.mark.parametrize('act', [small, whole_part, look, again, sync_folder])
@pytest.mark.parametrize('error', [errno.EIO, errno.ENOSPC])
def test_no_failure_keeps_a_descriptor_or_a_draft(tmp_path, act, error):
    before, failed = open_descriptors(), 0
    for call in range(1, 12):
        (tmp_path / 'small').write_bytes(b'old')
        with Faults(MAIN, call, error).active():
            try:
                act(tmp_path)
            except OSError as found:
                failed += 1
                assert found.errno == error
        assert open_descriptors() == before
        assert (tmp_path / 'small').read_bytes() in (b'old', b'new and longer')
        assert act is small or not any(n.endswith('.tmp') for n in names_in(tmp_path))
        for path in tmp_path.glob('*.part'):
            assert not is_held(path)
            path.unlink()
    assert failed > 0


def test_a_small_file_is_whole_however_little_a_write_takes(tmp_path, monkeypatch):
    write = os.write
    monkeypatch.setattr(part_file.os, 'write', lambda d, data: write(d, bytes(data)[:3]))
    for size in (0, 1, 3, 4, 100):
        write_whole(tmp_path / 'small', bytes(range(size)))
        assert (tmp_path / 'small').read_bytes() == bytes(range(size))
    assert names_in(tmp_path) == ['small']

    def full(descriptor, data):
        write(descriptor, bytes(data)[:1])
        raise OSError(errno.ENOSPC, 'No space left on device')

    monkeypatch.setattr(part_file.os, 'write', full)
    with pytest.raises(OSError, match='No space'):
        write_whole(tmp_path / 'small', b'new')
    assert names_in(tmp_path) == ['small']
    assert (tmp_path / 'small').read_bytes() == bytes(range(100))


def test_nothing_is_written_through_a_link(tmp_path):
    (tmp_path / 'victim').write_bytes(b'not ours')
    draft = tmp_path / f'.small.{os.getpid()}.{threading.get_ident()}.tmp'
    for link in (tmp_path / 'a.mcap.part', draft):
        link.symlink_to(tmp_path / 'victim')
    with pytest.raises(OSError, match='File exists'):
        PartFile(tmp_path / 'a.mcap')
    with pytest.raises(OSError, match='symbolic links'):
        is_held(tmp_path / 'a.mcap.part')
    with pytest.raises(OSError, match='symbolic links'):
        write_whole(tmp_path / 'small', b'new')
    assert (tmp_path / 'victim').read_bytes() == b'not ours'


def test_a_pipe_in_the_place_of_a_part_makes_nobody_wait(tmp_path):
    os.mkfifo(tmp_path / 'a.mcap.part')
    done = threading.Thread(target=lambda: is_held(tmp_path / 'a.mcap.part'), daemon=True)
    done.start()
    done.join(10.0)
    assert not done.is_alive()
    assert recover_leftovers(tmp_path) == ()


def test_a_part_is_held_by_one_at_a_time_until_it_is_let_go(tmp_path):
    file = PartFile(tmp_path / 'a.mcap')
    file.write(b'mine')
    assert is_held(file.part)
    with pytest.raises(FileExistsError):
        PartFile(tmp_path / 'a.mcap', replace=True)
    file.close()
    file.close()
    with taken(file.part) as first, taken(file.part) as second:
        assert (first, second) == (True, False)
    assert not is_held(file.part)
    with pytest.raises(FileExistsError):
        PartFile(tmp_path / 'a.mcap')
    second = PartFile(tmp_path / 'a.mcap', replace=True)
    assert second.part.read_bytes() == b''
    second.discard()
    assert names_in(tmp_path) == []
    with pytest.raises(FileNotFoundError):
        is_held(file.part)


def test_a_part_removed_between_making_and_locking_is_made_again(tmp_path, monkeypatch):
    lock, left = fcntl.flock, [2]

    def raced(descriptor, how):
        lock(descriptor, how)
        if left[0]:
            left[0] -= 1
            (tmp_path / 'a.mcap.part').unlink()

    monkeypatch.setattr(part_file.fcntl, 'flock', raced)
    file = PartFile(tmp_path / 'a.mcap')
    file.write(b'here')
    assert file.part.read_bytes() == b'here'
    assert is_held(file.part)
    file.discard()
    left[0], before = 1000, open_descriptors()
    with pytest.raises(FileNotFoundError):
        PartFile(tmp_path / 'a.mcap')
    assert open_descriptors() == before

    def broken(_descriptor, _how):
        raise OSError(errno.ENOLCK, 'No locks available')

    monkeypatch.setattr(part_file.fcntl, 'flock', broken)
    with pytest.raises(OSError, match='No locks available'):
        PartFile(tmp_path / 'a.mcap')
    assert open_descriptors() == before


def test_a_whole_file_is_on_the_disk_before_it_has_its_name(tmp_path, monkeypatch):
    """Data, then name, then the folder that holds the name: in that order, each time."""
    done = []
    fsync, replace = os.fsync, os.replace

    def synced(descriptor):
        done.append('folder' if stat.S_ISDIR(os.fstat(descriptor).st_mode) else 'fsync')
        fsync(descriptor)

    def replaced(*given):
        done.append('replace')
        replace(*given)

    monkeypatch.setattr(part_file.os, 'fsync', synced)
    monkeypatch.setattr(part_file.os, 'replace', replaced)
    for act in (whole_part, small):
        act(tmp_path)
        assert done == ['fsync', 'replace', 'folder']
        done.clear()


OUTSIDE = (Opcode.HEADER, Opcode.DATA_END, Opcode.STATISTICS, Opcode.CHUNK_INDEX,
           Opcode.MESSAGE_INDEX, Opcode.FOOTER)  # fmt: skip


@pytest.mark.parametrize('kind', OUTSIDE)
def test_a_changed_byte_outside_of_the_chunks_is_reported_and_costs_no_message(tmp_path, kind):
    (sound, _, _), hurt = write_chunks(tmp_path / 'recording'), tmp_path / 'hurt.mcap'
    assert recover(sound, tmp_path / 'again.mcap').warnings == ()
    content = bytearray(sound.read_bytes())
    at = next(start for op, start, _ in records(content) if op == kind)
    content[at + 11] ^= 1
    hurt.write_bytes(content)
    report = recover(hurt, tmp_path / 'mended.mcap')
    assert 'damaged' in ' '.join(report.warnings)
    assert stock(tmp_path / 'mended.mcap') == stock(sound)
