# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a monitor said, as tables: the same in CSV and Parquet, and what the messages say."""

import json

import numpy as np
import pandas as pd
import pytest
from monitor_recording import START_NS, Monitor, alarm, cdr, head, recording

from valveflow_ros.interface.files import write_outputs
from valveflow_ros.logs import open_log

pytest.importorskip('pyarrow')
HEALTH = 'diagnostic_msgs/msg/DiagnosticArray'
ROWS = {'curves': 1, 'predictions': 5, 'alarms': 2, 'diagnoses': 1, 'health': 2}


@pytest.fixture(scope='module')
def log(tmp_path_factory):
    folder = recording(tmp_path_factory.mktemp('log') / 'said', seconds=5)
    monitor = Monitor(folder)
    monitor.writer.add_topic('/diagnostics', HEALTH)
    status = [
        {'level': 1, 'name': 'valveflow_monitor: fit', 'message': 'too old', 'hardware_id': 'U1',
         'values': [{'key': 'Age of the curve (s)', 'value': '7'}]},
        {'level': 0, 'name': 'valveflow_monitor: recorder', 'message': 'recording'},
    ]  # fmt: skip
    monitor.say('/diagnostics', cdr(HEALTH, {'header': head(START_NS), 'status': status}))
    monitor.say('alarms', alarm(START_NS, 0, 'Gone, "again"; 3 MW.'))
    monitor.writer.close()
    return open_log(folder)


@pytest.fixture(scope='module')
def folder(log, tmp_path_factory):
    home = tmp_path_factory.mktemp('tables')
    for suffix in ('.csv', '.parquet'):
        counts = {path.name: n for path, n in write_outputs(log, home / f'said{suffix}').items()}
        assert counts == {f'said_{kind}{suffix}': n for kind, n in ROWS.items()}
    assert len(list(home.iterdir())) == 2 * len(ROWS)
    return home


def test_values_are_those_of_the_messages(log, folder):
    curves, predictions = (
        pd.read_parquet(folder / f'said_{kind}.parquet') for kind in ('curves', 'predictions')
    )
    topic = '/valveflow_monitor/prediction'
    decoder = log.decoder(topic)
    wanted = [decoder.decode(m.data) for m in log.iter_messages([topic])]
    assert list(predictions.residual_mw) == [w['residual_mw'] for w in wanted]
    ns = [w['header']['stamp']['sec'] * 10**9 for w in wanted]
    assert list(predictions.time.astype(np.int64)) == ns
    (curve,) = curves.itertuples()
    assert list(curve.breakpoints) == [1000.0, 1500.0, 2200.0]
    assert (curve.unit_tag, curve.topic) == ('U1', '/valveflow_monitor/characteristic')
    assert curve.window_end == pd.Timestamp(START_NS, tz='UTC')
    assert pd.isna(curve.shift_since)
    # Health has a row for each item.
    rows = pd.read_csv(folder / 'said_health.csv')
    assert list(rows.message) == ['too old', 'recording']
    assert json.loads(rows['values'][0]) == [{'key': 'Age of the curve (s)', 'value': '7'}]


def same_cell(theirs, ours):
    if isinstance(ours, np.ndarray):
        return len(json.loads(theirs)) == len(ours)
    if isinstance(ours, pd.Timestamp):
        return pd.Timestamp(theirs) == ours
    return theirs == ours or (pd.isna(theirs) and (pd.isna(ours) or ours == ''))


def test_csv_and_parquet_say_the_same(folder):
    for kind in ROWS:
        parquet = pd.read_parquet(folder / f'said_{kind}.parquet')
        csv = pd.read_csv(folder / f'said_{kind}.csv')
        assert list(csv.columns) == list(parquet.columns)
        for name in parquet.columns:
            pairs = zip(csv[name], parquet[name], strict=True)
            assert all(same_cell(*pair) for pair in pairs), (kind, name)
