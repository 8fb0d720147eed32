# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The executable `opcua_gateway`: publishes OPC UA values and serves the results by OPC UA."""

from __future__ import annotations

import asyncio
import math
import queue
import sys
import threading
import time
from collections.abc import Callable, Coroutine, Iterator, Sequence
from concurrent.futures import Future
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from std_msgs.msg import Header
from valveflow_msgs.msg import Alarm, Diagnosis, DiagnosisCause, FlowCharacteristic, PlantSample

from valveflow_ros.errors import InputError, counted
from valveflow_ros.logs.mcap.importing import write_readings
from valveflow_ros.monitoring.alarms import ResidualAlarm, ShiftAlarm
from valveflow_ros.opcua.link import Link
from valveflow_ros.opcua.mapping import GatewayMapping, UnitMapping, read_mapping_file
from valveflow_ros.opcua.results_server import NO_CONDITION, SEVERITY, Field, ResultsServer
from valveflow_ros.opcua.results_server import Alarm as AlarmEvent
from valveflow_ros.opcua.sampler import Counts, Sample, Sampler
from valveflow_ros.opcua.session import check_installed
from valveflow_ros.parameters import Parameter
from valveflow_ros.records import NS_PER_S, SIGNALS, Quality, Readings, Signal
from valveflow_ros.ros.declare import declare_all
from valveflow_ros.ros.decoding import PLANT_SAMPLE, from_time
from valveflow_ros.ros.domain import run, spinning
from valveflow_ros.ros.encoding import header
from valveflow_ros.ros.listening import LATCHED
from valveflow_ros.ros.node.diagnostics import (
    Changes,
    Item,
    Level,
    diagnostics_message,
    log_at,
)
from valveflow_ros.ros.process import StopFlag, answered, usage

NAME = 'opcua_gateway'
TABLE: tuple[Parameter, ...] = (
    Parameter('mapping_file', '', '', 'Mapping file (YAML), such as config/opcua.yaml.'),
    Parameter('diagnostics_period', 1.0, 's', 'Time from one /diagnostics to the next.',
              0.1, 60.0),
)  # fmt: skip
# A larger clock difference is reported; many servers update their clock only once a second.
_CLOCK_S = 2.0
# Time for which a problem with a value is shown.
_SHOWN_S = 60.0
_LOOK_S, _END_S, _OFFER_S = 0.02, 6.0, 60.0
_KINDS = {'double': 'Double', 'string': 'String', 'boolean': 'Boolean', 'uint8': 'Byte',
          'uint32': 'UInt32', 'uint64': 'UInt64'}  # fmt: skip
_TIME, _CAUSES = 'builtin_interfaces/Time', 'sequence<valveflow_msgs/DiagnosisCause>'
_TROUBLE = tuple(name for name in Counts.__slots__ if name not in ('received', 'uncertain', 'bad'))


class LoopThread:
    """An event loop in a separate thread."""

    def __init__(self) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()

    def start(self, work: Coroutine[Any, Any, Any]) -> Future[Any]:
        """Start a coroutine in the loop."""
        return asyncio.run_coroutine_threadsafe(work, self._loop)

    def finish(self, work: Callable[[], Coroutine[Any, Any, Any]]) -> None:
        """Run a last coroutine to its end, for a limited time, whatever it raises."""
        with suppress(Exception):
            self.start(work()).result(_END_S + 1.0)

    def close(self) -> None:
        """Cancel all tasks, let them close their sessions, and end the thread."""

        async def cancel() -> None:
            others = asyncio.all_tasks() - {asyncio.current_task()}
            for task in others:
                task.cancel()
            await asyncio.wait(others, timeout=_END_S) if others else None

        self.finish(cancel)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(1.0)


