# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The example in the --help of each verb works as it stands there."""

import re
import shlex
import shutil

import pandas as pd
import pytest
from monitor_recording import recording
from streams import needs_jit

from benchmarks.refinery_loops import simulate_loop
from valveflow_ros.cli.main import VERBS

pytestmark = needs_jit


# What the example itself does not say: a recording that grows is watched until Ctrl-C; fewer days
# and quick fits show as well that its words are understood.
QUICK = ['--set', 'refine=false', '--set', 'selection_rule=paper']
MORE = {
    'watch': ['--once'], 'simulate': ['--days', '0.5'], 'identify': QUICK, 'compare': QUICK,
    'monitor': [*QUICK, '--no-diagnosis'],
}  # fmt: skip
# The workers of a fleet take longest to begin, and the methods of a comparison to be tuned; both
# are tested without the example.
LONG = {'fleet', 'compare'}


# A file that must be there afterwards.
WRITTEN = {
    'simulate': 'plant.mcap', 'identify': 'result/characteristic.json',
    'diagnose': 'result/diagnosis.json', 'monitor': 'result/monitor.json',
    'fleet': 'result/fleet.parquet', 'validate': 'checked/report.html',
    'loop': 'result/loop.json', 'compare': 'result/comparison.json', 'compensate': 'table.csv',
    'export': 'plant.csv', 'recover': 'whole.mcap', 'config': 'monitor.yaml',
}  # fmt: skip


def example(page):
    """Return the words of the first example; what stands behind two spaces is a remark."""
    found = re.search(r'^example:\n  valveflow (.*)$', page, re.M)
    assert found, page
    return shlex.split(found[1].partition('  ')[0])


@pytest.fixture
def plant(tmp_path, logs, identified):
    """Return a folder with every file that an example names."""
    for name, source in (
        ('plant.mcap', 'plant.mcap'), ('history.csv', 'plant.csv'), ('other.mcap', 'other.mcap'),
        ('other_days.mcap', 'other.mcap'), ('plants/U1/2026-01.csv', 'plant.csv'),
    ):  # fmt: skip
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(logs / source, tmp_path / name)
    whole = (logs / 'plant.mcap').read_bytes()
    (tmp_path / 'broken.mcap').write_bytes(whole[: len(whole) // 2])
    (tmp_path / 'result').mkdir()
    shutil.copy(identified, tmp_path / 'result')
    recording(tmp_path / 'valveflow_recordings')
    loop = simulate_loop(3, True)
    times = pd.date_range('2026-01-05', periods=len(loop.command), freq='10s')
    frame = pd.DataFrame({'time': times, 'FIC101.MV': loop.command, 'FIC101.PV': loop.response})
    frame.to_csv(tmp_path / 'FIC101.csv', index=False)
    return tmp_path


@pytest.mark.parametrize('verb', [
    pytest.param(name, marks=[pytest.mark.long] * (name in LONG)) for name, _, _ in VERBS
])  # fmt: skip
def test_the_example_of_a_verb_works(run, plant, monkeypatch, verb):
    if verb == 'fleet':
        for name in ('dask', 'distributed', 'pyarrow'):
            pytest.importorskip(name)
    pytest.importorskip('plotly')
    monkeypatch.chdir(plant)
    written = plant / WRITTEN[verb] if verb in WRITTEN else None
    if written:
        written.unlink(missing_ok=True)
    ran = run(*example(run(verb, '--help').out), *MORE.get(verb, ())).done()
    assert ran.out
    assert 'Traceback' not in ran.err
    assert written is None or written.stat().st_size > 0
