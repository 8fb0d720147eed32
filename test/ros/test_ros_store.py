# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What is kept between runs: saved in time, used only where it fits, and gone on from."""

import errno
import os
import shutil
import threading
import time
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from valveflow_msgs.msg import PlantSample

from valveflow_ros.errors import DataError, RecordingError
from valveflow_ros.logs import LoggedMessage
from valveflow_ros.logs.mcap.definitions import Definitions
from valveflow_ros.monitoring.events import CurveAdopted, JournalKind
from valveflow_ros.monitoring.monitor import Monitor
from valveflow_ros.parameters import Settings
from valveflow_ros.records import NS_PER_S, SIGNALS
from valveflow_ros.ros import encoding
from valveflow_ros.ros.decoding import journal_entry
from valveflow_ros.ros.node import restart, state_store
from valveflow_ros.ros.node.diagnostics import Level
from valveflow_ros.ros.node.engine import LiveEngine, example_curve
from valveflow_ros.ros.node.outputs import OUTPUTS, Output, Outputs
from valveflow_ros.ros.node.restart import Restart
from valveflow_ros.ros.node.state_store import ASIDE, LOCK, STATE, StateFolder, StateStore
from valveflow_ros.signals.align import Aligner
from valveflow_ros.state import from_bytes

CURVE = example_curve(Settings()).with_id()


def settings(folder, **more):
    return Settings({'record_directory': str(folder), **more})


@contextmanager
def store(folder, **more):
    made = StateStore(settings(folder, **more))
    try:
        yield made
    finally:
        made.close()


def written(folder, rows=3, **more):
    """Save a state with some numbers; return its file."""
    with store(folder, **more) as made:
        content = {'settings': dict(settings(folder, **more)), 'numbers': np.arange(1.0 * rows)}
        made.write(content, lambda: True)
    return folder / 'state_unit' / STATE


def rows_of(made):
    """Return how many numbers the saved state has, 0 without one."""
    return 0 if made.saved is None else len(made.saved['numbers'])


def test_only_one_at_a_time_and_the_next_as_soon_as_it_is_gone(tmp_path):
    with store(tmp_path):
        with pytest.raises(RecordingError, match=rf'another monitor \(process {os.getpid()}\)'):
            StateStore(settings(tmp_path))
        for other in ({'unit_tag': 'another'}, {'state_directory': str(tmp_path / 'own')}):
            StateStore(settings(tmp_path, **other)).close()
        for none in ({'keep_state': False}, {'record': False}):
            with store(tmp_path, **none) as made:
                assert not made.on
    written(tmp_path)
    with store(tmp_path) as found:
        assert rows_of(found) == 3


def test_a_state_of_other_parameters_is_used_unless_it_is_of_another_unit(tmp_path):
    for k, (more, words) in enumerate((
        ({'generated_power_unit': 'kW'},
         "It was made with another generated_power_unit ('MW' instead of 'kW')."),
        ({'main_steam_pressure_unit': 'bar', 'model_file': 'x', 'block': 20.0},
         "It was made with another main_steam_pressure_unit ('MPa' instead of 'bar') and "
         "model_file ('' instead of 'x')."),
        ({'block': 20.0, 'window_days': 5.0, 'sample_period': 2.0}, ''),
        ({'alarm_limit': 3.0, 'refit_period': 60.0, 'record_keep': 5}, ''),
    )):  # fmt: skip
        folder = tmp_path / str(k)
        written(folder)
        with store(folder, **more) as found:
            assert (found.saved is None) == bool(words)
            assert words in found.sentence
            # It waits for a run that it fits.
            assert not found.lost


def test_a_mistyped_unit_or_period_costs_no_state(tmp_path):
    path = written(tmp_path)
    for _ in range(2):
        with store(tmp_path, valve_opening_unit='fraction') as found:
            assert found.saved is None
            assert 'a run with the same settings will use it' in found.sentence
        # A young state takes its place at once.
        written(tmp_path, 1, valve_opening_unit='fraction')
        with store(tmp_path) as mended:
            assert (mended.sentence, rows_of(mended)) == ('', 3)
        # The other one is not lost either.
        with store(tmp_path, valve_opening_unit='fraction') as again:
            assert rows_of(again) == 1
        written(tmp_path)
        path.with_name(ASIDE).unlink()
    with store(tmp_path, sample_period=2.0) as found:
        # Its curve and reference are of use; its rows are kept for whoever corrects the mistake.
        assert (found.sentence, rows_of(found)) == ('', 3)
    written(tmp_path, 1, sample_period=2.0)
    with store(tmp_path) as mended:
        assert rows_of(mended) == 3


