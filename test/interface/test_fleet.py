# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``fleet``: the numbers of the single verbs, whatever happens to workers and logs."""

import json
import os
import shutil
import signal
import threading
import time
from dataclasses import replace
from glob import glob
from html import escape

import pandas as pd
import pytest

import valveflow_ros as vf
from valveflow_ros.errors import InputError, RecordingError, ValveflowError
from valveflow_ros.interface import Progress
from valveflow_ros.interface.fleets import fleet as interface
from valveflow_ros.interface.fleets.unit_logs import UnitLog, read_fleet, read_options
from valveflow_ros.interface.fleets.unit_month import FleetTask, key_of, unit_month
from valveflow_ros.report.words import duration

pytest.importorskip('distributed')
pytest.importorskip('pyarrow')
WORDS = ['--no-diagnosis', '--set', 'diagnosis_hour=-1']
GIVEN = {'diagnosis_hour': -1}
TIMES = ('read_s', 'identify_s', 'diagnose_s', 'monitor_s', 'task_s')


@pytest.fixture(scope='module')
def plants(simulation, tmp_path_factory):
    folder = tmp_path_factory.mktemp('plants')
    frame = simulation.to_dataframe().iloc[::10]
    later = frame.assign(time=frame.time + pd.Timedelta(days=31))
    for unit, logs in (('007', (frame, later)), ('broken', (None, frame))):
        (folder / unit).mkdir()
        for name, log in zip(('2026-9', '2026-10'), logs, strict=True):
            path = folder / unit / f'{name}.csv'
            path.write_text('no log\n') if log is None else log.to_csv(path, index=False)
    return folder


@pytest.fixture(scope='module')
def client():
    with interface.connected('') as client:
        yield client


class Told(Progress):
    def __init__(self):
        self.all = []

    def __call__(self, share, what):
        self.all.append((share, what))

    def say(self, sentence):
        self.all.append(sentence)


@pytest.fixture(scope='module')
def ran(plants, client, tmp_path_factory):
    out, told = tmp_path_factory.mktemp('out'), Told()
    address = client.scheduler.address
    found = vf.fleet([plants], out, scheduler=address, options=WORDS, progress=told)
    # What is under way is told before the first log is done.
    bounded, begins, first, *_, last = told.all
    assert 'bounded to' in bounded
    assert 'compiles first' in begins
    assert first[0] == 0.0
    assert first[1].startswith('first 007 2026-9')
    assert last[0] == 1.0
    return found


def files(folder):
    """Return the bytes of all files below a folder, rows without their times."""
    found = {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob('*') if p.is_file()}
    for name in [n for n in found if n.endswith('row.json')]:
        row = json.loads(found[name])['row']
        found[name] = json.dumps({k: v for k, v in row.items() if k not in TIMES}).encode()
    return found


def task_of(ran, plants, unit='007', name='2026-9', **more):
    how = read_options(WORDS)
    log = UnitLog(unit, name, plants / unit / f'{name}.csv', how)
    return FleetTask(log, ran.folder, **{'before': '', 'first': '', **more})


def test_files_are_those_of_the_single_verbs_byte_by_byte(ran, plants, tmp_path):
    log = plants / '007' / '2026-10.csv'
    before = ran.folder / 'units' / '007' / '2026-9' / 'identify'
    verbs = {
        'identify': vf.identify(log, reference=before, parameters=GIVEN),
        'diagnose': vf.diagnose(log, model=before, parameters=GIVEN),
        'monitor': vf.monitor(log, reference=before, diagnose=False, parameters=GIVEN),
    }
    for verb, found in verbs.items():
        found.write(tmp_path / verb)
        theirs = ran.folder / 'units' / '007' / '2026-10' / verb
        assert files(tmp_path / verb) == files(theirs)
        assert 'report.html' in files(theirs)


def test_the_data_set_has_a_row_for_each_log_with_what_the_files_say(ran):
    rows = ran.to_dataframe().set_index(['unit', 'log'])
    assert list(rows.loc['007'].index) == ['2026-9', '2026-10']
    row, place = rows.loc['007', '2026-10'], ran.folder / 'units' / '007' / '2026-10'
    curve = json.loads((place / 'identify' / 'characteristic.json').read_text())
    names = ('u_from', 'u_to', 'slope', 'intercept', 'slope_stderr', 'intercept_stderr', 'samples')
    assert list(row.pieces) == [{n: p[n] for n in names} for p in curve['pieces']]
    assert row.model_id == curve['model_id']
    assert row.reference == 'units/007/2026-9/identify/characteristic.json'
    shift = json.loads((place / 'identify' / 'shift.json').read_text())
    assert (row.shift_moved, row.shift_sentence) == (False, shift['sentence'])
    # The same record a month later: the same curve.
    assert row.change_mean_mw == pytest.approx(0.0, abs=1e-9)
    verdict = json.loads((place / 'diagnose' / 'diagnosis.json').read_text())['verdict']
    assert row.verdict == verdict
    assert row.versions['valveflow'] == vf.__version__
    assert 0.0 < row.monitor_s < row.task_s


