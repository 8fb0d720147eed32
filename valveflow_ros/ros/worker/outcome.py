"""What comes back from a worker, and whether it may be believed."""

from __future__ import annotations

import itertools
import json
import math
from dataclasses import dataclass, replace

import numpy as np

from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.errors import counted
from valveflow_ros.fit.fit_task import FitTask
from valveflow_ros.monitoring.diagnosis_task import DiagnosisContent, DiagnosisTask
from valveflow_ros.ros.diagnosis_message import VERDICTS, diagnosis
from valveflow_ros.ros.encoding import encode


@dataclass(frozen=True, slots=True)
class Outcome:
    """A curve or what a diagnosis gave, or the sentence why there is none.

    Attributes
    ----------
    request_ns : int
        Which request it answers.
    result : Characteristic, DiagnosisContent or str
    seconds : float
        How long it took, with the way there and back.
    """

    request_ns: int
    result: Characteristic | DiagnosisContent | str
    seconds: float


def objection(task: FitTask, result: object) -> str:
    """Return why a result is not to be adopted, empty if nothing speaks against it.

    The worker is another process and may have been hurt in any way; the curve
    that predicts and raises alarms is only replaced by a whole one.
    """
    if not isinstance(result, Characteristic):
        return 'The fit gave no curve.'
    pieces = result.pieces
    most = task.settings.whole('max_pieces')
    if not 1 <= len(pieces) <= most:
        return f'The fit gave {counted(len(pieces), "piece")} where 1 to {most} are possible.'
    numbers = [x for p in pieces for x in (p.u_from, p.u_to, p.slope, p.intercept)]
    numbers += [x for d in result.dynamics for x in (d.time_constant_s, d.delay_s)]
    numbers += [result.residuals.rmse_mw, result.residuals.average_sd_mw]
    if not all(map(math.isfinite, numbers)):
        return 'The fit gave numbers that are not finite.'
    knots = result.breakpoints
    joined = all(a.u_to == b.u_from for a, b in itertools.pairwise(pieces))
    if not joined or np.any(np.diff(knots) <= 0.0):
        return 'The fit gave breakpoints that do not increase.'
    if any(d.time_constant_s <= 0.0 or d.delay_s < 0.0 for d in result.dynamics):
        return 'The fit gave a time constant or delay that cannot be.'
    chart = result.residuals.chart
    if result.residuals.average_sd_mw <= 0.0 or chart is None or not chart.innovation_mw > 0.0:
        return 'The fit gave residuals without spread.'
    finite = all(map(math.isfinite, chart.limit + chart.slack))
    # Innovations are clipped at four: with more slack than this hardly a shift raises an alarm.
    if not (finite and min(chart.limit) > 0.0 and max(chart.slack) <= 3.0):
        return 'The fit gave no limits for the alarm.'
    if result.source.window_end_ns != int(task.contents.time_ns[-1]):
        return 'The fit answered for other data.'
    if replace(result, model_id='').with_id().model_id != result.model_id:
        return 'The fit gave a curve that does not fit its own name.'
    return ''


def content_objection(task: DiagnosisTask, result: object) -> str:
    """Return why the result of a diagnosis is not to be published, empty if nothing says so."""
    if not isinstance(result, DiagnosisContent):
        return 'The diagnosis gave no result.'
    if result.window_end_ns != task.window_end_ns:
        return 'The diagnosis answered for other data.'
    content = json.loads(result.text)
    if content['verdict'] not in VERDICTS or not content['sentence']:
        return 'The diagnosis gave no verdict.'
    # What cannot be told as a message is no result.
    encode(diagnosis(content, task, ''))
    return ''