class GatewayUnit:
    """One unit: its link runs in the loop's thread, its sampler in the node's thread."""

    def __init__(self, node: Node, unit: UnitMapping) -> None:
        self.unit = unit
        self.name = f'{unit.namespace}/{NAME}'.lstrip('/')
        self.sampler = Sampler(unit, time.time_ns())
        self._told: queue.SimpleQueue[Callable[[Sampler], None]] = queue.SimpleQueue()
        self.link = Link(unit, self._told.put, self._save if unit.backfill_directory else None)
        self._publisher = node.create_publisher(
            PlantSample, f'{unit.namespace}/{PLANT_SAMPLE}', QoSProfile(depth=1000)
        )
        self._before: dict[int, tuple[int, ...]] = {}
        self._trouble_s: dict[int, float] = {}

    def step(self, now_ns: int) -> None:
        """Process the changes from the link and publish the samples that are due."""
        with suppress(queue.Empty):
            while True:
                self._told.get_nowait()(self.sampler)
        for signal, lost in list(self.link.state.overflows.items()):
            self.sampler.counts[signal].lost = lost
        for sample in self.sampler.due(now_ns):
            self._publisher.publish(self._message(sample))

    def items(self, now_s: float, now_ns: int) -> list[Item]:
        """Return the health items of the link and the signals."""
        items = [self._link_item(now_s)]
        for signal, counts in self.sampler.counts.items():
            items.append(self._signal_item(signal, counts, now_s, now_ns))
        return items

    def _link_item(self, now_s: float) -> Item:
        state, unit, sampler = self.link.state, self.unit, self.sampler
        ahead = state.clock_ahead_s
        for_s = counted(round(now_s - state.since_s), 'second')
        if not (state.up or state.problem):
            level, told = Level.WARN, f'Connecting to {unit.endpoint}.'
        elif not state.up:
            level, told = Level.ERROR, f'No link to {unit.endpoint} for {for_s}'
            told += f': {state.problem}. '
            told += f'Tried {counted(state.attempts, "time")}; it goes on trying.'
        elif abs(ahead) > _CLOCK_S:
            level = Level.WARN
            told = (
                f'The clock of {unit.endpoint} is {abs(ahead):.1f} s '
                f'{"ahead of" if ahead > 0 else "behind"} this one: set both by NTP.'
            )
        else:
            level, told = Level.OK, f'Connected to {unit.endpoint} for {for_s}.'
        return Item('link', level, told, {
            'samples': sampler.sent, 'samples_unconfirmed': sampler.unconfirmed,
            'losses': state.losses, 'attempts': state.attempts,
            'messages_lost': state.lost_messages, 'messages_sent_again': state.republished,
            'server_clock_ahead_s': ahead, 'backfill': state.backfill,
        })  # fmt: skip

    def _signal_item(self, signal: int, counts: Counts, now_s: float, now_ns: int) -> Item:
        topic, unit = SIGNALS[Signal(signal)].topic, SIGNALS[Signal(signal)].unit
        numbers = {name: getattr(counts, name) for name in Counts.__slots__}
        trouble = tuple(numbers[name] for name in _TROUBLE)
        last, values = self.sampler.newest.get(signal), dict[str, object](numbers)
        if last is not None:
            status = Quality(last.quality).name.lower()
            age_s = max(0.0, (now_ns - last.source_ns) / NS_PER_S)
            values |= {f'value ({unit})': last.value, 'status': status, 'age_s': age_s}
        if trouble != self._before.setdefault(signal, trouble):
            self._before[signal], self._trouble_s[signal] = trouble, now_s
        elif any(trouble) and signal not in self._trouble_s:
            self._trouble_s[signal] = now_s
        if problem := self.link.state.nodes.get(signal):
            return Item(f'signal {topic}', Level.ERROR, f'Not read: {problem}.', values)
        if now_s - self._trouble_s.get(signal, -math.inf) < _SHOWN_S:
            told = ', '.join(
                f'{n} {name}' for name, n in numbers.items() if n and name in _TROUBLE
            )
            return Item(f'signal {topic}', Level.WARN, f'Since the start: {told}.', values)
        if not self.link.state.up:
            return Item(f'signal {topic}', Level.STALE, 'There is no link.', values)
        if last is None:
            return Item(f'signal {topic}', Level.WARN, 'Nothing came yet.', values)
        told = f'{last.value:.6g} {unit}, {status}, {age_s:.1f} s old.'
        level = Level.WARN if last.quality == Quality.BAD else Level.OK
        return Item(f'signal {topic}', level, told, values)

    def _message(self, sample: Sample) -> PlantSample:
        message = PlantSample(header=header(sample.time_ns, self.unit.tag))
        for info, value, code in zip(SIGNALS, sample.values, sample.quality, strict=True):
            setattr(message, info.topic, value)
            if code is not None:
                known = PlantSample.QUALITY_GOOD + code
                setattr(message, f'{info.topic}_quality', known)
        return message

    def _save(self, parts: list[Readings]) -> str:
        """Write the history of an outage; called in a separate thread."""
        start = time.strftime('%Y%m%dT%H%M%SZ', time.gmtime(int(parts[0].time_ns[0]) // NS_PER_S))
        folder = self.unit.backfill_directory
        assert folder is not None
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        path = folder / f'backfill_{self.unit.tag}_{start}.mcap'
        signals = [node.signal for node in self.unit.nodes]
        written = write_readings(parts, signals, path, prefix=self.unit.namespace, overwrite=True)
        return f'{counted(written.messages, "value")} in {path}'


class ResultsBridge:
    """Forwards what a unit's monitor publishes to the OPC UA server.

    ``start`` starts a coroutine in the server's loop.
    """

    OBJECTS = ('characteristic', 'diagnosis', *(
        f'alarms.{name}' for name in (ResidualAlarm.NAME, ShiftAlarm.NAME)
    ))  # fmt: skip

    def __init__(
        self,
        node: Node,
        unit: UnitMapping,
        server: ResultsServer,
        start: Callable[[Coroutine[Any, Any, Any]], Any],
    ) -> None:
        self._node, self._tag, self._server, self._start = node, unit.tag, server, start
        self._monitor = f'{unit.namespace}/{unit.monitor}'
        self._present = True
        for kind, name in ((FlowCharacteristic, 'characteristic'), (Diagnosis, 'diagnosis')):
            node.create_subscription(
                kind, f'{self._monitor}/{name}', partial(self._on_message, name), LATCHED
            )
        node.create_subscription(Alarm, f'{self._monitor}/alarms', self._on_alarm, LATCHED)

    def look(self) -> None:
        """Update the status of the shown values if the monitor has ended or is back."""
        self._note(self._node.count_publishers(f'{self._monitor}/characteristic') > 0)

    def _note(self, present: bool) -> None:
        if present != self._present:
            self._present = present
            self._start(self._server.mark(self._tag, present))

    def _on_message(self, name: str, message: Any) -> None:
        self._note(True)
        time_ns = from_time(message.header.stamp)
        self._start(self._server.update(self._tag, name, values_of(message), time_ns))
        if name == 'diagnosis' and message.verdict != Diagnosis.UNKNOWN:
            values = {'State': message.verdict, 'PreviousState': 0, 'Value': math.nan,
                      'Limit': math.nan, 'Unit': ''}  # fmt: skip
            wrong = message.verdict != Diagnosis.NOTHING
            severity = SEVERITY[Alarm.MEDIUM] if wrong else NO_CONDITION
            event = AlarmEvent('diagnosis', time_ns, message.sentence, severity, values)
            self._start(self._server.alarm(self._tag, event))

    def _on_alarm(self, message: Alarm) -> None:
        time_ns, name = from_time(message.header.stamp), f'alarms.{message.name}'
        if name not in self.OBJECTS:
            return
        self._note(True)
        self._start(self._server.update(self._tag, name, values_of(message), time_ns))
        # A repeated announcement is no event.
        if message.state == message.previous_state:
            return
        standing = message.state in (Alarm.UNACKNOWLEDGED, Alarm.ACKNOWLEDGED)
        severity = SEVERITY.get(message.priority, NO_CONDITION) if standing else NO_CONDITION
        values = {
            'State': message.state, 'PreviousState': message.previous_state,
            'Value': message.value, 'Limit': message.limit, 'Unit': message.unit,
        }  # fmt: skip
        event = AlarmEvent(message.name, time_ns, message.sentence, severity, values)
        self._start(self._server.alarm(self._tag, event))


def variables(kind: Any, message: Any = None) -> Iterator[tuple[Field, object]]:
    """Yield the variables of a message type, one per field, and its value, with times in ns.

    A field with causes gives a variable for each of their plain fields, which has a value for
    each cause.
    """
    for name, of in kind.get_fields_and_field_types().items():
        value = getattr(message, name, None)
        if of in ('std_msgs/Header', _TIME):
            stamp = value.stamp if isinstance(value, Header) else value
            time_ns = None if stamp is None else from_time(stamp)
            yield Field(name if of == _TIME else 'stamp', 'DateTime'), time_ns
        elif of == _CAUSES:
            for inner, _ in variables(DiagnosisCause):
                if not inner.array:
                    found = [getattr(cause, inner.name) for cause in value or ()]
                    yield Field(f'{name}_{inner.name}', inner.kind, True), found
        else:
            plain = of.removeprefix('sequence<').removesuffix('>')
            array = plain != of
            yield Field(name, _KINDS[plain], array), list(value or ()) if array else value


def values_of(message: Any) -> dict[str, object]:
    """Return the values of the variables of a message by name."""
    return {field.name: value for field, value in variables(type(message), message)}


def _units_offered(mapping: GatewayMapping) -> dict[str, dict[str, list[Field]]]:
    kinds = {'characteristic': FlowCharacteristic, 'diagnosis': Diagnosis}
    objects = {
        name: [field for field, _ in variables(kinds.get(name, Alarm))]
        for name in ResultsBridge.OBJECTS
    }
    return {unit.tag: objects for unit in mapping.units}


_ABOUT = """usage: opcua_gateway --ros-args -p mapping_file:=FILE

Reads the signals of one or several units from OPC UA servers and publishes plant_sample; shows
curve, alarms and diagnosis of the monitors as an OPC UA server where the file says so."""
_EXAMPLE = 'ros2 run valveflow_ros opcua_gateway --ros-args -p mapping_file:=opcua.yaml'


def main(args: Sequence[str] | None = None) -> int:
    """Run the gateway until it is asked to stop; return the exit status."""
    page = partial(usage, _ABOUT, _EXAMPLE, TABLE)
    if (status := answered(NAME, args, page, _EXAMPLE)) is not None:
        return status
    stop = StopFlag().install()
    return run(NAME, args, lambda: _run(stop))


def _run(stop: StopFlag) -> int:
    check_installed()
    node = Node(NAME)
    with ExitStack() as stack:
        executor = stack.enter_context(spinning(node))
        loop = LoopThread()
        stack.callback(loop.close)
        stack.callback(stop.last)
        values = declare_all(node, TABLE)
        log = node.get_logger()
        if not values['mapping_file']:
            raise InputError('Name the mapping file: --ros-args -p mapping_file:=opcua.yaml.')
        mapping = read_mapping_file(Path(str(values['mapping_file'])))
        bridges = []
        if mapping.server is not None:
            server = ResultsServer(mapping.server, _units_offered(mapping))
            for sentence in loop.start(server.start()).result(_OFFER_S):
                log.warning(sentence)
            stack.callback(loop.finish, server.stop)
            bridges = [ResultsBridge(node, unit, server, loop.start) for unit in mapping.units]
            log.info(f'Curve, alarms and diagnosis are offered at {mapping.server.endpoint}.')
        units = [GatewayUnit(node, unit) for unit in mapping.units]
        for unit in units:
            loop.start(unit.link.run())
        _serve(node, executor, stop, units, bridges, float(str(values['diagnostics_period'])))
    return 0


def _serve(
    node: Node,
    executor: SingleThreadedExecutor,
    stop: StopFlag,
    units: Sequence[GatewayUnit],
    bridges: Sequence[ResultsBridge],
    diagnostics_period_s: float,
) -> None:
    publisher = node.create_publisher(DiagnosticArray, '/diagnostics', QoSProfile(depth=10))
    changes = {unit.name: Changes() for unit in units}
    log = node.get_logger()
    next_s = 0.0
    while not stop:
        executor.spin_once(timeout_sec=_LOOK_S)
        now_ns, now_s = time.time_ns(), time.monotonic()
        for unit in units:
            unit.step(now_ns)
        if now_s < next_s:
            continue
        next_s = now_s + diagnostics_period_s
        for bridge in bridges:
            bridge.look()
        for unit in units:
            items = unit.items(now_s, now_ns)
            publisher.publish(diagnostics_message(items, unit.name, unit.unit.tag, now_ns))
            fresh = (item for item in items if item.level != Level.STALE)
            for item in changes[unit.name].pick(fresh, now_s):
                log_at(log, item.level, f'{unit.unit.tag}, {item.name}: {item.sentence}')


if __name__ == '__main__':
    sys.exit(main())