def test_a_broken_log_costs_one_row_with_a_sentence(ran):
    rows = ran.to_dataframe().set_index(['unit', 'log'])
    assert list(rows.loc['broken'].status) == ['failed', 'done']
    (sentence,) = rows.loc['broken', '2026-9'].sentences
    assert '2026-9.csv' in sentence
    assert sentence.endswith('.')
    assert ran.failed == 1
    # The log after it is what a first log is.
    same = rows.loc['broken', '2026-10'].model_id == rows.loc['007', '2026-9'].model_id
    assert same
    assert escape(sentence) in (ran.folder / 'fleet.html').read_text()


def test_pages_link_to_files_that_are_there(ran):
    overview = (ran.folder / 'fleet.html').read_text()
    assert 'href="units/007/report.html"' in overview
    page = (ran.folder / 'units' / '007' / 'report.html').read_text()
    for verb in ('identify', 'diagnose', 'monitor'):
        assert f'href="2026-10/{verb}/report.html"' in page
        assert (ran.folder / 'units' / '007' / '2026-10' / verb / 'report.html').is_file()


def test_a_second_run_does_nothing_again_and_a_changed_log_all_that_follows(
    ran, plants, client, tmp_path
):
    again, copy = tmp_path / 'out', tmp_path / 'plants'
    shutil.copytree(ran.folder, again)
    shutil.copytree(plants, copy)
    address = client.scheduler.address
    before = {n: b for n, b in files(again).items() if not n.endswith('.parquet')}
    found = vf.fleet([copy], again, scheduler=address, options=WORDS)
    assert (found.anew, found.unchanged, found.failed) == (0, 4, 1)
    assert {n: b for n, b in files(again).items() if not n.endswith('.parquet')} == before
    pd.testing.assert_frame_equal(found.to_dataframe(), ran.to_dataframe())
    # Its last row is gone: its own curve, and so the reference of the next.
    changed = copy / '007' / '2026-9.csv'
    changed.write_text(changed.read_text().rsplit('\n', 2)[0] + '\n')
    found = vf.fleet([copy / '007'], again, scheduler=address, options=WORDS)
    assert (found.anew, found.unchanged) == (2, 0)
    # The data set is that of the logs that were named.
    assert set(found.to_dataframe().unit) == {'007'}


@pytest.mark.parametrize('change', ['options', 'first'])
def test_what_a_row_follows_from_is_in_its_key(change, ran, plants):
    task = task_of(ran, plants)
    kept = json.loads((task.place / 'row.json').read_text())
    assert unit_month(task) == {**kept['row'], 'anew': False}
    others = {
        'options': replace(task, of=replace(task.of, options=read_options(['--no-diagnosis']))),
        'first': replace(task, first='fleet.html'),
    }
    assert key_of(task) == kept['key'] != key_of(others[change])


def test_a_killed_worker_changes_nothing(ran, plants, client, tmp_path):
    out, killed = tmp_path / 'out', []

    def kill():
        # In the middle of the first task: the log is read, no row is there yet.
        until = time.monotonic() + 60.0
        # (Not `Path.glob`: it raises where a folder is renamed while it is listed.)
        while not glob(f'{out}/units/*/*/identify') and time.monotonic() < until:
            time.sleep(0.02)
        for pid in client.run(os.getpid).values():
            os.kill(pid, signal.SIGKILL)
            killed.append(pid)

    thread = threading.Thread(target=kill)
    thread.start()
    log = plants / '007' / '2026-9.csv'
    found = vf.fleet([log], out, scheduler=client.scheduler.address, options=WORDS)
    thread.join()
    assert killed
    assert (found.anew, found.failed) == (1, 0)
    place = out / 'units' / '007' / '2026-9'
    assert files(place) == files(ran.folder / 'units' / '007' / '2026-9')


