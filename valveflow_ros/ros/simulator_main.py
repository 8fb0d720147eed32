# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The executable `plant_simulator`: publishes the paper's simulated plant on the input topics."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from datetime import datetime, timezone
from typing import cast

from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node
from valveflow_msgs.msg import PlantSample

from valveflow_ros.errors import ParameterError, counted
from valveflow_ros.parameters import Parameter
from valveflow_ros.plant.simulator import DEFAULT_START_NS, simulate_parts
from valveflow_ros.plant.spec import EffectSpec
from valveflow_ros.records import N_SIGNALS, NS_PER_S, SIGNALS, SampleTable, Signal
from valveflow_ros.ros.declare import declare_all
from valveflow_ros.ros.decoding import PLANT_SAMPLE
from valveflow_ros.ros.domain import run
from valveflow_ros.ros.encoding import encode, float64_bytes, header
from valveflow_ros.ros.player import Player, Step
from valveflow_ros.ros.process import StopFlag, answered, usage

TABLE: tuple[Parameter, ...] = (
    Parameter('days', 10.0, 'd', 'How long the plant is simulated.', 0.001, 400.0),
    Parameter('seed', 1, '', 'Seed of every random number.', 0, 2**31 - 1),
    Parameter('rate', 1.0, '', 'Simulated seconds in a second; 0: as fast as the monitor takes '
              'them.', 0.0, 1e6),
    Parameter('stamped', False, '', 'Publish one stamped plant_sample instead of plain values.'),
    Parameter('use_clock', False, '', 'Publish the simulated time on /clock.'),
    Parameter('command', False, '', 'Publish valve_command too.'),
    Parameter('unit_tag', 'unit', '', 'Tag of the unit; frame_id of stamped samples.'),
    Parameter('start', '', '', 'Time of the first sample, ISO 8601, UTC unless it says otherwise; '
              'empty: now in real time, 2023-11-15 otherwise.'),
    Parameter('wait', 180.0, 's', 'How long to wait for a subscriber.', 0.0, 86400.0),
)  # fmt: skip


def effects_of(texts: Iterable[str]) -> list[EffectSpec]:
    """Read effects; a text may hold several, with semicolons between them.

    Raises `InputError` if an effect is unknown or its parameters are invalid.
    """
    return [EffectSpec.parse(text) for text in ';'.join(texts).split(';') if text.strip()]


def start_ns_of(text: str, rate: float, now_ns: int) -> int:
    """Return the time of the first sample; raises `ParameterError` if the text is no time."""
    if not text.strip():
        return now_ns - now_ns % NS_PER_S if rate == 1.0 else DEFAULT_START_NS
    try:
        moment = datetime.fromisoformat(text.strip().replace('Z', '+00:00'))
    except ValueError:
        raise ParameterError(
            'start', f"must be a time such as 2026-03-01T12:00:00Z, not '{text}'"
        ) from None
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=timezone.utc)
    return round(moment.timestamp()) * NS_PER_S


def check_together(rate: float, stamped: bool, use_clock: bool) -> None:
    """Refuse plain values in simulated time without a clock or stamps: their times were lost."""
    if rate != 1.0 and not stamped and not use_clock:
        raise ParameterError(
            'rate',
            f'is {rate:g}, and plain values carry no time: set use_clock (and use_sim_time at '
            'the monitor), or stamped',
        )


def plain_steps(parts: Iterable[SampleTable], command: bool) -> Iterator[Step]:
    """Yield a step of single values for each row."""
    # The optional signal comes first, as in `decoding.INPUTS`.
    signals = [Signal.VALVE_COMMAND] if command else []
    signals += [info.signal for info in SIGNALS if info.required]
    names = [SIGNALS[signal].topic for signal in signals]
    for table in parts:
        columns = [table.column(signal).tolist() for signal in signals]
        for time_ns, *values in zip(table.time_ns.tolist(), *columns, strict=True):
            yield Step(
                time_ns,
                [(name, float64_bytes(v)) for name, v in zip(names, values, strict=True)],
            )


