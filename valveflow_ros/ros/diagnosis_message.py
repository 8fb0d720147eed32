"""A diagnosis as a message."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

from valveflow_msgs.msg import Diagnosis, DiagnosisCause

from valveflow_ros.monitoring.diagnosis_task import DiagnosisTask
from valveflow_ros.monitoring.events import Diagnosed
from valveflow_ros.ros.conversions import header

NOT_YET = 'Not diagnosed yet: a diagnosis needs a curve and a day of data.'
VERDICTS = {
    'nothing': Diagnosis.NOTHING,
    'named': Diagnosis.NAMED,
    'unexplained': Diagnosis.UNEXPLAINED,
}


def unknown(sentence: str, tag: str, task: DiagnosisTask | None = None) -> Diagnosis:
    """Return the message that says why there is no result."""
    nan = math.nan
    return Diagnosis(
        header=header(0 if task is None else task.window_end_ns, tag),
        model_id='' if task is None else task.curve.model_id,
        verdict=Diagnosis.UNKNOWN,
        sentence=sentence,
        disturbance_rms_mw=nan,
        disturbance_time_scale_s=nan,
        rmse_simulation=nan,
        rmse_extended=nan,
        rmse_noise_floor=nan,
    )


def of(event: Diagnosed, tag: str) -> Diagnosis:
    """Return what a diagnosis gave as a message."""
    if not event.content:
        return unknown(event.reason, tag, event.task)
    return diagnosis(json.loads(event.content), event.task, tag)


def diagnosis(content: Mapping[str, Any], task: DiagnosisTask, tag: str) -> Diagnosis:
    """Return what `diagnosis.json` would hold as a message.

    Raises
    ------
    KeyError, TypeError, ValueError, AssertionError
        It is not whole.
    """
    message = unknown(str(content['sentence']), tag, task)
    message.verdict = VERDICTS[content['verdict']]
    message.causes = [_cause(cause) for cause in content['causes']]
    message.not_told_apart = [str(name) for name in content['not_told_apart']]
    message.unexplained_by = [str(name) for name in content['unexplained_by']]
    message.rejected_names = [str(put_away['name']) for put_away in content['rejected']]
    message.rejected_reasons = [str(put_away['reason']) for put_away in content['rejected']]
    disturbance = content['disturbance']
    if disturbance is not None:
        message.disturbance_rms_mw = _number(disturbance['rms_mw'])
        message.disturbance_time_scale_s = _number(disturbance['time_scale_s'])
    message.rmse_simulation = _number(content['rmse_simulation'])
    message.rmse_extended = _number(content['rmse_extended'])
    message.rmse_noise_floor = _number(content['rmse_noise_floor'])
    return message


def _cause(cause: Mapping[str, Any]) -> DiagnosisCause:
    parameters, gain = cause['parameters'], cause['gain']
    return DiagnosisCause(
        name=str(cause['name']),
        sentence=str(cause['sentence']),
        parameter_names=[str(name) for name in parameters],
        parameter_values=[_number(p['value']) for p in parameters.values()],
        parameter_lows=[_number(p['low']) for p in parameters.values()],
        parameter_highs=[_number(p['high']) for p in parameters.values()],
        parameter_units=[str(p['unit']) for p in parameters.values()],
        rmse_before_mw=_number(gain['rmse_before']),
        rmse_after_mw=_number(gain['rmse_after']),
        reduction=_number(gain['reduction']),
        p_value=_number(gain['p_value']),
    )


def _number(value: float | None) -> float:
    """JSON's null is a number that is not known."""
    return math.nan if value is None else float(value)