def test_a_task_that_kills_its_workers_costs_its_row(ran, plants, client):
    scheduler = client.cluster.scheduler
    before, scheduler.allowed_failures = scheduler.allowed_failures, 0
    try:
        chain = (task for task in [task_of(ran, plants)])
        ((_, row),) = interface.spread(client, lambda _: os.kill(os.getpid(), 9), [chain])
    finally:
        scheduler.allowed_failures = before
    assert row['status'] == 'failed'
    assert row['sentences'] == [
        '1 workers that did it died one after the other, as for want of memory; the next run '
        'tries it again.'
    ]


def test_what_may_go_better_is_tried_again(ran, plants, tmp_path, monkeypatch):
    lost = unit_month(replace(task_of(ran, plants), folder=tmp_path / 'elsewhere'))
    assert 'must be on a disk that all workers share' in lost['sentences'][0]
    other = unit_month(replace(task_of(ran, plants), version='0.0.9'))
    assert 'install the same version' in other['sentences'][0]

    def full(*_):
        raise MemoryError

    monkeypatch.setattr('valveflow_ros.interface.fleets.unit_month.open_log', full)
    short = unit_month(replace(task_of(ran, plants), folder=tmp_path))
    assert short['sentences'] == ['There is not enough memory for this log on the worker.']
    assert not list(tmp_path.rglob('row.json'))


def test_logs_that_are_not_in_order_are_refused(ran, plants, tmp_path):
    curve = 'units/007/2026-10/identify/characteristic.json'
    shutil.copytree(ran.folder / 'units' / '007', tmp_path / 'units' / '007')
    row = unit_month(replace(task_of(ran, plants, before=curve, first=curve), folder=tmp_path))
    assert row['sentences'] == [
        "The log begins before '2026-10', which stands before it: name the logs of a unit in the "
        'order of time.'
    ]


@pytest.mark.parametrize(('rows', 'overlaps'), [(1, False), (2, True)])
def test_logs_that_overlap_are_refused_and_those_that_touch_are_not(
    ran, plants, simulation, tmp_path, rows, overlaps
):
    """``rows`` of the one in front are in the next one too."""
    frame = simulation.to_dataframe().iloc[::10]
    first = frame.time.iloc[-rows]
    log = tmp_path / 'next.csv'
    frame.assign(time=frame.time - frame.time.iloc[0] + first).to_csv(log, index=False)
    curve = 'units/007/2026-9/identify/characteristic.json'
    shutil.copytree(ran.folder / 'units' / '007', tmp_path / 'units' / '007')
    task = replace(task_of(ran, plants, before=curve, first=curve), folder=tmp_path)
    row = unit_month(replace(task, of=replace(task.of, name='next', log=log)))
    if overlaps:
        seconds = (frame.time.iloc[-1] - first).total_seconds()
        assert row['sentences'] == [
            f"The log begins {duration(seconds)} before the end of '2026-9', which stands before "
            'it: cut one, so that no row counts twice.'
        ]
    else:
        assert (row['status'], row['sentences']) == ('done', [])


# Which logs there are.


def made(folder, *names):
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text('time\n')
    return folder


def told(units):
    return {unit: [log.name for log in logs] for unit, logs in units.items()}


def test_units_are_folders_and_logs_are_in_the_order_of_their_names(tmp_path):
    made(tmp_path, 'U1/2026-10.csv', 'U1/2026-9.parquet', 'north/U2/a.mcap', 'U1/notes.txt',
         'U1/bag/metadata.yaml', 'out/units/U1/x.csv', '.hidden/x.csv')  # fmt: skip
    expected = {'U1': ['2026-9', '2026-10', 'bag'], 'U2': ['a']}
    found = told(read_fleet([tmp_path], output=tmp_path / 'out'))
    assert {unit: sorted(logs) for unit, logs in found.items()} == {
        unit: sorted(logs) for unit, logs in expected.items()
    }
    assert found['U1'][:2] == expected['U1'][:2]
    globbed = told(read_fleet([tmp_path / 'U*' / '2026*']))
    assert globbed == {'U1': ['2026-9', '2026-10']}


def test_a_file_with_its_metadata_is_a_log_and_splits_are_one(tmp_path):
    made(tmp_path, 'U1/2026-01.mcap', 'U2/a/a_0.mcap', 'U2/a/a_1.mcap', 'U3/b.csv', 'U3/c_0.mcap')
    named = {'U1': ['2026-01.mcap'], 'U2/a': ['a_0.mcap', 'a_1.mcap'], 'U3': ['c_0.mcap']}
    for folder, names in named.items():
        text = f'rosbag2_bagfile_information:\n  relative_file_paths: [{", ".join(names)}]\n'
        (tmp_path / folder / 'metadata.yaml').write_text(text)
    assert told(read_fleet([tmp_path])) == {'U1': ['2026-01'], 'U2': ['a'], 'U3': ['b', 'c_0']}


