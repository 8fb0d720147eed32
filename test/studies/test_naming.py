# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The benchmark for naming causes: the set is the same for all, tells nothing, scores right."""

import json
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from streams import needs_jit

import valveflow_ros as vf
from benchmarks.naming import __main__ as program
from benchmarks.naming import answers, records, scoring
from benchmarks.study import RESULTS
from valveflow_ros.errors import ValveflowError

SIGNALS = {
    'time', 'valve_opening_percent', 'main_steam_pressure_mpa', 'main_steam_temperature_degc',
    'generated_power_mw', 'valve_command_percent', 'condenser_pressure_kpa', 'grid_frequency_hz',
    *(f'valve_{k}_position_percent' for k in range(1, 5)),
}  # fmt: skip
# Of the truth of the fixture, which has the sum of each record.
TINY = '561cdee1d0bf72a9b7604e05e3402ee9ce73af568087e4c6bd5118ad11358881'


@pytest.fixture(scope='module')
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a record of each plant and recording, of some hours."""
    folder = tmp_path_factory.mktemp('naming')
    every = records.entries(records.PRACTICE)
    places = (
        ('paper', '1s', 'outside'), ('paper', 'minute', 'temperature'),
        ('physics', '1s', 'outside'), ('physics', 'minute', 'gain_step'),
        ('paper', 'minute', 'healthy'),
    )  # fmt: skip
    wanted = [
        next(e for e in every if (e.plant, e.recording) == (p, t) and what in (e.kind, e.label))
        for p, t, what in places
    ]
    assert list(records.write(folder, wanted, 0.25)) == [f'record_0{k}' for k in range(1, 6)]
    return folder


@needs_jit
def test_a_set_is_the_same_each_time_and_does_not_tell_what_is_in_it(tiny: Path) -> None:
    """The truth has the sum of each record, so its own sum is that of the set."""
    assert records.sha256(tiny) == TINY
    with pytest.raises(ValveflowError, match='name another folder'):
        next(records.write(tiny, []))
    for name, about in json.loads((tiny / 'records.json').read_text()).items():
        assert set(about) == {'file', 'recording', 'flow_law'}
        assert about['file'] == f'records/{name}.csv.gz'
        frame = pd.read_csv(tiny / about['file'])
        assert set(frame) <= SIGNALS
        if about['recording'] == '1s':  # what was added has the steps of the power meter too
            steps = frame['generated_power_mw'].to_numpy() / 0.01
            assert np.allclose(steps, np.round(steps), atol=1e-6)


def test_the_order_of_a_set_is_drawn_and_no_seed_is_in_both_sets() -> None:
    seen: set[int] = set()
    for first in records.SHA256:
        every = records.entries(first)
        seeds = [e.seed for e in every]
        assert sorted(seeds) == list(range(first, first + 40)) != seeds
        hidden = {e.label for e in every if e.kind == 'hidden'}
        assert hidden == set(records.NAMES) - {'region_lag'}
        seen.update(seeds)
    assert len(seen) == 80


@needs_jit
def test_a_truth_that_differs_is_told(
    tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(records, 'entries', lambda first: [])
    program.make(tmp_path / 'none', records.SEALED)
    assert 'differ from the published set' in capsys.readouterr().out
    monkeypatch.setitem(records.SHA256, records.SEALED, records.sha256(tiny))
    assert records.same_as_published(tiny, records.SEALED)


def test_the_kept_result_is_of_the_published_set() -> None:
    kept = json.loads((RESULTS / 'naming.json').read_text())
    assert kept['published']
    assert kept['truth_sha256'] == records.SHA256[records.SEALED]
    truth = {row['record']: row for row in kept['rows']}
    for method, scored in kept['summary'].items():
        said = {name: row['answers'][method] for name, row in truth.items()}
        assert scoring.score(truth, said) == scored


TRUTH = {
    'a': {'kind': 'hidden', 'plant': 'paper', 'recording': '1s', 'label': 'gain_step',
          'names': ['gain_step'], 'size': 0.01, 'also': [], 'onset_hours': 50.0},
    'b': {'kind': 'hidden', 'plant': 'paper', 'recording': 'minute', 'label': 'temperature',
          'names': ['temperature'], 'size': -0.001, 'also': []},
    'c': {'kind': 'healthy', 'plant': 'paper', 'recording': '1s', 'label': '', 'names': [],
          'also': []},
    'd': {'kind': 'outside', 'plant': 'physics', 'recording': '1s', 'label': 'two steps',
          'names': [], 'also': ['reheater']},
}  # fmt: skip
RIGHT = {
    'a': {'names': ['gain_step'], 'size': {'value': 0.011, 'low': 0.009, 'high': 0.013},
          'onset_hours': {'value': 51.5, 'low': 51.0, 'high': 52.0}},
    'b': {'names': ['temperature'], 'size': {'value': -0.002, 'low': -0.003, 'high': -0.0015}},
    'c': {'names': []},
    'd': {'names': 'unknown'},
}  # fmt: skip


def _outcomes(answers: dict[str, object]) -> dict[str, list[int]]:
    scored = scoring.score(TRUTH, answers)
    counts = {'all': scored['all'], **scored['kinds']}
    return {kind: [c[o] for o in scoring.OUTCOMES] for kind, c in counts.items()}


def test_right_answers_with_sizes_and_onsets() -> None:
    assert _outcomes(RIGHT) == {
        'all': [4, 0, 0, 0], 'hidden': [2, 0, 0, 0], 'healthy': [1, 0, 0, 0],
        'outside': [1, 0, 0, 0],
    }  # fmt: skip
    scored = scoring.score(TRUTH, RIGHT)
    assert [scored['size'][k] for k in ('asked', 'given', 'held')] == [2, 2, 1]
    onset = scored['onset_hours']
    assert (onset['given'], onset['held'], onset['median_error']) == (1, 0, 1.5)
    assert scored['all']['interval'] == [0.51, 1.0]
    assert '1 of 2 intervals hold the truth' in scoring.words(scored)


@pytest.mark.parametrize(
    ('names', 'expected'),
    [
        ([], {'hidden': [0, 0, 2, 0], 'healthy': [1, 0, 0, 0], 'outside': [0, 0, 1, 0]}),
        ('unknown', {'hidden': [0, 0, 0, 2], 'healthy': [0, 0, 0, 1], 'outside': [1, 0, 0, 0]}),
        (['clock'], {'hidden': [0, 2, 0, 0], 'healthy': [0, 1, 0, 0], 'outside': [0, 1, 0, 0]}),
        (  # one more than the right name is a wrong name
            ['gain_step', 'clock'],
            {'hidden': [0, 2, 0, 0], 'healthy': [0, 1, 0, 0], 'outside': [0, 1, 0, 0]},
        ),
    ],
)
def test_the_same_answer_to_all(names: object, expected: dict[str, list[int]]) -> None:
    found = _outcomes({record: {'names': names} for record in TRUTH})
    del found['all']
    assert found == expected


BAD = [
    (None, 'cannot be read'),
    ('{', 'it is not JSON'),
    ('[]', 'one JSON object'),
    ('{}', "no entry 'a'"),
    (json.dumps({**RIGHT, 'e': {'names': []}}), "name 'e', which is no record"),
    (json.dumps({**RIGHT, 'a': ['clock']}), "needs 'names'"),
    (json.dumps({**RIGHT, 'a': {'names': 'clock'}}), "needs 'names'"),
    (json.dumps({**RIGHT, 'a': {'names': ['clocks']}}), "no cause 'clocks'"),
    (json.dumps({**RIGHT, 'a': {'names': [], 'sizes': 1}}), "'sizes' is not known"),
    (json.dumps({**RIGHT, 'a': {'names': [], 'size': 1}}), 'numbers value, low and high'),
    ('{"a": {"names": [], "size": {"value": NaN, "low": 1, "high": 2}}, "b": {"names": []}, '
     '"c": {"names": []}, "d": {"names": []}}', 'numbers value, low and high'),
]  # fmt: skip


@pytest.mark.parametrize(('text', 'sentence'), BAD)
def test_bad_answers_get_a_sentence(
    text: str | None, sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    (tmp_path / 'truth.json').write_text(json.dumps(TRUTH))
    if text is not None:
        (tmp_path / 'answers.json').write_text(text)
    said = ['naming', 'score', str(tmp_path), str(tmp_path / 'answers.json')]
    monkeypatch.setattr(sys, 'argv', said)
    assert program.main() == 1
    assert sentence in capsys.readouterr().err


@needs_jit
@pytest.mark.long
def test_methods_name_what_is_large_in_the_format_and_baselines_nothing_in_a_healthy_unit() -> (
    None
):
    def frame(*effects: str) -> pd.DataFrame:
        return vf.simulate(2.0, 5, effects).to_dataframe()

    healthy, stepped = frame(), frame('gain_step:g=0.03,t0_days=1.2')
    truth = {'a': {**TRUTH['a'], 'size': 0.03, 'onset_hours': 28.8}}
    for method, hours in (('valveflow', 0.1), ('changepoint', 1.0)):
        scored = scoring.score(truth, {'a': answers.METHODS[method](stepped)})
        assert (scored['all']['right'], scored['size']['given']) == (1, 1)
        assert scored['onset_hours']['median_error'] < hours
    assert answers.regression(frame('temperature:k=-0.003'))['names'] == ['temperature']
    assert answers.changepoint(healthy)['names'] == answers.regression(healthy)['names'] == []