def test_a_state_of_a_version_with_other_parameters_is_used(tmp_path):
    then = {
        **settings(tmp_path), 'no_longer_there': 3.0, 'alarm_floor': 1e9, 'refit_period': 'daily',
        'alarm_off_delay': 300.0,
    }  # fmt: skip
    del then['reference_after']
    with store(tmp_path) as made:
        made.write({'settings': then}, lambda: True)
    with store(tmp_path) as found:
        assert found.saved is not None
        # What it knew holds; the rest is as by default.
        assert found.saved['settings'] == settings(tmp_path, alarm_off_delay=300.0)


@pytest.mark.parametrize('how', ['cut', 'flipped', 'empty', 'newer', 'folder', 'pipe'])
def test_a_state_that_is_not_whole_is_told_until_the_next_start(tmp_path, how):
    path = written(tmp_path)
    data = path.read_bytes()
    path.unlink()
    half = len(data) // 2
    contents = {
        'cut': data[:-1], 'flipped': data[:half] + bytes([data[half] ^ 1]) + data[half + 1 :],
        'empty': b'', 'newer': data.replace(b'state 2 ', b'state 3 ', 1),
    }  # fmt: skip
    if how == 'folder':
        path.mkdir()
    elif how == 'pipe':
        os.mkfifo(path)
    else:
        path.write_bytes(contents[how])
    with store(tmp_path) as found:
        assert found.saved is None
        assert found.sentence.startswith('The state saved by an earlier run is not used. ')
        assert 'active alarms and reference are not used' in found.sentence
        assert found.sentence.endswith('.')
        assert (found.item().level, found.item().sentence) == (Level.WARN, found.sentence)
    with store(tmp_path) as again:
        item = again.item()
        assert (item.level, item.sentence) == (Level.OK, 'The state is saved regularly.')


@pytest.mark.parametrize('given', ['', '/proc/nothing', '~nobody_of_that_name/x'])
def test_where_nothing_can_be_saved_the_monitor_goes_on_and_says_so(given):
    made = StateStore(Settings({'state_directory': given, 'record': False}))
    assert (made.on, made.saved_s, made.due) == (False, None, False)
    assert made.problem.startswith('The state cannot be saved. ') == bool(given)
    assert given or 'Nothing is kept' in made.item().sentence
    made.write({}, lambda: True)
    with pytest.raises(DataError, match='Curve abc was not saved'):
        made.curve('abc')
    made.close()


def test_an_adopted_curve_is_saved_at_once_and_the_newest_state_last(tmp_path):
    with store(tmp_path) as made:
        made.note([CurveAdopted(CURVE)])
        assert repr(made.curve(CURVE.model_id)) == repr(CURVE)
        with pytest.raises(DataError, match='was not saved'):
            made.curve('another')
        for k in range(5):
            content = {'settings': dict(settings(tmp_path)), 'numbers': np.ones(99_000 + k)}
            made.write(content, lambda: True)
    with store(tmp_path) as found:
        assert rows_of(found) == 99_004
    assert not list((tmp_path / 'state_unit').glob('.*'))