@pytest.mark.parametrize('mark', [',', ';'])
def test_a_manifest_names_units_logs_and_options(mark, tmp_path):
    made(tmp_path, 'a/1.csv', 'a/2.csv', 'b/1.csv')
    rows = [('Unit', 'Log', 'Options'), ('X 1', 'a', ''),
            ('Y', 'b/1.csv', '--set alarm_floor=2 --column valve_opening=CV')]  # fmt: skip
    manifest = tmp_path / 'fleet.csv'
    manifest.write_text('\ufeff' + '\n'.join(mark.join(row) for row in rows) + '\n')
    found = read_fleet([manifest], ['--set', 'alarm_floor=3', '--constant', 'valve_command=50'])
    assert told(found) == {'X 1': ['1', '2'], 'Y': ['1']}
    x, y = found['X 1'][0].options, found['Y'][0].options
    assert (x.parameters, y.parameters) == ({'alarm_floor': 3.0}, {'alarm_floor': 2.0})
    assert y.mapping.columns['valve_opening'].theirs == 'CV'
    assert x.mapping.constants == y.mapping.constants == {'valve_command': 50.0}


# The files that are there, the rows, and what is said of them.
BAD_MANIFESTS = [
    (['U/1.csv'], 'U,U/1.csv\nU,U/2.csv', 'line 3: {}/U/2.csv: cannot be opened (no such'),
    (['a/1.csv', 'b/1.csv'], 'U,a\nU,b', "Unit 'U' has two logs of one name"),
    (['a/1.csv', 'b/2.csv'], 'U,a\nu,b', "hold two units of one name, 'U' and 'u'"),
    (['a/1.csv'], 'U/1,a', "line 2: 'U/1' cannot be the name of a unit"),
    (['a/1.csv'], '', 'is a manifest without a row'),
    (['a/1.csv'], 'U', 'line 2: a unit and its log are wanted'),
    (['a/1.csv'], 'U,a,--colum x=y', "line 2: A fleet has no option '--colum' for a log"),
    (['a/1.csv'], 'U,a,--set', 'line 2: --set wants a value after it'),
    (['a/1.csv'], "U,a,--set 'x", 'line 2: No closing quotation'),
    (['a/1.csv'], 'U,a,--set model_file=m.json', 'model_file has no place in a fleet'),
]


def test_a_manifest_that_cannot_be_meant(tmp_path):
    for k, (files, manifest, sentence) in enumerate(BAD_MANIFESTS):
        folder = made(tmp_path / f'{k}', *files)
        (folder / 'fleet.csv').write_text(f'unit,log,options\n{manifest}\n')
        with pytest.raises(ValveflowError) as refused:
            read_fleet([folder / 'fleet.csv'])
        assert sentence.format(folder) in str(refused.value)
        assert str(refused.value).endswith('.')


def test_folders_that_cannot_be_meant(tmp_path):
    made(tmp_path, 'north/U1/1.csv', 'south/U1/2.csv', 'empty/x.txt')
    with pytest.raises(InputError, match="hold two units of one name, 'U1'"):
        read_fleet([tmp_path])
    with pytest.raises(InputError, match='There is no log in'):
        read_fleet([tmp_path / 'empty'])
    (tmp_path / 'fleet.csv').write_text('unit,log\nU1,north/U1\n')
    with pytest.raises(InputError, match='is a manifest: name it instead of'):
        read_fleet([tmp_path])


def test_a_scheduler_that_is_not_there(plants, tmp_path, monkeypatch):
    monkeypatch.setattr(interface, '_WAIT_S', 1)
    with pytest.raises(RecordingError, match='no Dask scheduler answers there within 1 s'):
        vf.fleet([plants], tmp_path, scheduler='tcp://127.0.0.1:9')
    with pytest.raises(ValveflowError, match='names no port'):
        vf.fleet([plants], tmp_path, scheduler='nonsense://x')


def test_a_missing_extra_is_told_before_any_work(plants, tmp_path, monkeypatch):
    monkeypatch.setattr(interface, 'find_spec', lambda name: None if name == 'dask' else name)
    with pytest.raises(InputError, match='needs dask, which is not installed: pip install dask'):
        vf.fleet([plants], tmp_path / 'out')
    assert not (tmp_path / 'out').exists()
