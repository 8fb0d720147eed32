# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The extended model in the node: its file, its recording, its replay."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from extended_file import extended_json, write_extended
from listener import start_monitor, start_plant
from ros_helpers import Processes, wait_until

from valveflow_ros.diagnosis.result import model_to_json
from valveflow_ros.errors import ParameterError, RecordingError
from valveflow_ros.logs import open_log
from valveflow_ros.parameters import Settings
from valveflow_ros.records import NS_PER_S, SampleTable, Signal
from valveflow_ros.ros import verify as verifying
from valveflow_ros.ros.node import parameter_files
from valveflow_ros.ros.node.session import Session

AT_200_MW = {
    Signal.VALVE_OPENING: 1250.0 / 16.0**1.125, Signal.MAIN_STEAM_PRESSURE: 16.0,
    Signal.MAIN_STEAM_TEMPERATURE: 539.0, Signal.GENERATED_POWER: 200.0,
}  # fmt: skip
HELD = {'backlash': {'w_percent': 0.5}, 'gain_drift': {'g': 0.05}, 'clock': {'d_s': 3.0}}


def test_a_model_is_read_from_its_file(tmp_path: Path) -> None:
    assert parameter_files.given_model(Settings()) is None
    assert parameter_files.corrector_for(None, Settings()) is None
    assert parameter_files.model_attachment(None) == {}
    path = write_extended(tmp_path / 'extended_model.json', **HELD)
    settings = Settings({'model_file': str(path)})
    given = parameter_files.given_model(settings)
    assert given is not None
    assert model_to_json(given) == extended_json(**HELD)
    corrector = parameter_files.corrector_for(given, settings)
    assert corrector is not None
    assert [h.name for h in corrector.held] == list(HELD)
    kept = parameter_files.model_attachment(given)[parameter_files.ATTACHMENT]
    assert json.loads(kept) == extended_json(**HELD)


def test_a_model_that_follows_a_covariate_needs_its_topic(tmp_path: Path) -> None:
    vacuum = {
        'name': 'vacuum', 'values': {'b': -1.2, 'a1': 0.0, 'a2': 0.0}, 'switches_s': [],
        'covariate': {
            'column': 'condenser_pressure', 'unit': 'kPa', 'spread': 1.0, 'power_mw': 200.0,
            'centre': [500.0, 100.0, 16.0, 1.0], 'surface': [1.0, *[0.0] * 9],
            'course': [5.0, 0.0, 0.0],
        },
    }  # fmt: skip
    content = {**extended_json(), 'causes': [vacuum]}
    path = tmp_path / 'extended_model.json'
    path.write_text(json.dumps(content), encoding='utf-8')
    without = Settings({'model_file': str(path)})
    with pytest.raises(ParameterError, match="cause 'vacuum', which follows the column"):
        parameter_files.given_model(without)
    told = Settings({'model_file': str(path), 'covariates': 'ambient=/a vacuum=/condenser:kPa'})
    corrector = parameter_files.corrector_for(parameter_files.given_model(told), told)
    assert corrector is not None
    rows = SampleTable.from_columns(
        NS_PER_S * np.arange(40, dtype=np.int64),
        {signal: np.full(40, value) for signal, value in AT_200_MW.items()},
    )
    rows = replace(rows, covariates=np.column_stack([np.full(40, np.nan), np.full(40, 7.0)]))
    power = corrector.correct(rows).column(Signal.GENERATED_POWER)
    # Two kPa above the usual 5 take 1.2 MW each.
    assert power[-1] == pytest.approx(200.0 + 2.4, abs=1e-6)


@pytest.mark.parametrize(
    ('text', 'said'),
    [
        ('{', 'cannot be used'),
        ('{"format": "x"}', "'format' must be"),
        (None, 'no such file'),
        ('\udcff', 'cannot be used'),
        (json.dumps({**extended_json(), 'causes': None}), "'causes' is not a list"),
        ('[' * 100_000, 'cannot be used'),
    ],
)  # fmt: skip
@pytest.mark.parametrize('parameter', ['model_file', 'reference_file'])
def test_a_bad_file_is_refused_with_a_sentence(
    tmp_path: Path, parameter: str, text: str | None, said: str
) -> None:
    path = tmp_path / 'given.json'
    if text is not None:
        path.write_text(text, encoding='utf-8', errors='surrogateescape')
    of_model = parameter == 'model_file'
    read = parameter_files.given_model if of_model else parameter_files.given_reference
    with pytest.raises(ParameterError) as caught:
        read(Settings({parameter: str(path)}))
    # An extended model is no curve, whatever is wrong with it.
    assert (said if of_model or 'causes' not in (text or '') else "'format' must be") in str(
        caught.value
    )
    assert str(caught.value).startswith(f"Parameter '{parameter}' names")


def test_a_bad_model_keeps_the_node_unconfigured(tmp_path: Path) -> None:
    """Before anything is started that would have to be ended again."""
    settings = Settings({'model_file': str(tmp_path / 'gone.json')})
    with pytest.raises(ParameterError, match='no such file'):
        Session(SimpleNamespace(), settings, lambda: False, print)  # type: ignore[arg-type]


@pytest.mark.ros
@pytest.mark.slow
def test_the_node_takes_causes_out_and_its_recording_repeats(
    processes: Processes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = write_extended(tmp_path / 'extended_model.json', **HELD)
    monitor = start_monitor(
        processes, tmp_path / 'recordings', model_file=str(model), use_sim_time=True
    )
    plant = start_plant(processes, days=0.02, use_clock=True)
    wait_until(lambda: plant.poll() is not None, 'the end of the plant')
    monitor.terminate()
    assert monitor.wait(10.0) == 0, processes.output(monitor)
    said = processes.output(monitor)
    assert 'Traceback' not in said
    assert 'by model_file: backlash, gain_drift, clock.' in said
    (folder,) = (tmp_path / 'recordings').glob('valveflow_*')
    model.unlink()  # the recording has its own
    result = verifying.verify(folder)
    assert result.identical, result.difference
    assert result.compared['prediction'] > 1500
    log = open_log(folder)
    assert json.loads(log.attachments[parameter_files.ATTACHMENT]) == extended_json(**HELD)
    # Rows as measured would have another u from the first one on.
    monkeypatch.setattr(verifying, 'corrector_of_run', lambda *_: None)
    assert 'Prediction number 1 differs' in verifying.verify(folder).difference


def test_a_recording_without_its_model_is_not_verified(tmp_path: Path) -> None:
    log = SimpleNamespace(path=tmp_path, attachments={})
    settings = Settings({'model_file': 'gone.json'})
    with pytest.raises(RecordingError, match='lacks the attachment'):
        verifying.corrector_of_run(log, settings)  # type: ignore[arg-type]
    log.attachments = {parameter_files.ATTACHMENT: b'{}'}
    with pytest.raises(RecordingError, match='an extended model that cannot be used'):
        verifying.corrector_of_run(log, settings)  # type: ignore[arg-type]
    assert verifying.corrector_of_run(log, Settings()) is None  # type: ignore[arg-type]
