"""Tasks and results as plain values, the way they travel to a worker and back."""

from __future__ import annotations

import dataclasses
import os
import struct
from typing import Any

from valveflow_ros.curve.characteristic import Characteristic
from valveflow_ros.curve.characteristic_json import from_json, held_from, held_json, to_json
from valveflow_ros.curve.json_field import Field
from valveflow_ros.errors import DataError
from valveflow_ros.fit.task import FitTask
from valveflow_ros.monitoring.events import DiagnosisContent, DiagnosisTask
from valveflow_ros.parameters import Settings
from valveflow_ros.segments.window import WindowContents
from valveflow_ros.state import State, from_bytes, to_bytes

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


# Messages over a pipe between a process and its own child.
#
# Each frame is a length and that many bytes. They are states (`valveflow_ros.state`):
# plain values and arrays with a checksum, so that nothing that a hurt process writes can be
# mistaken for a result, or be executed.


_LENGTH = struct.Struct('<Q')
# A window of twenty million rows takes less.
_MOST_BYTES = 4 << 30
_READ = 1 << 20
_READS = 8  # at most in one look: whoever looks has samples to take


def send(descriptor: int, item: State) -> None:
    """Write one message; blocks while the pipe is full. Raises `OSError` if nobody reads."""
    body = to_bytes(item)
    for part in (memoryview(_LENGTH.pack(len(body))), memoryview(body)):
        done = 0
        while done < part.nbytes:
            # The interpreter is free for others while the pipe takes the bytes.
            done += os.write(descriptor, part[done : done + _READ])


class FrameReader:
    """Puts messages together from whatever a pipe gives.

    Parameters
    ----------
    descriptor : int
        Of the pipe; set it non-blocking for `ready`.
    most : int
        Bytes that a message may have.
    """

    def __init__(self, descriptor: int, most: int = _MOST_BYTES) -> None:
        self._descriptor = descriptor
        self._most = most
        self._bytes = bytearray()
        self.ended = False

    def ready(self) -> list[State]:
        """Return the messages that are there whole, without waiting.

        Raises
        ------
        DataError
            What came is no message.
        """
        for _ in range(_READS):
            if self.ended:
                break
            try:
                found = os.read(self._descriptor, _READ)
            except BlockingIOError:
                break
            except OSError:
                found = b''
            self.ended = not found
            self._bytes += found
        items: list[State] = []
        while (item := self._cut()) is not None:
            items.append(item)
        return items

    def wait(self) -> State:
        """Return the next message; raises `EOFError` when the other end is gone."""
        while True:
            item = self._cut()
            if item is not None:
                return item
            found = os.read(self._descriptor, _READ)
            if not found:
                raise EOFError
            self._bytes += found

    def _cut(self) -> State | None:
        """Cut the first frame off, if it is whole."""
        start = _LENGTH.size
        if len(self._bytes) < start:
            return None
        (length,) = _LENGTH.unpack_from(self._bytes)
        if length > self._most:
            raise DataError('What came through the pipe is no message.')
        if len(self._bytes) < start + length:
            return None
        body = bytes(memoryview(self._bytes)[start : start + length])
        del self._bytes[: start + length]
        return from_bytes(body)
