"""The demo tells one story: each thing when it first happens, and at the end what it meant."""

from __future__ import annotations

from valveflow_ros.ros.demo_watch import Story, moment

HOUR = 3600 * 10**9
T0 = 1_700_006_400 * 10**9  # 2023-11-15 00:00 UTC
FAULT = T0 + 36 * HOUR
KNEES = [1250.0, 1600.0, 1900.0]


def told() -> tuple[Story, list[str]]:
    lines: list[str] = []
    return Story(FAULT, lines.append), lines


def test_times_are_those_of_the_monitors_sentences() -> None:
    assert moment(T0) == '2023-11-15 00:00'
    assert moment(FAULT + 59 * 10**9) == '2023-11-16 12:00'


def test_one_fault_is_one_story() -> None:
    story, lines = told()
    for k in range(1, 9):
        story.curve(T0 + 4 * k * HOUR, [u + k for u in KNEES])
    story.reached(FAULT - 1)
    assert len(lines) == 1
    for k in range(5):
        at = FAULT + (1 + 6 * k) * HOUR
        story.came(at, 'residual', k + 1, 'The unit gives 4.4 MW less.')
        story.went_on(at + HOUR // 6, 'acknowledged')
        # Out of the curve's range, and back in it: the same alarm.
        story.came(at + HOUR, 'residual', k + 1, 'The unit gives 4.4 MW less.')
        story.went_on(at + 2 * HOUR, 'cleared')
        story.curve(at + 3 * HOUR, KNEES[:2])
    assert lines[0] == '2023-11-15 04:00  first curve: 4 pieces, knees at u = 1251, 1601, 1901'
    assert 'the fault begins; 8 curves so far, the last with 4 pieces' in lines[1]
    assert 'ALARM residual: The unit gives 4.4 MW less.' in lines[2]
    assert [line[18:] for line in lines[3:]] == [
        'acknowledged', 'cleared', 'the alarm comes again, the second time',
        'the alarm comes again, the third time', 'the alarm comes again, the 4th time',
        'the alarm comes again, the 5th time',
    ]  # fmt: skip
    assert lines == sorted(lines)
    assert 'the alarm came 1.0 h later, and 5 times in all' in story.outcome()


def test_a_diagnosis_is_told_in_full_once() -> None:
    story, lines = told()
    story.diagnosed(FAULT - HOUR, (), 'nothing found', '')
    story.diagnosed(FAULT + 3 * HOUR, (), 'nothing found', 'The model explains the unit.')
    story.diagnosed(FAULT + 9 * HOUR, ('curve_step',), '', 'The curve lacks part of its course.')
    story.diagnosed(FAULT + 20 * HOUR, ('curve_step',), '', 'The curve lacks part of its course.')
    assert [line[18:] for line in lines] == [
        'diagnosis of the data until then: nothing found',
        '--- the fault begins; no curve so far ---',
        'diagnosis of the data until then: nothing found; 3 h of them are with the fault',
        'diagnosis of the data until then: named curve_step. The curve lacks part of its course.',
        'diagnosis of the data until then: named curve_step, as before',
    ]


def test_an_alarm_before_the_fault_is_not_its_alarm() -> None:
    story, lines = told()
    story.came(FAULT - HOUR, 'residual', 1, 'x')
    assert story.outcome() == 'The fault raised no alarm.'
    story.came(FAULT + HOUR, 'residual', 2, 'x')
    assert story.outcome().endswith('the alarm came 1.0 h later.')
    assert len(lines) == 3
