"""The executable `plant_simulator`: the paper's plant on the input topics."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from typing import cast

import rclpy
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from valveflow_ros.errors import ParameterError, ValveflowError, counted
from valveflow_ros.plant.simulator import simulate_parts
from valveflow_ros.records import SIGNALS, SampleTable, Signal
from valveflow_ros.ros import simulator_steps as steps
from valveflow_ros.ros.declare import declare, unknown_overrides
from valveflow_ros.ros.domain import choose_transport
from valveflow_ros.ros.inputs import PLANT_SAMPLE
from valveflow_ros.ros.playing import Player, Step
from valveflow_ros.ros.process import StopFlag, one_line, show, usage, wants_help, with_place
from valveflow_ros.ros.secure_start import check_security

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
    '-p "effects:=[gain_step:t0_days=0.5]"'
)


def main(args: Sequence[str] | None = None) -> int:
    """Simulate and publish; return the exit status."""
    if wants_help(args):
        show(usage(_ABOUT, _EXAMPLE, steps.TABLE))
        show(f'  {"effects":28} []\n  {"":28} {_EFFECTS.description}')
        return 0
    stop = StopFlag().install()
    try:
        choose_transport()
        check_security(args)
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    except ValveflowError as error:
        return _complain(str(error))
    except Exception as error:  # noqa: BLE001 - rclpy raises what its C++ gave it
        return _complain(f'ROS could not be started: {one_line(error)}')
    node = Node('plant_simulator')
    try:
        return _run(node, stop)
    except ValveflowError as error:
        return _complain(str(error))
    except Exception as error:  # noqa: BLE001 - a person is owed a sentence, not a trace
        return _complain(f'failed unexpectedly: {with_place(error)}')
    finally:
        stop.last()
        node.destroy_node()
        rclpy.try_shutdown()


def _run(node: Node, stop: StopFlag) -> int:
    values = declare(node, steps.TABLE)
    days, seed = cast(float, values['days']), cast(int, values['seed'])
    rate, wait_s = cast(float, values['rate']), cast(float, values['wait'])
    effects = steps.effects_of(_texts(node.declare_parameter('effects', [], _EFFECTS).value))
    log = node.get_logger()
    for sentence in unknown_overrides(node, [*values, 'effects']):
        log.warning(f'{sentence} It is ignored.')
    steps.check_together(rate, bool(values['stamped']), bool(values['use_clock']))
    start_ns = steps.start_ns_of(str(values['start']), rate, time.time_ns())
    parts = simulate_parts(days, seed, start_ns=start_ns, effects=effects)
    names, made = _steps((part.table for part in parts), values)
    player = Player(node, names, rate, bool(values['use_clock']), lambda: bool(stop))
    missing = player.wait_for_listeners(wait_s)
    if missing and wait_s > 0 and not stop:
        log.warning(f'Nobody listens to {", ".join(missing)}.')
    wrong = ', '.join(str(effect) for effect in effects) or 'nothing'
    log.info(f'{counted(days, "day")} of plant, seed {seed}; wrong with it: {wrong}.')
    count = player.play(made)
    end = 'Stopped' if stop else 'Finished'
    log.info(
        f'{end} after {counted(count, "sample")}, {counted(sum(player.sent.values()), "message")}.'
    )
    return 0


def _steps(
    parts: Iterator[SampleTable], values: dict[str, object]
) -> tuple[list[str], Iterator[Step]]:
    """Return the inputs that will be published, and the steps."""
    command = bool(values['command'])
    if values['stamped']:
        return [PLANT_SAMPLE], steps.stamped_steps(parts, command, str(values['unit_tag']))
    names = [info.topic for info in SIGNALS if command or info.signal != Signal.VALVE_COMMAND]
    return names, steps.plain_steps(parts, command)


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


def _complain(sentence: str) -> int:
    print(f'valveflow plant_simulator: {sentence}', file=sys.stderr)
    return 1


if __name__ == '__main__':
    sys.exit(main())
