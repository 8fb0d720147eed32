# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""`valveflow import opcua://`: the history of a real server as a log, stopped and taken up."""

import datetime
import importlib.util
import time

import pytest
from opcua_server import OpcUaServer, free_port, mapping, write_mapping

import valveflow_ros as vf
from valveflow_ros.cli.main import main
from valveflow_ros.errors import DataError, RecordingError
from valveflow_ros.interface import Progress
from valveflow_ros.interface.importing.history_import import import_history
from valveflow_ros.records import NS_PER_S, Readings, Signal

T0, HOUR_NS = 1_700_000_000 * NS_PER_S, 3600 * NS_PER_S


class Source:
    """A history of one value a minute, which may fail."""

    name = 'test://here'

    def __init__(self, fail_at=-1):
        self.columns = {s: f'tag {s}' for s in list(Signal)[:4]}
        self.asked = []
        self.fail_at = fail_at

    def read(self, start_ns, end_ns):
        self.asked.append(start_ns)
        if len(self.asked) - 1 == self.fail_at:
            raise DataError('The line is down.')
        times = range(start_ns, end_ns, 60 * NS_PER_S)
        return [Readings.of([(t, s, 10.0 + s, 0) for t in times for s in range(4)])]


def test_what_was_stopped_goes_on(tmp_path):
    path = tmp_path / 'log.mcap'
    broken = Source(fail_at=2)
    with pytest.raises(DataError, match='The line is down'):
        import_history(broken, T0, T0 + 20 * HOUR_NS, path)
    assert not path.exists()
    told = []

    class Heard(Progress):
        def say(self, sentence):
            told.append(sentence)

    again = Source()
    written = import_history(again, T0, T0 + 20 * HOUR_NS, path, progress=Heard())
    assert len(again.asked) == 3
    assert told == ['2 of 5 parts had been read before.']
    assert written.messages == 20 * 60 * 4
    assert not (tmp_path / 'log.mcap.parts').exists()
    whole = import_history(Source(), T0, T0 + 20 * HOUR_NS, tmp_path / 'whole.mcap')
    assert vf.open_log(path).to_dataframe().equals(vf.open_log(whole.path).to_dataframe())


def test_parts_of_something_else_are_not_mixed_and_a_damaged_one_is_named(tmp_path):
    path, end_ns = tmp_path / 'log.mcap', T0 + 20 * HOUR_NS
    with pytest.raises(DataError):
        import_history(Source(fail_at=2), T0, end_ns, path)
    with pytest.raises(RecordingError, match='is of an import of something else'):
        import_history(Source(), T0, end_ns + HOUR_NS, path)
    part = tmp_path / 'log.mcap.parts' / '000001.npz'
    part.write_bytes(b'PK no zip')
    with pytest.raises(RecordingError, match='is damaged; remove it'):
        import_history(Source(), T0, end_ns, path)
    part.unlink()
    assert import_history(Source(), T0, end_ns, path).messages == 20 * 60 * 4


@pytest.mark.skipif(importlib.util.find_spec('asyncua') is None, reason='asyncua is an extra')
def test_the_history_of_a_server_by_the_command(tmp_path, capsys):
    server = OpcUaServer(free_port(), '--history')
    for k in range(5):
        server.set('power', 1000.0 * k)
        time.sleep(0.05)
    server.set('power', 0.0, status='BadSensorFailure')
    path, log = write_mapping(tmp_path, mapping(1)), tmp_path / 'log.mcap'
    begin = datetime.datetime.now(datetime.timezone.utc) - datetime.timedelta(minutes=5)
    end = begin + datetime.timedelta(minutes=10)
    words = ['import', f'opcua://127.0.0.1:{server.port}', '--mapping', str(path), '-o', str(log),
             '--from', begin.isoformat(), '--to', end.isoformat()]  # fmt: skip
    assert main(words) == 0
    readings = vf.open_log(log).readings
    values = readings.value[readings.signal == Signal.GENERATED_POWER].tolist()
    assert values[:6] == [150.0, 0.0, 1.0, 2.0, 3.0, 4.0]
    assert values[6] != values[6]  # bad
    words[words.index('-o') + 1] = str(tmp_path / 'second.mcap')
    server.kill()
    capsys.readouterr()
    assert main(words) == 1
    assert 'nobody listens there' in capsys.readouterr().err


DAY = '--from 2026-01-01 --to 2026-01-02'
REFUSED = [
    ('--from 2026-01-01', 'wants --mapping FILE, --from TIME, --to TIME and -o LOG'),
    ('--from yesterday --to 2026-01-01', "'yesterday' is no time"),
    ('--from 2026-01-02 --to 2026-01-01', '--from must be before --to'),
    (f'{DAY} --unit U9', '--unit must be one of U1'),
    (f'{DAY} --column valve_opening=x', 'says all about the nodes'),
]


def test_what_is_wrong_is_told(tmp_path, capsys):
    pytest.importorskip('asyncua')
    path = write_mapping(tmp_path, mapping(1))
    for words, sentence in REFUSED:
        given = f'import opcua://127.0.0.1:1 --mapping {path} -o {tmp_path}/x.mcap {words}'
        assert main(given.split()) in (1, 2)
        assert sentence in capsys.readouterr().err