def test_a_state_is_put_in_place_when_the_recording_is_ready_or_after_its_patience(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(state_store, '_PATIENCE_S', 60.0)
    path = tmp_path / 'state_unit' / STATE

    def there():
        return path.read_bytes() if path.exists() else b''

    with store(tmp_path) as made:
        for answers in ([True], [False] * 3 + [True]):
            left, asked, before = list(answers), list[bytes](), there()

            def ready(left=left, asked=asked):
                asked.append(there())
                return left.pop(0)

            made.write({'answers': answers}, ready)
            made.finish()
            # Until it is ready, what was there before is there.
            assert asked == [before] * len(answers)
            assert from_bytes(there()) == {'answers': answers}
        monkeypatch.setattr(state_store, '_PATIENCE_S', 0.3)
        begun = time.monotonic()
        made.write({'never': 'ready'}, lambda: False)
        assert (made.busy, made.due) == (True, False)
        made.finish()
        assert made.saved_s is not None
        assert begun + 0.3 <= made.saved_s <= time.monotonic() < begun + 20.0
        assert not made.busy
        assert from_bytes(there()) == {'never': 'ready'}


def test_what_cannot_be_written_is_a_problem_until_it_can(tmp_path, monkeypatch):
    path = tmp_path / 'state_unit' / STATE

    def failing(self, data):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with store(tmp_path) as made:
        with monkeypatch.context() as patch:
            patch.setattr(StateFolder, 'write', failing)
            for state, said in (
                ({}, f'{path}: the state cannot be saved (no space left on device).'),
                ({'cannot be saved': object()}, 'The state cannot be saved (TypeError: '),
            ):
                made.write(state, lambda: True)
                made.finish()
                assert made.problem.startswith(said)
                assert (made.saved_s, made.item().level) == (None, Level.ERROR)
        made.write({'fine': 1}, lambda: True)
        made.finish()
        assert (made.problem, made.saved_s is None) == ('', False)
        assert from_bytes(path.read_bytes()) == {'fine': 1}


def test_a_disk_that_does_not_answer_is_told_and_not_waited_for(tmp_path, monkeypatch):
    answers, write = threading.Event(), StateFolder.write

    def hanging(self, data):
        answers.wait(60.0)
        write(self, data)

    monkeypatch.setattr(StateFolder, 'write', hanging)
    monkeypatch.setattr(state_store, '_LONGEST_S', 0.05)
    monkeypatch.setattr(state_store, '_STUCK_S', 0.0)
    with store(tmp_path) as made:
        made.write({'first': 1}, lambda: True)
        assert made.item().level == Level.ERROR
        assert 'does not answer' in made.item().sentence
        made.write({'second': 2}, lambda: True)
        (thread,) = (t for t in threading.enumerate() if t.name == 'state writer')
        assert thread.daemon
        assert not made.altered
    assert 'does not answer' in made.problem
    answers.set()
    thread.join()
    # What was being written is whole.
    assert from_bytes((tmp_path / 'state_unit' / STATE).read_bytes()) == {'first': 1}


@pytest.mark.parametrize('what', ['state', 'lock', 'everything', 'folder'])
def test_what_another_program_removes_is_made_again_and_stays_taken(what, tmp_path, monkeypatch):
    monkeypatch.setattr(state_store, '_WATCH_S', 0.0)
    state = {'settings': dict(settings(tmp_path)), 'numbers': np.arange(2.0)}
    folder = tmp_path / 'state_unit'
    acts = {
        'state': (folder / STATE).unlink,
        'lock': (folder / LOCK).unlink,
        'everything': lambda: [path.unlink() for path in folder.iterdir()],
        'folder': lambda: shutil.rmtree(folder),
    }
    with store(tmp_path) as made:
        made.write(state, lambda: True)
        made.finish()
        acts[what]()
        made.watch()
        made.finish()
        assert made.altered == (what != 'lock')
        if made.altered:
            assert 'was removed or changed by another program' in made.problem
            assert made.item().level == Level.ERROR
        with pytest.raises(RecordingError, match=rf'another monitor \(process {os.getpid()}\)'):
            StateStore(settings(tmp_path))
        made.write(state, lambda: True)
    assert made.problem == ''
    with store(tmp_path) as found:
        assert rows_of(found) == 2


def test_who_lost_its_lock_to_another_monitor_says_so_and_writes_nothing(tmp_path):
    with store(tmp_path) as first:
        (tmp_path / 'state_unit' / LOCK).unlink()
        with store(tmp_path) as second:
            for made, rows in ((second, 2), (first, 1)):
                content = {'settings': dict(settings(tmp_path)), 'numbers': np.arange(1.0 * rows)}
                made.write(content, lambda: True)
                made.finish()
            assert 'another monitor' in first.problem
    with store(tmp_path) as found:
        assert rows_of(found) == 2


# Continuing an earlier run

NAMES = {'characteristic': '/m/characteristic', 'breakpoints': '/m/breakpoints'}
TOPICS = {name: f'/m/{name}' for name in OUTPUTS}
LOG_NS = 1_700_000_000_000_000_000
# As `Session` records them: before the first row there is no time of the plant, and the message
# bears the time of the log.
BEFORE, AFTER = Output('characteristic', b'curve', 0), Output('breakpoints', b'knots', 5_000)
WORKER = SimpleNamespace(poll=list)


class Recorded:
    """What was recorded after the state was saved, with the definition of a topic."""

    def __init__(self):
        self.tail = []
        self.definitions = {}

    def since(self, _folder, _after, definitions):
        definitions.update(self.definitions)
        return self.tail


@pytest.fixture
def recorded(monkeypatch):
    made = Recorded()
    monkeypatch.setattr(restart, 'recover_leftovers', lambda _: [])
    monkeypatch.setattr(restart, 'messages_since', made.since)
    return made


def restarted(saved, given, inputs, make=None):
    """Return a restart from a saved state, its engine, and what was logged."""
    whole = {'settings': Settings(), 'log_ns': 1, 'recording': 'folder', 'began': {}, **saved}
    kept = SimpleNamespace(saved=whole, problem='', sentence='', curve=None)
    logged = []
    names = {name: topic for name, topic in whole.get('topics', {}).items() if name not in inputs}
    made = Restart(given, kept, inputs, names, lambda *line: logged.append(line))
    engine = made.engine(make or (lambda settings: LiveEngine(settings, WORKER)))
    assert made.continues
    return made, engine, logged


def snapshot():
    engine = LiveEngine(Settings(), WORKER)
    engine.monitor.set_reference(CURVE)
    return engine.snapshot()


@pytest.mark.parametrize(
    ('said', 'again'),
    [([], [BEFORE, AFTER]), ([BEFORE], [AFTER]), ([AFTER], [BEFORE]), ([AFTER, BEFORE], [])],
)
def test_each_output_stands_in_the_recording_once(said, again, recorded):
    given = Settings()
    recorded.tail = [
        LoggedMessage(NAMES[o.name], 'some/msg/Type', LOG_NS, o.time_ns or LOG_NS, o.data)
        for o in said
    ]
    engine = SimpleNamespace(
        monitor=Monitor(given), aligner=Aligner(given), restore=lambda _: None
    )
    of_tail = iter([[BEFORE, AFTER]])
    outputs = SimpleNamespace(of=lambda _: next(of_tail, []))
    saved = {'engine': None, 'topics': {**NAMES, 'journal': '/m/journal'}}
    ours, found, logged = restarted(saved, given, {}, lambda _: engine)
    assert found is engine
    assert (ours.folder, ours.log_ns) == (Path('folder'), LOG_NS if said else 1)
    assert list(ours.begin(given, engine, outputs)) == again
    (loaded,) = logged
    assert loaded[0] == Level.OK
    assert loaded[1] == (
        'The saved state was loaded, with 0 rows (0 s); '
        'the recording continues in the same folder.'
    )


@pytest.mark.usefixtures('recorded')
def test_a_run_with_other_parameters_goes_on_in_a_new_recording_and_says_what_it_kept():
    told = (
        Level.OK,
        'Since the state was saved steady_min changed. Segments were found again in 0 rows. '
        'The reference and the alarms stay.',
    )
    for more, folder in (({'steady_min': 180.0}, None), ({}, Path('folder'))):
        wanted = Settings({'alarm_floor': 2.0, **more})
        ours, engine, logged = restarted({'topics': TOPICS, 'engine': snapshot()}, wanted, {})
        assert ours.folder == folder
        messages = list(ours.begin(wanted, engine, Outputs('unit')))
        assert engine.monitor.settings == wanted
        assert engine.monitor.reference.curve == CURVE
        kinds = [journal_entry(m.data).kind for m in messages if m.name == 'journal']
        assert kinds == [JournalKind.RESUMED, JournalKind.SETTINGS]
        assert (told in logged) == (folder is None)


@pytest.mark.parametrize('earlier', [False, True])
def test_the_tail_of_an_earlier_run_is_read_by_the_codes_it_was_recorded_with(recorded, earlier):
    text = Definitions().text('valveflow_msgs/msg/PlantSample')
    if earlier:  # before there was a code for unknown
        text = text.replace('QUALITY_GOOD=1', 'QUALITY_GOOD=0')
    recorded.definitions = {'/plant': text}
    values = dict(zip((s.topic for s in SIGNALS), (77.0, 13.0, 538.0, 240.0), strict=False))
    good = 0 if earlier else PlantSample.QUALITY_GOOD
    for k in range(60):
        sample = PlantSample(**values, **{f'{name}_quality': good for name in values})
        time_ns = LOG_NS + k * NS_PER_S
        sample.header.stamp = encoding.to_time(time_ns)
        kind, data = 'valveflow_msgs/msg/PlantSample', encoding.encode(sample)
        recorded.tail.append(LoggedMessage('/plant', kind, time_ns, time_ns, data))
    plant = {'plant_sample': '/plant'}
    saved = {'topics': {**TOPICS, **plant}, 'engine': snapshot()}
    ours, engine, _ = restarted(saved, Settings(), plant)
    list(ours.begin(Settings(), engine, Outputs('unit')))
    counts = engine.aligner.counts()['generated_power']
    assert (counts['accepted'], counts['bad_quality']) == (60, 0)
    # Its folder would hold two meanings of a code.
    assert ours.folder == (None if earlier else Path('folder'))


@pytest.mark.parametrize('how', ['absent', 'other'])
def test_a_state_of_another_version_is_used_where_it_fits_and_the_rest_is_told(how):
    engine = snapshot()
    engine['monitor']['diagnosing'] = {'another': 'version'}
    if how == 'absent':
        del engine['monitor']['diagnosing']
    _, found, logged = restarted({'recording': None, 'engine': engine}, Settings(), {})
    assert found.monitor.reference.curve == CURVE
    assert logged == [(
        Level.WARN, 'The saved state is of another version. Discarded: the last diagnosis. The '
        'reference and the alarms stay.',
    )]  # fmt: skip
