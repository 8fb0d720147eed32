# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The demo tells one story: each thing when it first happens, and at the end what it meant."""

from valveflow_msgs.msg import Alarm, Diagnosis, DiagnosisCause, FlowCharacteristic

from valveflow_ros.ros.demo import Story, told_in_the_end
from valveflow_ros.ros.encoding import header, to_time

HOUR = 3600 * 10**9
T0 = 1_700_006_400 * 10**9  # 2023-11-15 00:00 UTC
FAULT = T0 + 36 * HOUR
KNEES = [1250.0, 1600.0, 1900.0]


def curve(at_ns, knees):
    return FlowCharacteristic(
        status=FlowCharacteristic.FRESH, model_id=str(at_ns), window_end=to_time(at_ns),
        breakpoints=[900.0, *knees, 2500.0], pieces=len(knees) + 1,
    )  # fmt: skip


def alarm(at_ns, occurrence, state=Alarm.UNACKNOWLEDGED):
    return Alarm(
        header=header(at_ns, 'u'), name='residual', state=state, occurrence=occurrence,
        sentence='The unit gives 4.4 MW less.',
    )  # fmt: skip


def diagnosis(at_ns, *names, sentence=''):
    return Diagnosis(
        header=header(at_ns, 'u'), model_id='m', sentence=sentence,
        verdict=Diagnosis.NAMED if names else Diagnosis.NOTHING,
        causes=[DiagnosisCause(name=name) for name in names],
    )  # fmt: skip


def lines(capsys):
    return capsys.readouterr().out.splitlines()


def test_one_fault_is_one_story(capsys):
    story = Story(FAULT)
    story.on_curve(FlowCharacteristic(status=FlowCharacteristic.UNKNOWN, cause='No rows.'))
    story.on_alarm(alarm(T0, 0, Alarm.NORMAL))
    assert story.cause == 'No rows.'
    assert story.outcome() == 'The fault raised no alarm.'
    for k in range(1, 9):
        story.on_curve(curve(T0 + 4 * k * HOUR, [u + k for u in KNEES]))
    story.on_alarm(alarm(FAULT - HOUR, 1))
    story.reached(FAULT - 1)
    for k in range(1, 5):
        at = FAULT + 6 * k * HOUR
        story.on_alarm(alarm(at, k + 1))
        story.on_alarm(alarm(at + HOUR // 6, k + 1, Alarm.ACKNOWLEDGED))
        # Out of the curve's range, and back in it: the same alarm.
        story.on_alarm(alarm(at + HOUR, k + 1))
        story.on_alarm(alarm(at + 2 * HOUR, k + 1, Alarm.NORMAL))
        story.on_curve(curve(at + 3 * HOUR, KNEES[:2]))
    told = lines(capsys)
    said = 'ALARM residual: The unit gives 4.4 MW less.'
    assert (
        told[0] == '2023-11-15 04:00  first curve: 4 pieces, breakpoints at u = 1251, 1601, 1901'
    )
    assert [line[18:] for line in told[1:]] == [
        said, '--- the fault begins; 8 curves so far ---', *[said] * 4,
    ]  # fmt: skip
    assert 'the first alarm came 6.0 h later; alarms in all: 4' in story.outcome()


def test_each_diagnosis_is_told(capsys):
    story = Story(FAULT)
    story.on_diagnosis(Diagnosis())
    story.on_diagnosis(diagnosis(FAULT - HOUR))
    story.on_diagnosis(diagnosis(FAULT + 9 * HOUR, 'curve_step', sentence='It bends.'))
    assert [line[18:] for line in lines(capsys)] == [
        'diagnosis of the data so far: nothing found',
        '--- the fault begins; 0 curves so far ---',
        'diagnosis of the data so far: named curve_step. It bends.',
    ]


def test_the_last_line_tells_what_is_missing():
    identical = 'the replay was identical to the recording, byte for byte.'
    assert told_in_the_end([], 3.0) == f'All came out, and {identical}'
    assert told_in_the_end(['it failed'], 3.0) == 'Not all came out: it failed.'
    few = 'Not all came out: a; b. 3 days (--days) are enough for that.'
    assert told_in_the_end(['a', 'b'], 0.5) == few
