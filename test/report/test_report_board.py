# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The board behind the terminal view keeps what it is told, of one unit, within bounds."""

from __future__ import annotations

import pytest
from monitor_recording import START_NS, stamp

from valveflow_ros.report.terminal.board import AGE, HEALTH, KEPT, MonitorState

SECOND = 10**9


def test_memory_is_bounded():
    board = MonitorState()
    for k in range(3 * KEPT):
        board.take('valveflow_msgs/msg/Prediction', {
            'header': {'stamp': stamp(START_NS + k * SECOND), 'frame_id': 'U1'}, 'state': 2,
            'integrated_input': 1.0, 'measured_mw': 2.0, 'residual_mw': 0.0, 'average_mw': 0.0,
            'limit_low_mw': 1.0, 'limit_high_mw': 3.0,
        })  # fmt: skip
    assert len(board.frame('x').samples) == KEPT


@pytest.mark.parametrize('early', [False, True])
@pytest.mark.parametrize('tag', ['U1', ''])
# The second is that of earlier versions.
@pytest.mark.parametrize('prefix', ['unit_1/valveflow_monitor: ', 'valveflow: {} '])
def test_the_health_of_another_unit_is_not_taken_for_this_ones(tag, early, prefix):
    def health(of, level, sentence):
        befores = [prefix.format(of)]
        items = [('input valve_opening', level, sentence), ('recorder', level, sentence)]
        board.take(HEALTH, {'header': {'frame_id': of}, 'status': [
            {'name': f'{before}{name}', 'hardware_id': of, 'level': level, 'message': told}
            for before in befores for name, level, told in items
        ]})  # fmt: skip

    def speak():
        board.take('valveflow_msgs/msg/Diagnosis', {
            'header': {'stamp': stamp(START_NS), 'frame_id': tag}, 'verdict': 0, 'sentence': '',
            'causes': [],
        })  # fmt: skip

    board = MonitorState()
    if early:
        # Which monitor of several it is, is not known yet.
        health('U2', 3, 'silent')
        speak()
        assert (board.frame('x').inputs, board.frame('x').recorder) == ((), None)
    speak()
    health(tag, 0, 'fine')
    health('U2', 3, 'silent')
    frame = board.frame('x')
    assert [(i.name, i.sentence) for i in frame.inputs] == [('valve_opening', 'fine')]
    assert frame.recorder is not None
    assert frame.recorder.sentence == 'fine'


def test_what_bears_no_tag_is_no_units_before_one_is_known():
    board = MonitorState()
    item = {'name': 'pump: state', 'hardware_id': '', 'level': 2, 'message': 'Too hot.'}
    board.take(HEALTH, {'header': {'frame_id': ''}, 'status': [item]})
    assert board.items == ()


def test_what_others_say_of_the_same_device_is_left_alone():
    board = MonitorState()
    said = {'hardware_id': 'U1', 'level': 2, 'message': 'Too hot.'}
    names = ('pump_node: temperature', 'pump_node: recorders', 'recorder of the pump')
    status = [{**said, 'name': name} for name in names]
    board.take(HEALTH, {'header': {'frame_id': 'U1'}, 'status': status})
    assert board.items == ()
    assert board.frame('x').recorder is None


@pytest.mark.parametrize(('age', 'later_s'), [('431.5', 431.5), ('unknown', 0.0), ('nan', 0.0)])
def test_without_a_sample_the_health_tells_how_old_the_curve_is(age, later_s):
    board = MonitorState()
    board.take('valveflow_msgs/msg/FlowCharacteristic', {
        'header': {'stamp': stamp(START_NS), 'frame_id': 'U1'}, 'breakpoints': [1.0, 2.0],
        'values': [1.0, 2.0], 'status': 1, 'cause': '', 'model_id': 'a', 'samples': 9,
        'window_start': stamp(START_NS - 9), 'window_end': stamp(START_NS), 'rmse_mw': 0.1,
    })  # fmt: skip
    board.take(HEALTH, {'header': {'frame_id': 'U1'}, 'status': [{
        'name': 'valveflow_monitor: fit', 'hardware_id': 'U1', 'level': 0, 'message': '',
        'values': [{'key': AGE, 'value': age}],
    }]})  # fmt: skip
    assert board.frame('x').now_ns == START_NS + round(later_s * SECOND)
