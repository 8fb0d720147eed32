# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Flows and pressure differences on the command line."""

from __future__ import annotations

import json

import numpy as np
from streams import flow_valve

import valveflow_ros as vf


def test_what_import_understood_stays_in_its_recording(run, tmp_path):
    columns, _, _ = flow_valve(8.0, 5.0, 20.0)
    table, log = tmp_path / 'x.csv', tmp_path / 'x.mcap'
    rows = np.column_stack(list(columns.values()))[:2000]
    np.savetxt(
        table, rows, delimiter=',', header='time,LV,DP,FT [kg/s],TE', comments='', fmt='%.6f'
    )
    ran = run(
        'import', table, '-o', log, '--column', 'valve_opening=LV', '--column',
        'main_steam_pressure=DP:mbard', '--column', 'generated_power=FT', '--constant',
        'main_steam_temperature=20',
    )  # fmt: skip
    assert ran.status == 0, ran.err
    assert 'kg/s' in ran.out
    assert 'MW' not in ran.out + ran.err
    read = vf.open_log(log)
    assert read.output_unit == 'kg/s'
    given, told = read.parameters({})
    assert given['pressure_exponent'] == 0.5
    assert given['generated_power_unit'] == 'kg/s'
    assert 'pressure difference' in told[0]
    assert json.loads(read.contents.attachments['import.json'])['signals'][1]['unit'] == 'MPad'
