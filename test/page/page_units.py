# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A unit as the page knows it, told message by message."""

from monitor_recording import START_NS, stamp

from valveflow_ros.page.unit import Shown, Unit
from valveflow_ros.report.terminal.board import ALARM, CURVE, DIAGNOSIS, HEALTH, PREDICTION

SECOND = 10**9
NODE = '/valveflow_monitor'


def head(time_ns, tag='U1'):
    return {'stamp': stamp(time_ns), 'frame_id': tag}


def predict(unit, second, measured=250.0, residual=1.5, **m):
    expected = measured - residual
    unit.take(PREDICTION, {
        'header': head(START_NS + round(second * SECOND)), 'state': 2, 'integrated_input': 1500.0,
        'measured_mw': measured, 'residual_mw': residual, 'average_mw': 0.5,
        'limit_low_mw': expected - 4.0, 'limit_high_mw': expected + 4.0, 'alarm_evidence': 0.25,
    } | m)  # fmt: skip


def alarm(unit, state, second=0.0, name='residual'):
    unit.take(ALARM, {
        'header': head(START_NS + round(second * SECOND)), 'name': name, 'state': state,
        'sentence': 'The unit gives 9 MW less. <b>', 'raised': stamp(START_NS),
    })  # fmt: skip


def told(key=NODE, tag='U1', seconds=200):
    """Return a unit of which everything was told."""
    unit = Unit(key)
    unit.take(CURVE, {
        'header': head(START_NS, tag), 'breakpoints': [1000.0, 1500.0, 2200.0],
        'values': [150.0, 250.0, 290.0], 'status': 1, 'cause': '', 'model_id': 'a',
        'samples': 900, 'window_start': stamp(START_NS - 3600 * SECOND),
        'window_end': stamp(START_NS), 'rmse_mw': 1.5, 'pressure_exponent': 1.125,
    })  # fmt: skip
    unit.take(DIAGNOSIS, {
        'header': head(START_NS, tag), 'verdict': 2, 'sentence': 'The valve sticks.',
        'causes': [
            {'name': 'stiction', 'meaning': 'Friction.', 'to_do': 'Lubricate, retighten.'},
        ],
    })  # fmt: skip
    for k in range(seconds):
        predict(unit, k, measured=250.0 + k % 5, header=head(START_NS + k * SECOND, tag))
    items = {
        'input valve_opening': (3, 'silent for 9 s.', {'Messages lost on the way': '4'}),
        'input generated_power': (0, '1 Hz.', {'Messages lost on the way': '0'}),
        'fit': (
            0,
            'A curve.',
            {'Age of the curve (s)': '431.5', 'Samples taken in all runs': '200'},
        ),
        'recorder': (0, 'Recording.', {'Messages dropped': 'unknown'}),
    }
    unit.take(HEALTH, {'header': head(START_NS, tag), 'status': [
        {'name': f'valveflow_monitor: {name}', 'hardware_id': tag, 'level': level, 'message': text,
         'values': [{'key': k, 'value': v} for k, v in values.items()]}
        for name, (level, text, values) in items.items()
    ]})  # fmt: skip
    return unit


def shown_now(*units, note=''):
    shown = Shown()
    shown.put([u.snapshot(u.frame(u.key)) for u in units], note)
    return shown
