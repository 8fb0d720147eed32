"""A recording of the monitor says itself in which units the gateway sent."""

import json

from valveflow_ros.interface.logs import open_log
from valveflow_ros.logs import write_samples
from valveflow_ros.plant.simulator import simulate
from valveflow_ros.records import SampleTable, Signal


def recording(path, parameters):
    table = simulate(0.01, 1).table
    values = table.values.copy()
    values[:, Signal.MAIN_STEAM_PRESSURE] *= 10.0
    sent = SampleTable(table.time_ns, values, table.quality)
    attached = {'parameters.json': json.dumps(parameters).encode()}
    write_samples(sent, path, attachments=attached)
    return open_log(path)


def test_the_units_are_those_the_monitor_was_told(tmp_path):
    log = recording(tmp_path / 'a.mcap', {'main_steam_pressure_unit': 'bar'})
    assert log.units[Signal.MAIN_STEAM_PRESSURE] == 'bar'
    mine = log.readings.value[log.readings.signal == Signal.MAIN_STEAM_PRESSURE]
    assert 5.0 < mine.min() < mine.max() < 20.0


def test_words_that_are_no_units_are_not_believed(tmp_path):
    for k, parameters in enumerate(({'main_steam_pressure_unit': 'ell'}, {}, [1])):
        log = recording(tmp_path / f'x_{k}' / 'a.mcap', parameters)
        assert log.units[Signal.MAIN_STEAM_PRESSURE] == 'MPa'
