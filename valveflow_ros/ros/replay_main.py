"""The executable `replay`: a log on the input topics again, or proof that it repeats itself."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence

import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from valveflow_ros.errors import ValveflowError, counted
from valveflow_ros.logs import open_log
from valveflow_ros.report.terminal.progress import Progress
from valveflow_ros.report.terminal.text import number
from valveflow_ros.ros.domain import choose_transport
from valveflow_ros.ros.playing import Player
from valveflow_ros.ros.process import Parser, StopFlag, one_line, with_place
from valveflow_ros.ros.replay_steps import steps_of
from valveflow_ros.ros.secure_start import check_security
from valveflow_ros.ros.verify import verify

# As a shell tells of a process that Ctrl-C has ended.
_STOPPED = 130


def parser() -> argparse.ArgumentParser:
    """Return the description of the command line."""
    made = Parser(
        prog='replay',
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description='Publish a log on the input topics, with /clock, as a gateway would, or '
        'verify that a\nrecording of the monitor gives the same again. Ctrl-C ends it.\n\n'
        'example:\n  ros2 run valveflow_ros replay plant.mcap --rate 600\n\n'
        'and for a recording of the monitor:\n'
        '  ros2 run valveflow_ros replay valveflow_recordings/valveflow_... --verify',
        epilog='ROS arguments (remaps, namespace) follow --ros-args.',
    )
    made.add_argument('log', metavar='LOG', help='.mcap, rosbag2 folder, .csv or .parquet')
    made.add_argument(
        '--rate',
        type=number('a number of seconds of the log in each second', 0, 1e6, '--rate 600'),
        default=1.0,
        metavar='R',
        help="seconds of the log's own time in a second; 0: as fast as the monitor takes it "
        '(default: 1)',
    )
    made.add_argument(
        '--wait',
        type=number('a number of seconds', 0, 1e6, '--wait 60'),
        default=180.0,
        metavar='S',
        help='how long to wait for a subscriber on every topic; 0: begin at once (default: 180)',
    )
    made.add_argument('--no-clock', action='store_true', help='do not publish /clock')
    made.add_argument(
        '--verify',
        action='store_true',
        help='publish nothing; feed a recording of the monitor to the engine again and compare '
        'every recorded output byte for byte',
    )
    return made


def main(args: Sequence[str] | None = None) -> int:
    """Replay or verify; return the exit status."""
    arguments = list(sys.argv if args is None else ['replay', *args])
    options = parser().parse_args(remove_ros_args(arguments)[1:])
    try:
        if options.verify:
            return _verify(options.log)
        return _replay(options, arguments)
    except ValveflowError as error:
        print(f'valveflow replay: {error}', file=sys.stderr)
    except KeyboardInterrupt:
        print('valveflow replay: stopped.', file=sys.stderr)
        return _STOPPED
    except Exception as error:  # noqa: BLE001 - a person is owed a sentence, not a trace
        print(f'valveflow replay: failed unexpectedly: {with_place(error)}', file=sys.stderr)
    return 1


def _verify(path: str) -> int:
    bar = sys.stderr.isatty() and os.environ.get('TERM') != 'dumb'
    if not bar:
        # A line now and then shows how far it is; the first comes after a while.
        print(
            f'Verifying {path}: its inputs are fed to the engine again, and every recorded output '
            'is compared byte for byte. How far it is will be told now and then.',
            file=sys.stderr, flush=True,
        )  # fmt: skip
    progress = Progress(sys.stderr, bar)
    progress.at(0.0, 'reading the recording')
    try:
        result = verify(path, lambda share: progress.at(share, 'feeding the recording again'))
    finally:
        progress.end()
    for warning in result.warnings:
        print(warning, file=sys.stderr)
    print(f'{counted(result.inputs, "input message")}, {counted(result.rows, "sample")}')
    for name, count in result.compared.items():
        print(f'{name}: {counted(count, "message")} equal')
    print('identical' if result.identical else f'different: {result.difference}')
    return 0 if result.identical else 1


def _replay(options: argparse.Namespace, arguments: list[str]) -> int:
    stop = StopFlag().install()
    choose_transport()
    check_security(arguments)
    log = open_log(options.log)
    names, steps = steps_of(log)
    try:
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:  # noqa: BLE001 - rclpy raises what its C++ gave it
        print(f'valveflow replay: ROS could not be started: {one_line(error)}', file=sys.stderr)
        return 1
    node = Node('replay')
    say = node.get_logger()
    try:
        for warning in log.warnings:
            say.warning(warning)
        player = Player(node, names, options.rate, not options.no_clock, lambda: bool(stop))
        missing = player.wait_for_listeners(options.wait)
        if missing and options.wait > 0 and not stop:
            say.warning(f'Nobody listens to {", ".join(missing)}.')
            if len(missing) == len(names):
                say.error(f'Nobody listened within {options.wait:g} s; nothing was played.')
                return 1
        say.info(f'Playing {options.log} on {", ".join(names)}.')
        count = player.play(steps)
        total = sum(player.sent.values())
        end = 'Stopped' if stop else 'Finished'
        say.info(f'{end} after {counted(count, "instant")}, {counted(total, "message")}.')
        return 0
    finally:
        stop.last()
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == '__main__':
    sys.exit(main())
