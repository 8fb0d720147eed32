"""Tasks and results as plain values, the way they travel to a worker and back."""

from __future__ import annotations

import dataclasses
from typing import Any

from valveflow_ros.config import Settings
from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.curve.characteristic_json import from_json, to_json
from valveflow_ros.curve.held_json import held_from, held_json
from valveflow_ros.curve.json_field import Field
from valveflow_ros.errors import DataError
from valveflow_ros.fit.fit_task import FitTask
from valveflow_ros.monitoring.diagnosis_task import DiagnosisContent, DiagnosisTask
from valveflow_ros.segments.window import WindowContents
from valveflow_ros.state import State

FIT, DIAGNOSIS = 'fit', 'diagnosis'
CURVE, CONTENT, SENTENCE, NOTHING = 'curve', 'content', 'sentence', 'nothing'


def task_letter(number: int, task: FitTask | DiagnosisTask) -> State:
    """Return a task under its number."""
    c = task.contents
    letter: State = {
        'number': number,
        'request_ns': task.request_ns,
        'settings': dict(task.settings),
        'contents': {f.name: getattr(c, f.name) for f in dataclasses.fields(c)},
    }
    if isinstance(task, DiagnosisTask):
        more = {'curve': to_json(task.curve), 'window_end_ns': task.window_end_ns}
        return {**letter, 'kind': DIAGNOSIS, **more}
    noise = {'input_noise': task.input_noise, 'power_noise_mw': task.power_noise_mw}
    return {**letter, 'kind': FIT, **noise, **held_json(task.held)}


def task_of(letter: State) -> tuple[int, FitTask | DiagnosisTask]:
    """Return the number and the task in a letter."""
    settings = Settings(letter['settings'])
    contents = WindowContents(**letter['contents'])
    number, request_ns = letter['number'], letter['request_ns']
    if letter['kind'] == DIAGNOSIS:
        curve = from_json(letter['curve'])
        return number, DiagnosisTask(
            request_ns, contents, settings, curve, letter['window_end_ns']
        )
    return number, FitTask(
        request_ns, contents, settings, letter['input_noise'], letter['power_noise_mw'],
        held_from(Field(letter, '').may_have('held')),
    )  # fmt: skip


def result_letter(number: int, result: object) -> State:
    """Return what a job gave, under the number of its task."""
    if isinstance(result, Characteristic):
        return {'number': number, 'kind': CURVE, 'curve': to_json(result)}
    if isinstance(result, DiagnosisContent):
        return {
            'number': number,
            'kind': CONTENT,
            'window_end_ns': result.window_end_ns,
            'text': result.text,
        }
    if isinstance(result, str):
        return {'number': number, 'kind': SENTENCE, 'text': result}
    return {'number': number, 'kind': NOTHING}


def result_of(letter: State) -> tuple[int, Any]:
    """Return the number of a task and what a job gave, None if that was nothing of use.

    Raises
    ------
    DataError
        It is no letter.
    """
    try:
        number, kind = int(letter['number']), letter['kind']
        if kind == CURVE:
            return number, _curve(letter['curve'])
        if kind == CONTENT:
            return number, DiagnosisContent(int(letter['window_end_ns']), str(letter['text']))
        return number, str(letter['text']) if kind == SENTENCE else None
    except (LookupError, TypeError, ValueError, AttributeError):
        raise DataError('The answer is none.') from None


def _curve(content: object) -> Characteristic | str:
    """Return the curve, or why it is none."""
    try:
        return from_json(content)
    except DataError as error:
        return f'The fit gave a curve that cannot be: {error}'
