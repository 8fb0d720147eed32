# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Pictures as PNG and SVG, and what they show as CSV; what numba's cache says of the first run."""

import csv
import io
import os
import re
import subprocess
import sys
from dataclasses import replace
from xml.etree import ElementTree

import numba
import numpy as np
import pytest
from report_stories import START_NS, diagnosed, history

from valveflow_ros.errors import InputError
from valveflow_ros.interface.files import check_results
from valveflow_ros.report import drawing, first_run
from valveflow_ros.report.diagnosis import diagnosis_page
from valveflow_ros.report.drawing import figure_files
from valveflow_ros.report.figure import (
    Figure,
    figure_csv,
    numbers,
    packed,
    plain_text,
    points,
    time_axis,
)
from valveflow_ros.report.identification import identification_page


@pytest.fixture(scope='module')
def figures(identified):
    data = replace(identified, history=history(), reference=identified.characteristic)
    both = [*identification_page(data).figures, *diagnosis_page(diagnosed()).figures]
    return {f.name: f for f in both}


def rows_of(figure):
    return list(csv.DictReader(io.StringIO(figure_csv(figure))))


@pytest.mark.parametrize('name', ['curve', 'coverage', 'alarms', 'map-time'])
def test_a_picture_becomes_png_and_svg_the_same_each_time(figures, name):
    pytest.importorskip('matplotlib')
    files = figure_files(figures[name])
    assert set(files) == {f'{name}.png', f'{name}.svg'}
    assert files[f'{name}.png'].startswith(b'\x89PNG')
    tree = ElementTree.fromstring(files[f'{name}.svg'])
    drawn = [e for e in tree.iter() if e.tag.endswith(('}path', '}use', '}image'))]
    assert len(drawn) > 10
    # What to look for goes with the file.
    about = ''.join(tree.itertext())
    assert plain_text(re.match(r'<b>(.*?)</b>', figures[name].caption).group(1)) in about
    if name == 'alarms':
        assert figure_files(figures[name]) == files


@pytest.mark.parametrize('days', [0.3, 1.99, 59.0, 400.0])
def test_half_a_picture_has_room_for_its_times(days):
    pytest.importorskip('matplotlib')
    at = START_NS / 1e6 + 86400e3 * days * np.linspace(0.0, 1.0, 9)
    layout = {'xaxis': time_axis(domain=[0.0, 0.47], nticks=4)}
    drawn = figure_files(
        Figure('half', '', '', [points(packed(at), at.tolist(), '', 'data')], layout)
    )
    assert 2 <= drawn['half.svg'].count(b'"xtick_') <= 5


def test_a_matplotlib_that_cannot_be_loaded_is_refused_before_any_work(monkeypatch, tmp_path):
    pytest.importorskip('matplotlib')

    def broken(name):
        raise ImportError('libfreetype.so.6: cannot open shared object file')

    monkeypatch.setattr(drawing, 'import_module', broken)
    with pytest.raises(InputError, match=r'cannot be loaded \(libfreetype.*--force-reinstall'):
        check_results(tmp_path / 'result', figures=True, tables=False)


def test_the_table_of_the_curve_has_its_ends_and_the_cloud(figures, identified):
    rows = rows_of(figures['curve'])
    line = [(float(r['x']), float(r['y'])) for r in rows if r['line'] == 'flow characteristic']
    assert line == [(800.0, 100.0), (1200.0, 180.0), (1200.0, 180.0), (1500.0, 195.0)]
    cloud = [int(float(r['value'])) for r in rows if r['line'] == 'special samples']
    assert sum(cloud) == len(identified.special)
    assert {r['x_axis'] for r in rows} == {'integrated input u = V p^(9/8) (% MPa^(9/8))'}
    assert {r['y_axis'] for r in rows} == {'generated power (MW)'}


def test_times_of_a_table_are_told_in_utc(figures):
    knees = [r for r in rows_of(figures['history']) if r['line'] == 'breakpoints, 95 %']
    at = np.datetime64(knees[0]['x'].removesuffix('Z'), 'ms').astype(int)
    assert at == START_NS // 10**6 + 8 * 3_600_000
    assert [float(knees[0][k]) for k in ('y', 'y_low', 'y_high')] == [1200.0, 1190.0, 1210.0]
    assert {r['y'] for r in rows_of(figures['alarms'])} == {'residual', 'diagnosis', 'new curve'}


def test_every_table_has_every_point_that_is_drawn(figures):
    for figure in figures.values():
        drawn = 0
        for trace in figure.traces:
            if trace['type'] == 'heatmap':
                drawn += sum(v is not None for row in trace['z'] for v in row)
            elif trace['y'] and isinstance(trace['y'][0], str):
                drawn += sum(v is not None for v in trace['x'])
            else:
                known = np.isfinite(numbers(trace, 'x')) & np.isfinite(numbers(trace, 'y'))
                drawn += int(known.sum())
        assert len(rows_of(figure)) == drawn, figure.name


@pytest.mark.parametrize(('off', 'told'), [('0', 'True True'), ('1', 'False False')])
def test_the_first_run_is_known_by_the_empty_cache(tmp_path, off, told):
    code = (
        'from valveflow_ros.report.first_run import is_first_run, must_compile_to_fit;'
        'print(is_first_run(), must_compile_to_fit())'
    )
    done = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, check=True,
        env={**os.environ, 'NUMBA_CACHE_DIR': str(tmp_path), 'NUMBA_DISABLE_JIT': off},
    )  # fmt: skip
    assert done.stdout.strip() == told


@pytest.mark.long
@pytest.mark.skipif(numba.config.DISABLE_JIT, reason='nothing is compiled')
def test_what_is_compiled_beside_is_what_an_identification_uses(tmp_path):
    def run(code):
        subprocess.run([sys.executable, '-c', code], check=True, env=there)
        patterns = 'kernels.*.nbc', 'search.search_groups*.nbc'
        return sorted(file.name for p in patterns for file in tmp_path.rglob(p))

    there = {**os.environ, 'NUMBA_CACHE_DIR': str(tmp_path)}
    beside = run('from valveflow_ros.report.first_run import compile_late; compile_late()')
    for name in ('kernels.normal_sums', 'search.search_groups'):
        assert any(file.startswith(name) for file in beside)
    whole = run('import valveflow_ros as vf; vf.identify(vf.simulate(0.4, 1).log)')
    assert whole == beside


@pytest.mark.skipif(numba.config.DISABLE_JIT, reason='nothing is compiled')
@pytest.mark.parametrize(('cold', 'expected'), [('partition', True), ('no such', False)])
def test_a_fit_must_compile_where_only_its_own_part_is_cold(monkeypatch, cold, expected):
    monkeypatch.setattr(first_run, '_is_cold', lambda found: cold in found.__module__)
    assert first_run.must_compile_to_fit() == expected
    assert not first_run.is_first_run()
