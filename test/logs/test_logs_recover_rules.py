# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What holds of recovery, part files and small files wherever the disk fails."""

from __future__ import annotations

import errno
import gc
import os
import shutil
import stat
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from damage import records
from fault_points import SHORT, Faults
from log_files import FLOAT64, START_NS, STOCK, float64, read_back, write_chunks
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from valveflow_ros.errors import RecordingError
from valveflow_ros.logs import RecordingWriter, open_log, part_file, recover_leftovers
from valveflow_ros.logs.mcap.chunk_file import ChunkBuilder, ChunkFile, PackedChunk
from valveflow_ros.logs.mcap.records import RECORD_HEAD, TopicTable, pack
from valveflow_ros.logs.mcap.recover import recover
from valveflow_ros.logs.part_file import (
    PartFile,
    is_held,
    make_folder,
    sync_folder,
    taken,
    write_whole,
)

MAIN = threading.main_thread().name


@pytest.fixture(scope='module')
def left(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a part that a writer left, with the values 0 to 399 as messages."""
    part, _, writer = write_chunks(tmp_path_factory.mktemp('left') / 'log', close=False)
    writer.abandon()
    return part


class Once(Faults):
    """One call fails and the next ones do not."""

    def _fail(self, *call: Any) -> Any:
        self.heal()
        return super()._fail(*call)


@pytest.fixture(scope='module', autouse=True)
def spared() -> Iterator[None]:
    """Spare the collector what earlier tests left: it is asked before and after each recovery."""
    gc.collect()
    gc.freeze()
    yield
    gc.unfreeze()


def open_descriptors() -> int:
    # What earlier tests left to the collector may go at any moment.
    gc.collect()
    return len(os.listdir('/proc/self/fd'))


def placed(left: Path, folder: Path, *numbers: int) -> list[Path]:
    """Put copies of a part into a folder."""
    folder.mkdir(exist_ok=True)
    parts = [folder / f'log_{k}.mcap.part' for k in numbers]
    for part in parts:
        shutil.copyfile(left, part)
    return parts


def listed(folder: Path) -> dict[str, int]:
    """Return the files that the folder's list names, with their messages."""
    text = (folder / 'metadata.yaml').read_text()
    info = yaml.safe_load(text)['rosbag2_bagfile_information']
    return {f['path']: f['message_count'] for f in info['files']}


# --- recovery -------------------------------------------------------------------------------


@pytest.mark.parametrize('call', range(1, 41))
def test_wherever_a_recovery_fails_the_next_one_completes_it(
    left: Path, tmp_path: Path, call: int
) -> None:
    """All messages stand in the part or in the whole file at every moment, never in neither."""
    folder = tmp_path / 'log'
    part, other = placed(left, folder, 0, 3)
    before = open_descriptors()
    faults = Faults(MAIN, call, errno.EIO)
    with faults.active():
        try:
            recover_leftovers(folder)
        except RecordingError as error:
            assert 'input/output error' in str(error).lower()
    assert open_descriptors() == before
    for k, path in enumerate((part, other)):
        whole = path.with_suffix('')
        assert path.exists() or whole.exists(), k
        if whole.exists():
            assert len(open_log(whole).readings) == 400
    faults.heal()
    reports = recover_leftovers(folder)
    assert all(report.messages == 400 for report in reports)
    names = {p.name for p in folder.iterdir() if not p.name.startswith('.')}
    assert names == {'log_0.mcap', 'log_3.mcap', 'metadata.yaml'} or not reports
    assert names >= {'log_0.mcap', 'log_3.mcap'}
    for name in ('log_0.mcap', 'log_3.mcap'):
        assert len(open_log(folder / name).readings) == 400
    assert not any(folder.glob('*.part'))


def test_a_file_in_the_way_of_another_is_no_reason_to_leave_that_one(
    left: Path, tmp_path: Path
) -> None:
    """Of some leftovers each is finished on its own, and the list has what is whole."""
    folder = tmp_path / 'log'
    placed(left, folder, 0, 2, 5)
    (folder / 'log_1.mcap.part').write_bytes(os.urandom(3000))
    (folder / 'log_4.mcap.part').write_bytes(b'')
    (folder / 'foreign.txt.part').write_bytes(b'not ours')
    held = PartFile(folder / 'log_7.mcap')
    reports = recover_leftovers(folder)
    assert [r.source.name for r in reports] == [f'log_{k}.mcap.part' for k in (0, 2, 5)]
    assert [r.out for r in reports] == [folder / f'log_{k}.mcap' for k in (0, 2, 5)]
    assert {(r.messages, r.chunks, r.damaged_chunks) for r in reports} == {(400, 20, 0)}
    assert listed(folder) == {f'log_{k}.mcap': 400 for k in (0, 2, 5)}
    stay = {'log_1.mcap.part', 'foreign.txt.part', 'log_7.mcap.part'}
    assert {p.name for p in folder.glob('*.part')} == stay
    assert recover_leftovers(folder) == ()
    held.discard()


def test_a_folder_without_leftovers_is_not_touched(tmp_path: Path) -> None:
    write_chunks(tmp_path / 'log')
    folder = tmp_path / 'log'
    (folder / 'metadata.yaml').write_text('mine')
    times = {p: p.stat().st_mtime_ns for p in folder.iterdir()}
    assert recover_leftovers(folder) == ()
    assert {p: p.stat().st_mtime_ns for p in folder.iterdir()} == times


@pytest.mark.parametrize('lost', range(0, 20, 3))
def test_a_damaged_chunk_costs_itself_and_is_counted(
    left: Path, tmp_path: Path, lost: int
) -> None:
    """Whole minus recovered is exactly what stood in the chunk that was hit."""
    raw = bytearray(left.read_bytes())
    chunks = [(begin, end) for op, begin, end in records(raw + bytes(8)) if op == Opcode.CHUNK]
    begin, end = chunks[lost]
    raw[(begin + end) // 2] ^= 4
    bad = tmp_path / 'bad.mcap'
    bad.write_bytes(raw)
    report = recover(bad, tmp_path / 'whole.mcap')
    assert (report.messages, report.chunks, report.damaged_chunks) == (380, 19, 1)
    assert (report.source, report.out) == (bad, tmp_path / 'whole.mcap')
    assert report.bytes_read == len(raw)
    assert report.warnings
    shutil.copyfile(left, tmp_path / 'all.mcap')
    every = set(read_back(open_log(tmp_path / 'all.mcap')))
    kept = read_back(open_log(tmp_path / 'whole.mcap'))
    assert open_log(tmp_path / 'whole.mcap').warnings == ()
    missing = sorted(every - set(kept))
    assert (len(kept), len(missing)) == (380, 20)
    assert missing == sorted(every)[20 * lost : 20 * lost + 20]


def chunk(number: int, topic: str, log_ns: int) -> PackedChunk:
    """Return a chunk of one message, with the tables it needs."""
    builder = ChunkBuilder()
    builder.add(1, number, log_ns, log_ns, float64(number))
    table = pack(Schema(1, b'float64 data', 'ros2msg', FLOAT64), Channel(1, topic, 'cdr', {}, 1))
    return builder.build(table)


def test_a_chunk_that_contradicts_an_earlier_one_is_left_out_counted_and_told(
    tmp_path: Path,
) -> None:
    """Its checksum is right, but its message would be taken for one of another topic."""
    file = ChunkFile(PartFile(tmp_path / 'a.mcap'), 'test')
    for k, topic in enumerate(['/valve_opening', '/other', '/valve_opening']):
        file.put_chunk(chunk(k, topic, START_NS + k))
    file.abandon()
    report = recover(tmp_path / 'a.mcap.part', tmp_path / 'b.mcap')
    assert (report.messages, report.chunks, report.damaged_chunks) == (2, 2, 1)
    assert any('damaged' in sentence for sentence in report.warnings)
    found = open_log(tmp_path / 'b.mcap')
    assert found.readings.value.tolist() == [0.0, 2.0]
    assert list(found.topics) == ['/valve_opening']


@pytest.mark.parametrize('topic', ['/valve_opening', '/other'])
def test_a_summary_adds_the_topics_that_no_chunk_names_or_the_file_is_refused(
    tmp_path: Path, topic: str
) -> None:
    """Where chunk and summary give one channel two names, neither is believed."""
    file = ChunkFile(PartFile(tmp_path / 'a.mcap'), 'test')
    file.put_chunk(chunk(0, '/valve_opening', START_NS))
    summary = TopicTable()
    for known in (Schema(1, b'float64 data', 'ros2msg', FLOAT64), Channel(1, topic, 'cdr', {}, 1),
                  Channel(2, '/silent', 'cdr', {}, 1)):  # fmt: skip
        op = Opcode.SCHEMA if isinstance(known, Schema) else Opcode.CHANNEL
        summary.add(op, pack(known)[RECORD_HEAD.size :])
    file.finish(summary)
    before = open_descriptors()
    if topic == '/other':
        with pytest.raises(RecordingError, match=r'a\.mcap: contradicts itself'):
            recover(tmp_path / 'a.mcap', tmp_path / 'b.mcap')
        assert [p.name for p in tmp_path.iterdir()] == ['a.mcap']
    else:
        recover(tmp_path / 'a.mcap', tmp_path / 'b.mcap')
        assert sorted(open_log(tmp_path / 'b.mcap').topics) == ['/silent', '/valve_opening']
    assert open_descriptors() == before


def test_recovering_what_was_recovered_changes_no_message(left: Path, tmp_path: Path) -> None:
    shutil.copyfile(left, tmp_path / 'a.mcap')
    for source, out in (('a.mcap', 'b.mcap'), ('b.mcap', 'c.mcap')):
        recover(tmp_path / source, tmp_path / out)
    first, second = (open_log(tmp_path / name) for name in ('b.mcap', 'c.mcap'))
    assert read_back(first) == read_back(second)
    assert first.attachments == second.attachments
    assert set(first.metadata) == set(second.metadata)
    assert (tmp_path / 'b.mcap').stat().st_size == (tmp_path / 'c.mcap').stat().st_size


def test_an_output_that_fails_half_way_leaves_nothing(left: Path, tmp_path: Path) -> None:
    shutil.copyfile(left, tmp_path / 'a.mcap')
    before = open_descriptors()
    calls = 0
    for call in range(1, 80):
        faults = Once(MAIN, call, errno.ENOSPC)
        out = tmp_path / f'out{call}' / 'b.mcap'
        with faults.active():
            try:
                recover(tmp_path / 'a.mcap', out)
            except RecordingError as error:
                calls += 1
                opened = f'{tmp_path}/a.mcap: cannot be opened (no space left on device).'
                written = f'{out}: cannot be written (no space left on device).'
                assert str(error) in (opened, written)
                # The last step may have given it its name; then it is whole.
                if out.exists():
                    assert len(open_log(out).readings) == 400
        # One that was never begun may stay, and goes as soon as somebody looks.
        assert not [p for p in tmp_path.glob(f'out{call}/*.part') if p.stat().st_size]
        assert open_descriptors() == before
    assert calls > 10


def test_a_refused_file_is_not_made_twice(left: Path, tmp_path: Path) -> None:
    """A part that somebody holds under the name of the output is theirs."""
    shutil.copyfile(left, tmp_path / 'a.mcap')
    held = PartFile(tmp_path / 'b.mcap')
    held.write(b'theirs')
    with pytest.raises(RecordingError, match=r'cannot be written \(file exists\)'):
        recover(tmp_path / 'a.mcap', tmp_path / 'b.mcap')
    assert held.part.read_bytes() == b'theirs'
    held.close()
    recover(tmp_path / 'a.mcap', tmp_path / 'b.mcap')
    assert len(open_log(tmp_path / 'b.mcap').readings) == 400


def test_why_a_folder_cannot_be_read_is_said_in_the_systems_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for error, words in (
        (OSError(errno.EIO, 'Input/output error'), r'recovered \(input/output error\)'),
        (OSError('Only this'), r'recovered \(only this\)'),
    ):

        def broken(_path: Path, _pattern: str, error: OSError = error) -> list[Path]:
            raise error

        monkeypatch.setattr(Path, 'glob', broken)
        with pytest.raises(RecordingError, match=words):
            recover_leftovers(tmp_path)


def test_two_at_a_time_finish_each_leftover_once(left: Path, tmp_path: Path) -> None:
    folder = tmp_path / 'log'
    placed(left, folder, *range(4))
    found: list[int] = []
    threads = [
        threading.Thread(
            target=lambda: found.extend(r.messages for r in recover_leftovers(folder))
        )
        for _ in range(3)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == [400] * 4
    assert {p.name for p in folder.glob('log*')} == {f'log_{k}.mcap' for k in range(4)}


# --- files ----------------------------------------------------------------------------------


@pytest.fixture(params=[0o000, 0o022, 0o077, 0o277])
def umask(request: pytest.FixtureRequest) -> Iterator[None]:
    before = os.umask(request.param)
    yield
    os.umask(before)


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def test_every_folder_that_is_made_is_its_owners_and_others_stay(tmp_path: Path) -> None:
    (tmp_path / 'there').mkdir()
    (tmp_path / 'there').chmod(0o755)
    before = os.umask(0)
    make_folder(tmp_path / 'there' / 'a' / 'b')
    make_folder(tmp_path / 'there' / 'a' / 'b')
    os.umask(before)
    assert [mode(tmp_path / 'there' / p) for p in ('.', 'a', 'a/b')] == [0o755, 0o700, 0o700]


def test_a_folder_that_another_makes_at_the_same_moment_is_as_good(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between looking and making, each folder on the way may have come into being."""
    (tmp_path / 'a' / 'b').mkdir(parents=True)
    monkeypatch.setattr(os.path, 'isdir', lambda _path: False)
    make_folder(tmp_path / 'a' / 'b' / 'c')
    assert (tmp_path / 'a' / 'b' / 'c').is_dir()
    (tmp_path / 'file').write_bytes(b'')
    with pytest.raises(NotADirectoryError):
        make_folder(tmp_path / 'file')


def small(folder: Path) -> None:
    write_whole(folder / 'small', b'new and longer')


def part(folder: Path) -> None:
    (folder / 'a.mcap').unlink(missing_ok=True)
    file = PartFile(folder / 'a.mcap')
    try:
        file.write(b'some')
        file.sync()
        file.publish()
    finally:
        file.close()


def look(folder: Path) -> None:
    (folder / 'b.mcap.part').write_bytes(b'')
    is_held(folder / 'b.mcap.part')


def again(folder: Path) -> None:
    (folder / 'c.mcap.part').write_bytes(b'left')
    PartFile(folder / 'c.mcap', replace=True).discard()


@pytest.mark.parametrize('act', [small, part, look, again, sync_folder])
@pytest.mark.parametrize('error', [errno.EIO, errno.ENOSPC])
def test_no_failure_keeps_a_descriptor_or_a_draft(
    tmp_path: Path, act: Callable[[Path], None], error: int
) -> None:
    before = open_descriptors()
    failed = 0
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
        names = {p.name for p in tmp_path.iterdir()}
        assert not [n for n in names if n.endswith('.tmp')] or act is small
        for path in tmp_path.glob('*.part'):
            assert not is_held(path)
            path.unlink()
    assert failed > 0


def test_a_small_file_is_whole_however_little_a_write_takes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = os.write
    monkeypatch.setattr(part_file.os, 'write', lambda d, data: write(d, bytes(data)[:3]))
    for size in (0, 1, 3, 4, 100):
        write_whole(tmp_path / 'small', bytes(range(size)))
        assert (tmp_path / 'small').read_bytes() == bytes(range(size))
    assert [p.name for p in tmp_path.iterdir()] == ['small']


def test_a_draft_that_cannot_be_written_goes_and_the_old_file_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / 'small').write_bytes(b'old')
    real = os.write

    def full(descriptor: int, data: bytes) -> int:
        real(descriptor, bytes(data)[:1])
        raise OSError(errno.ENOSPC, 'No space left on device')

    monkeypatch.setattr(part_file.os, 'write', full)
    with pytest.raises(OSError, match='No space'):
        write_whole(tmp_path / 'small', b'new')
    monkeypatch.undo()
    assert [p.name for p in tmp_path.iterdir()] == ['small']
    assert (tmp_path / 'small').read_bytes() == b'old'


def test_nothing_is_written_through_a_link(tmp_path: Path) -> None:
    (tmp_path / 'victim').write_bytes(b'not ours')
    (tmp_path / 'a.mcap.part').symlink_to(tmp_path / 'victim')
    with pytest.raises(OSError, match='File exists'):
        PartFile(tmp_path / 'a.mcap')
    with pytest.raises(OSError, match='symbolic links'), taken(tmp_path / 'a.mcap.part'):
        pass
    draft = tmp_path / f'.small.{os.getpid()}.{threading.get_ident()}.tmp'
    draft.symlink_to(tmp_path / 'victim')
    with pytest.raises(OSError, match='symbolic links'):
        write_whole(tmp_path / 'small', b'new')
    assert (tmp_path / 'victim').read_bytes() == b'not ours'


def test_a_pipe_in_the_place_of_a_part_makes_nobody_wait(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / 'a.mcap.part')
    done = threading.Thread(target=lambda: is_held(tmp_path / 'a.mcap.part'), daemon=True)
    done.start()
    done.join(10.0)
    assert not done.is_alive()
    assert recover_leftovers(tmp_path) == ()


def test_a_part_is_held_by_one_at_a_time_until_it_is_let_go(tmp_path: Path) -> None:
    file = PartFile(tmp_path / 'a.mcap')
    assert is_held(file.part)
    file.close()
    with taken(file.part) as first, taken(file.part) as second:
        assert (first, second) == (True, False)
    assert not is_held(file.part)
    with taken(file.part) as free:
        assert free
        file.part.unlink()
    (tmp_path / 'a.mcap.part').write_bytes(b'')
    descriptor = os.open(file.part, os.O_RDONLY)
    file.part.unlink()
    os.close(descriptor)
    with pytest.raises(FileNotFoundError):
        is_held(file.part)


def test_a_whole_file_is_on_the_disk_before_it_has_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Data, then name, then the folder that holds the name: in that order, each time."""
    done: list[str] = []
    for name in ('fsync', 'replace'):
        real = getattr(os, name)

        def watched(*given: object, name: str = name, real: Callable[..., None] = real) -> None:
            what = 'folder' if name == 'fsync' and _is_folder(given[0]) else name
            done.append(what)
            real(*given)

        monkeypatch.setattr(part_file.os, name, watched)
    part(tmp_path)
    assert done == ['fsync', 'replace', 'folder']
    done.clear()
    small(tmp_path)
    assert done == ['fsync', 'replace', 'folder']


def _is_folder(descriptor: object) -> bool:
    assert isinstance(descriptor, int)
    return stat.S_ISDIR(os.fstat(descriptor).st_mode)


def test_a_short_write_of_a_recording_is_gone_on_with(tmp_path: Path) -> None:
    for call in range(1, 15):
        folder = tmp_path / str(call)
        with (
            Faults(MAIN, call, SHORT).active(),
            RecordingWriter(folder, definitions=STOCK) as writer,
        ):
            writer.add_topic('/valve_opening', FLOAT64)
            writer.write('/valve_opening', float64(1.5), START_NS, START_NS)
        assert open_log(folder).readings.value.tolist() == [1.5]
