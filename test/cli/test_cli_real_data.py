# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Two measured loops: one that carries a curve, one that does not."""

from __future__ import annotations

import pytest
from streams import needs_jit

pytestmark = needs_jit
CONSTANTS = ['--constant', 'main_steam_pressure=1', '--constant', 'main_steam_temperature=540']


@pytest.fixture
def imported(run, shared_data, tmp_path):
    def take(name, opening, power):
        table = shared_data / 'plant_loops' / name
        if not table.is_file():
            pytest.skip(f'{table} is not there')
        log = tmp_path / 'x.mcap'
        ran = run('import', table, '-o', log, '--column', f'valve_opening={opening}',
                  '--column', f'generated_power={power}:t/h', *CONSTANTS)  # fmt: skip
        assert ran.status == 0, ran.err
        assert '10\u202f080 rows' in ran.out
        return log

    return take


def test_a_straight_loop_is_one_piece(run, imported, tmp_path):
    log = imported('LIC-106_20241121_27.csv', 'LV_106', 'FT_115')
    ran = run('identify', log, '-o', tmp_path / 'out', '--json')
    assert ran.status == 0, ran.err
    assert len(ran.json['pieces']) == 1
    assert ran.json['pieces'][0]['slope'] > 0.0
    assert ran.json['sample_period_s'] == 60.0
    assert (tmp_path / 'out' / 'report.html').is_file()


def test_a_loop_whose_flow_hardly_follows_the_valve_is_refused(run, imported, tmp_path):
    log = imported('FIC-211_20241121_27.csv', 'FV_211', 'FT_211')
    sentence = run('identify', log, '-o', tmp_path / 'out').refused()
    assert 'hardly follows the valve' in sentence
    assert not (tmp_path / 'out').exists()