def stamped_steps(parts: Iterable[SampleTable], command: bool, tag: str) -> Iterator[Step]:
    """Yield a step with one stamped sample for each row."""
    topics = [info.topic for info in SIGNALS]
    for table in parts:
        # The first code is good in the table, but unknown in the message.
        values, quality = table.values.copy(), table.quality + PlantSample.QUALITY_GOOD
        if not command:
            values[:, Signal.VALVE_COMMAND] = float('nan')
            quality[:, Signal.VALVE_COMMAND] = PlantSample.QUALITY_UNKNOWN
        rows = zip(table.time_ns.tolist(), values.tolist(), quality.tolist(), strict=True)
        for time_ns, row, codes in rows:
            sample = PlantSample(header=header(time_ns, tag))
            for k in range(N_SIGNALS):
                setattr(sample, topics[k], row[k])
                setattr(sample, f'{topics[k]}_quality', codes[k])
            yield Step(time_ns, [(PLANT_SAMPLE, encode(sample))])


_EFFECTS = ParameterDescriptor(
    description='What is wrong with the plant: texts of the form name or name:key=value,... as '
    'for `valveflow simulate --effect`.',
    dynamic_typing=True,
    read_only=True,
)


_ABOUT = """usage: plant_simulator [--ros-args ...]

Publishes the paper's unit, simulated, as a gateway would; any effect of the catalogue can be
hidden in it."""
_EXAMPLE = (
    'ros2 run valveflow_ros plant_simulator --ros-args -p stamped:=true -p rate:=100.0 '
    '-p effects:=gain_step:t0_days=0.5'
)


def main(args: Sequence[str] | None = None) -> int:
    """Simulate and publish; return the exit status."""
    if (status := answered('plant_simulator', args, _help, _EXAMPLE)) is not None:
        return status
    stop = StopFlag().install()
    return run('plant_simulator', args, lambda: _run(stop))


def _help() -> str:
    rows = usage(_ABOUT, _EXAMPLE, TABLE)
    return f'{rows}\n  {"effects":28} []\n  {"":28} {_EFFECTS.description}'


def _run(stop: StopFlag) -> int:
    node = Node('plant_simulator')
    try:
        return _play(node, stop)
    finally:
        stop.last()
        node.destroy_node()


def _play(node: Node, stop: StopFlag) -> int:
    values = declare_all(node, TABLE, 'effects')
    days, seed = cast(float, values['days']), cast(int, values['seed'])
    rate, wait_s = cast(float, values['rate']), cast(float, values['wait'])
    effects = effects_of(_texts(node.declare_parameter('effects', [], _EFFECTS).value))
    check_together(rate, bool(values['stamped']), bool(values['use_clock']))
    start_ns = start_ns_of(str(values['start']), rate, time.time_ns())
    parts = simulate_parts(days, seed, start_ns=start_ns, effects=effects)
    tables = (part.table for part in parts)
    command = bool(values['command'])
    if values['stamped']:
        names = [PLANT_SAMPLE]
        steps = stamped_steps(tables, command, str(values['unit_tag']))
    else:
        names = [i.topic for i in SIGNALS if command or i.signal != Signal.VALVE_COMMAND]
        steps = plain_steps(tables, command)
    player = Player(node, names, rate, bool(values['use_clock']), lambda: bool(stop))
    player.wait_for_listeners(wait_s)
    wrong = ', '.join(str(effect) for effect in effects) or 'nothing'
    node.get_logger().info(
        f'{counted(days, "day")} of plant, seed {seed}; wrong with it: {wrong}.'
    )
    player.play(steps, 'sample')
    return 0


def _texts(given: object) -> list[str]:
    """Return the texts of the parameter effects, given as one text or as a list."""
    if given is None or given == b'':
        return []
    if isinstance(given, str):
        return [given]
    texts = list(given) if isinstance(given, list | tuple) else [given]
    if not all(isinstance(text, str) for text in texts):
        raise ParameterError('effects', f'must be a list of texts, not {given!r}')
    return texts


if __name__ == '__main__':
    sys.exit(main())
