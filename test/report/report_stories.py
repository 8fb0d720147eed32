# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A monitor's recording and a diagnosis made by hand, for the pages that tell of them."""

import html
import re

import numpy as np

from valveflow_ros.curve.regional_model import RegionalModel
from valveflow_ros.diagnosis.cause import Estimate
from valveflow_ros.diagnosis.evidence import Gain, SegmentGain
from valveflow_ros.diagnosis.extended import Extended
from valveflow_ros.diagnosis.grids import Reference
from valveflow_ros.diagnosis.result import NAMED, Diagnosis, NamedCause
from valveflow_ros.diagnosis.signature import Answer, ResidualMap, Signature
from valveflow_ros.monitoring.alarm_state import AlarmState
from valveflow_ros.records import NS_PER_S
from valveflow_ros.report.diagnosis import Diagnosed
from valveflow_ros.report.history import AlarmMoment, CurveMoment, DiagnosisMoment, History

START_NS = 1_700_000_000 * NS_PER_S
HOUR_NS = 3600 * NS_PER_S
KNOTS = np.array([800.0, 1200.0, 1500.0])
POWER = np.array([100.0, 180.0, 195.0])
STEP_MW = -6.0  # at the last knot, from the fourth curve on


def words_of(page: str) -> str:
    """What a person reads of a page."""
    body = page.split('<body>')[1].split('<script')[0]
    return re.sub(r'\s+', ' ', html.unescape(re.sub(r'<[^>]+>', ' ', body)))


def curve(number: int, hour: int, knots: np.ndarray, power: np.ndarray) -> CurveMoment:
    """One curve; its breakpoints lie within ten with 95 % confidence."""
    inner = knots[1:-1]
    return CurveMoment(
        START_NS + hour * HOUR_NS, f'curve{number}', 1.125, knots, power, inner - 10.0,
        inner + 10.0, 2.0,
    )  # fmt: skip


def history() -> History:
    """Five curves, of which the last two are lower at the far end, and an alarm about it."""
    lowered = POWER + np.array([0.0, 0.0, STEP_MW])
    curves = [curve(0, 4, KNOTS[:2], POWER[:2])]
    curves += [curve(k, 4 * k + 4, KNOTS, POWER) for k in (1, 2)]
    curves += [curve(k, 4 * k + 4, KNOTS, lowered) for k in (3, 4)]
    states = (
        (1, AlarmState.SUPPRESSED, 'It cannot be judged.'),
        (2, AlarmState.NORMAL, 'The alarm can be judged again.'),
        (14, AlarmState.UNACKNOWLEDGED, 'The unit gives 6 MW less & it <lasts>.'),
        (15, AlarmState.ACKNOWLEDGED, 'Acknowledged.'),
        (20, AlarmState.NORMAL, 'The unit follows the curve.'),
    )
    alarms = tuple(
        AlarmMoment(START_NS + h * HOUR_NS, 'residual', s, words) for h, s, words in states
    )
    said = (DiagnosisMoment(START_NS + 16 * HOUR_NS, 'Named: curve_step.'),)
    return History(START_NS, START_NS + 24 * HOUR_NS, tuple(curves), alarms, said)


def _signature(name: str, unit: str, middle: np.ndarray, before: np.ndarray) -> Signature:
    return Signature(
        name, unit, middle, before, 0.1 * before, np.full(len(middle), 0.4), 0.1, 0.01, 0.012
    )


def _map() -> ResidualMap:
    before = np.full((3, 4), np.nan)
    before[1, 2:] = 2.0
    after = np.full((3, 4), np.nan)
    return ResidualMap(
        'time', 'u', np.linspace(0.0, 86400.0, 5), np.linspace(800.0, 1500.0, 4), before, after,
        2, 0, 12,
    )  # fmt: skip


def diagnosis() -> Diagnosis:
    """One cause, which these data cannot tell from another."""
    since = Estimate(0.5, 0.45, 0.55, 'd', START_NS)
    cause = NamedCause(
        'gain_step', 'From noon on the same flow gives 2 % more.',
        {'g': Estimate(0.02, 0.018, 0.022, ''), 't0_days': since}, Gain(2.4, 2.1, 0.0001),
        'Weigh the coal.', ('input_step',),
    )  # fmt: skip
    base = RegionalModel(
        KNOTS, POWER[:-1].copy(), POWER[1:].copy(), np.empty(0), np.array([10.0]), np.array([3.0])
    )
    model = Extended(base)
    segments = tuple(
        SegmentGain(k, START_NS + k * HOUR_NS, START_NS + k * HOUR_NS + 600 * NS_PER_S, 2.4, 2.0)
        for k in range(5)
    )
    return Diagnosis(
        NAMED, cause.sentence, (cause,), ('input_step',), ('Weigh the coal.',), None, (),
        (('backlash', 'it gains nothing'),), 2.41, 2.12, 2.08, segments, model, model, model,
        Reference(86400.0, 540.0, 2.5, 12.0, 0.02), ('A note.',),
    )  # fmt: skip


def diagnosed() -> Diagnosed:
    """Everything the page of a diagnosis shows."""
    time = np.linspace(2000.0, 84000.0, 12)
    step = np.where(time < 43200.0, -0.5, 2.0)
    u = np.linspace(820.0, 1480.0, 12)
    moves = np.linspace(-60.0, 300.0, 19)
    answers = tuple(
        Answer(up, 40, moves, 0.2 * np.sin(moves / 60.0), 0.0 * moves, 0.3) for up in (True, False)
    )
    return Diagnosed(
        'plant.mcap', START_NS, START_NS + 24 * HOUR_NS, diagnosis(),
        (_signature('u', '% MPa^m', u, np.full(12, 0.1)), _signature('time', 's', time, step)),
        answers, (_map(),), history(),
    )  # fmt: skip
