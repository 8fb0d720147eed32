# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""``--figures`` and ``--table``: the pictures and their numbers as files of their own."""

from __future__ import annotations

import csv
import json

import pytest
from streams import needs_jit

from valveflow_ros.report import drawing

pytestmark = needs_jit


def test_pictures_and_tables_stand_beside_the_report(run, logs, tmp_path):
    pytest.importorskip('matplotlib')
    ran = run('identify', logs / 'plant.mcap', '-o', tmp_path, '--figures', '--table')
    assert ran.status == 0, ran.err
    assert f'tables in {tmp_path / "tables"} and pictures in {tmp_path / "figures"}' in ran.out
    stems = {p.stem for p in (tmp_path / 'tables').iterdir()}
    assert {'curve', 'signals', 'choice', 'dynamics', 'coverage'} <= stems
    drawn = {p.name for p in (tmp_path / 'figures').iterdir()}
    assert drawn == {f'{stem}.{kind}' for stem in stems for kind in ('png', 'svg')}
    content = json.loads((tmp_path / 'characteristic.json').read_text())
    with (tmp_path / 'tables' / 'curve.csv').open(newline='') as file:
        rows = [r for r in csv.DictReader(file) if r['line'] == 'flow characteristic']
    for k, piece in enumerate(content['pieces']):
        ends = [float(r['x']) for r in rows[2 * k : 2 * k + 2]]
        assert ends == pytest.approx([piece['u_from'], piece['u_to']], rel=1e-6)
        powers = [float(r['y']) for r in rows[2 * k : 2 * k + 2]]
        expected = [piece['slope'] * u + piece['intercept'] for u in ends]
        assert powers == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize('verb', ['identify', 'diagnose', 'compare', 'validate'])
def test_what_cannot_be_drawn_is_told_before_the_long_work(run, tmp_path, monkeypatch, verb):
    """The log cannot even be read: the refusal comes first."""
    log = tmp_path / 'no.mcap'
    log.write_bytes(b'nothing')
    model = ['--model', log] if verb == 'validate' else []
    monkeypatch.setattr(drawing, 'find_spec', lambda name: None)
    told = run(verb, log, *model, '-o', tmp_path, '--figures').refused()
    assert 'pip install matplotlib' in told
    (tmp_path / 'tables').write_text('')
    told = run(verb, log, *model, '-o', tmp_path, '--table').refused()
    assert 'tables' in told
