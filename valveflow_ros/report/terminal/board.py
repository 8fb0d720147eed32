# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Decoded messages of a monitor, and the part of them that a terminal view keeps."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from valveflow_ros.records import NS_PER_S
from valveflow_ros.report.terminal.frame import (
    AlarmView,
    CurveView,
    DiagnosisView,
    Frame,
    HealthView,
    SampleView,
)
from valveflow_ros.report.words import advice as advice_of

CURVE = 'valveflow_msgs/msg/FlowCharacteristic'
PREDICTION = 'valveflow_msgs/msg/Prediction'
ALARM = 'valveflow_msgs/msg/Alarm'
DIAGNOSIS = 'valveflow_msgs/msg/Diagnosis'
HEALTH = 'diagnostic_msgs/msg/DiagnosticArray'
MESSAGES = (CURVE, PREDICTION, ALARM, DIAGNOSIS)
AGE = 'Age of the curve (s)'
# 15 minutes at one sample per second: more than fits on any terminal.
KEPT = 900

# Items of `/diagnostics` other than inputs.
_ITEMS = frozenset({
    'fit', 'alarm', 'reference', 'model', 'diagnosis', 'recorder', 'state', 'parameters', 'name',
})  # fmt: skip
# Upper limits, larger than the numbers of alarms and health items of a monitor.
_MOST_ALARMS, _MOST_ITEMS = 64, 64

Fields = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class ItemView:
    """An item of the health with its values, as text; the keys contain the units."""

    health: HealthView
    values: Mapping[str, str]


class MonitorState:
    """The state of a monitor according to its messages, with bounded memory.

    Messages are mappings from field to value, independent of their transport.
    """

    def __init__(self) -> None:
        # Both may be set by a caller that has a better source than `/diagnostics`.
        self.inputs: tuple[HealthView, ...] = ()
        self.recorder: HealthView | None = None
        self.items: tuple[ItemView, ...] = ()  # all of this monitor in `/diagnostics`
        self._unit = ''
        # The tag in the messages of the monitor, and in the health used; None: no message yet.
        self._tag: str | None = None
        self._health_tag: str | None = None
        self._now_ns = 0
        self._curve: CurveView | None = None
        self._diagnosis: DiagnosisView | None = None
        self._samples: deque[SampleView] = deque(maxlen=KEPT)
        self._alarms: dict[str, AlarmView] = {}

    def take(self, type_name: str, fields: Fields) -> None:
        """Process a message; messages of other types are ignored."""
        if type_name == HEALTH:
            self._health(fields)
        elif type_name in MESSAGES:
            time_ns, view = decoded(type_name, fields)
            self._tag = str(fields['header']['frame_id'])
            if self._health_tag not in (None, self._tag):
                # That health may be of another monitor: the tag was not known then.
                self.inputs, self.recorder, self._health_tag = (), None, None
                self.items = ()
            self._unit = self._tag or self._unit
            if isinstance(view, SampleView):
                if time_ns < self._now_ns and self._samples:
                    # The clock went back: the earlier samples must not be drawn with the new ones.
                    self._samples.clear()
                # An alarm is never later than its sample, so the sample sets the time.
                self._now_ns = time_ns
                self._samples.append(view)
            elif isinstance(view, CurveView):
                self._curve = view
                self.at(view.window[1])
            elif isinstance(view, AlarmView):
                if view.name in self._alarms or len(self._alarms) < _MOST_ALARMS:
                    self._alarms[view.name] = view
                self.at(time_ns)
            else:
                self._diagnosis = view

    def frame(self, source: str, note: str = '') -> Frame:
        """Return the current state as a frame."""
        return Frame(
            self._unit, source, self._now_ns, note, self._curve,
            self._samples[-1] if self._samples else None, tuple(self._samples),
            tuple(self._alarms[name] for name in sorted(self._alarms)), self.inputs,
            self.recorder, self._diagnosis,
        )  # fmt: skip

    def at(self, time_ns: int) -> None:
        """Advance the plant time if no sample sets it."""
        self._now_ns = max(self._now_ns, time_ns)

    def _health(self, fields: Fields) -> None:
        # `/diagnostics` is shared by all nodes; a monitor adds its tag.
        tag = str(fields['header']['frame_id']) or None if self._tag is None else self._tag
        ours = [s for s in fields['status'] if s['hardware_id'] == tag and _is_item(s)]
        if ours:
            self._health_tag = str(ours[0]['hardware_id'])
        items = [_item(status) for status in ours[:_MOST_ITEMS]]
        if items:
            self.items = tuple(
                ItemView(item, _values(status)) for item, status in zip(items, ours, strict=False)
            )
        inputs = [item for item in items if item.name.startswith('input ')]
        if inputs:
            self.inputs = tuple(
                HealthView(i.name.removeprefix('input '), i.level, i.sentence) for i in inputs
            )
        self.recorder = next((i for i in items if i.name == 'recorder'), self.recorder)
        fit = next((status for status in ours if _item_name(status) == 'fit'), None)
        if fit is not None and self._curve is not None and not self._samples:
            # Without samples, the plant time follows from the age of the curve.
            self.at(self._curve.window[1] + _age_ns(fit))


