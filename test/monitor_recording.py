# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A recording as a monitor leaves one, made without a monitor: messages encoded field by field."""

import math
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from valveflow_ros.logs import Definitions, RecordingWriter
from valveflow_ros.logs.mcap.definitions import Fields, parse_all

START_NS = 1_700_000_000_000_000_000
NODE = '/valveflow_monitor'
STOCK = Definitions([])
FLOAT64 = 'std_msgs/msg/Float64'
TYPES = {
    f'{NODE}/characteristic': 'valveflow_msgs/msg/FlowCharacteristic',
    f'{NODE}/prediction': 'valveflow_msgs/msg/Prediction',
    f'{NODE}/alarms': 'valveflow_msgs/msg/Alarm',
    f'{NODE}/diagnosis': 'valveflow_msgs/msg/Diagnosis',
    '/valve_opening': FLOAT64,
    '/main_steam_pressure': FLOAT64,
    '/main_steam_temperature': FLOAT64,
    '/generated_power': FLOAT64,
}
_CODES = {
    'bool': '?',
    'byte': 'B',
    'uint8': 'B',
    'int32': 'i',
    'uint32': 'I',
    'uint64': 'Q',
    'float64': 'd',
}


def cdr(type_name: str, values: dict[str, Any]) -> bytes:
    """Encode a message; fields that are not named are zero, empty or NaN."""
    types = parse_all(type_name, STOCK.text(type_name))
    return b'\x00\x01\x00\x00' + _message(b'', types, type_name, values)


def _message(body: bytes, types: dict[str, Fields], name: str, values: dict[str, Any]) -> bytes:
    for field in types[name]:
        given = values.get(field.name)
        if field.array:
            items = given or []
            body += b'\0' * (-len(body) % 4) + struct.pack('<I', len(items))
            for item in items:
                body = _one(body, types, field.type, item)
        else:
            body = _one(body, types, field.type, given)
    return body


def _one(body: bytes, types: dict[str, Fields], kind: str, value: Any) -> bytes:
    if kind == 'string':
        raw = (value or '').encode() + b'\0'
        return body + b'\0' * (-len(body) % 4) + struct.pack('<I', len(raw)) + raw
    if kind not in _CODES:
        return _message(body, types, kind, value or {})
    code = _CODES[kind]
    if value is None:
        value = math.nan if kind == 'float64' else 0
    return body + b'\0' * (-len(body) % struct.calcsize(code)) + struct.pack(f'<{code}', value)


def stamp(time_ns: int) -> dict[str, int]:
    return {'sec': time_ns // 10**9, 'nanosec': time_ns % 10**9}


def head(time_ns: int) -> dict[str, Any]:
    return {'stamp': stamp(time_ns), 'frame_id': 'U1'}


def curve(time_ns: int, **more: Any) -> bytes:
    values = {
        'header': head(time_ns), 'model_id': 'abc', 'status': 1,
        'window_start': stamp(time_ns - 3600 * 10**9), 'window_end': stamp(time_ns), 'pieces': 2,
        'breakpoints': [1000.0, 1500.0, 2200.0], 'values': [150.0, 250.0, 290.0],
        'samples': 1234, 'rmse_mw': 1.25, 'pressure_exponent': 1.125,
    }  # fmt: skip
    return cdr('valveflow_msgs/msg/FlowCharacteristic', values | more)


def prediction(time_ns: int, u: float, measured: float, residual: float, state: int = 2) -> bytes:
    expected = measured - residual
    return cdr('valveflow_msgs/msg/Prediction', {
        'header': head(time_ns), 'state': state, 'model_id': 'abc', 'integrated_input': u,
        'measured_mw': measured, 'static_mw': expected, 'dynamic_mw': expected,
        'residual_mw': residual, 'average_mw': residual / 2.0, 'limit_low_mw': expected - 3.0,
        'limit_high_mw': expected + 3.0, 'alarm_evidence': 0.25, 'shift_mw': residual,
    })  # fmt: skip


def alarm(time_ns: int, state: int, sentence: str, name: str = 'residual') -> bytes:
    return cdr('valveflow_msgs/msg/Alarm', {
        'header': head(time_ns), 'name': name, 'state': state, 'priority': 2,
        'sentence': sentence, 'raised': stamp(time_ns), 'occurrence': 1,
    })  # fmt: skip


def diagnosis(time_ns: int, verdict: int, sentence: str, *causes: str) -> bytes:
    return cdr('valveflow_msgs/msg/Diagnosis', {
        'header': head(time_ns), 'model_id': 'abc', 'verdict': verdict, 'sentence': sentence,
        'causes': [{'name': cause} for cause in causes],
    })  # fmt: skip


class Monitor:
    """Writes what a monitor would, second by second."""

    def __init__(
        self, folder: Path, renamed: Mapping[str, str] | None = None, **attached: bytes
    ) -> None:
        """`renamed` gives the topic of an input that was remapped, by its usual topic."""
        self._renamed = renamed or {}
        self.writer = RecordingWriter(folder, definitions=STOCK, attachments=attached)
        for topic, kind in TYPES.items():
            self.writer.add_topic(self._renamed.get(topic, topic), kind)
        self.now_ns = START_NS

    def say(self, name: str, data: bytes) -> None:
        topic = self._renamed.get(name, name) if name.startswith('/') else f'{NODE}/{name}'
        self.writer.write(topic, data, self.now_ns, self.now_ns)

    def seconds(self, count: int, residual: float = 0.5) -> None:
        """Let time go by with inputs and predictions, and bring it to the disk."""
        for _ in range(count):
            self.now_ns += 10**9
            for topic, value in (
                ('/valve_opening', 60.0), ('/main_steam_pressure', 16.0),
                ('/main_steam_temperature', 538.0), ('/generated_power', 240.0),
            ):  # fmt: skip
                self.say(topic, b'\x00\x01\x00\x00' + struct.pack('<d', value))
            self.say('prediction', prediction(self.now_ns, 1450.0, 240.0, residual))
        self.writer.flush()


def recording(folder: Path, seconds: int = 60) -> Path:
    """Make a finished recording with a curve, an alarm and a diagnosis."""
    monitor = Monitor(folder)
    monitor.say('characteristic', curve(monitor.now_ns))
    monitor.say('diagnosis', diagnosis(monitor.now_ns, 2, 'It sticks.', 'curve_step'))
    monitor.seconds(seconds)
    monitor.say('alarms', alarm(monitor.now_ns, 1, 'The unit gives less.'))
    monitor.writer.close()
    return folder