def decoded(
    type_name: str, fields: Fields
) -> tuple[int, CurveView | SampleView | AlarmView | DiagnosisView]:
    """Return a message of one of `MESSAGES`: its time stamp in ns, and its content.

    Raises `KeyError`, `TypeError` or `ValueError` if a field is missing, or has a wrong type.
    """
    time_ns = _ns(fields['header']['stamp'])
    if type_name == PREDICTION:
        measured, residual = float(fields['measured_mw']), float(fields['residual_mw'])
        expected = measured - residual
        return time_ns, SampleView(
            time_ns, int(fields['state']), float(fields['integrated_input']), measured,
            residual, float(fields['average_mw']), float(fields['limit_low_mw']) - expected,
            float(fields['limit_high_mw']) - expected,
            float(fields.get('alarm_evidence', math.nan)),
        )  # fmt: skip
    if type_name == ALARM:
        return time_ns, AlarmView(
            str(fields['name']), int(fields['state']), str(fields['sentence']).strip(),
            _ns(fields['raised']),
        )  # fmt: skip
    if type_name == DIAGNOSIS:
        causes = tuple(str(cause['name']) for cause in fields['causes'])
        said = str(fields['sentence']).strip()
        advice = tuple(
            advice_of(str(cause['name']), str(cause['meaning']), str(cause['to_do']))
            for cause in fields['causes']
            if cause.get('to_do')  # missing in recordings of earlier versions
        )
        return time_ns, DiagnosisView(int(fields['verdict']), said, causes, time_ns, advice)
    return time_ns, CurveView(
        _floats(fields['breakpoints']), _floats(fields['values']), int(fields['status']),
        str(fields['cause']).strip(), str(fields['model_id']),
        (_ns(fields['window_start']), _ns(fields['window_end'])),
        int(fields['samples']), float(fields['rmse_mw']),
        str(fields.get('shift_sentence', '')).strip(),
        float(fields.get('pressure_exponent', math.nan)),
    )  # fmt: skip


def _ns(stamp: Fields) -> int:
    return int(stamp['sec']) * NS_PER_S + int(stamp['nanosec'])


def _floats(values: Iterable[Any]) -> tuple[float, ...]:
    return tuple(float(value) for value in values)


def _values(status: Fields) -> dict[str, str]:
    return {str(pair['key']): str(pair['value']) for pair in status.get('values', ())}


def _age_ns(fit: Fields) -> int:
    """Return the age of the curve according to the health, 0 if it gives none."""
    try:
        return round(float(_values(fit)[AGE]) * NS_PER_S)
    except (KeyError, ValueError, OverflowError):
        return 0


def _item(status: Fields) -> HealthView:
    level = status['level']
    number = level[0] if isinstance(level, bytes) else int(level)
    return HealthView(_item_name(status), number, str(status['message']))


def _item_name(status: Fields) -> str:
    name = str(status['name']).rpartition(': ')[2]
    # Recordings of earlier versions have the tag of the unit before the item.
    return name.removeprefix(f'{status["hardware_id"]} ')


def _is_item(status: Fields) -> bool:
    name = _item_name(status)
    return name in _ITEMS or name.startswith('input ')
