# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The executable `replay`: publishes a log on the input topics, or verifies a recording."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator, Sequence
from itertools import groupby
from operator import itemgetter

from rclpy.node import Node
from rclpy.utilities import remove_ros_args

from valveflow_ros.errors import DataError, ValveflowError, counted
from valveflow_ros.logs import LogContents, open_log
from valveflow_ros.logs.names import has_earlier_codes, told_inputs
from valveflow_ros.logs.tables.refusal import RefusedError, quoted
from valveflow_ros.records import SIGNALS
from valveflow_ros.report.terminal.progress import Progress
from valveflow_ros.report.terminal.text import number
from valveflow_ros.ros.decoding import (
    INPUT_BY_NAME,
    INPUTS,
    PLANT_SAMPLE,
    header_time_ns,
    with_todays_codes,
)
from valveflow_ros.ros.domain import run
from valveflow_ros.ros.encoding import float64_bytes
from valveflow_ros.ros.player import Player, Step
from valveflow_ros.ros.process import Parser, StopFlag, complain, with_place
from valveflow_ros.ros.verify import verify

# Exit status of a process that was ended by Ctrl-C, as in a shell.
_STOPPED = 130


def parser() -> argparse.ArgumentParser:
    """Return the command-line parser."""
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


def input_topics(log: LogContents) -> dict[str, str]:
    """Return the topics of a recording to play, each with its input.

    A recording of the monitor states which of its topics were inputs; a covariate keeps its
    topic. In other recordings inputs are recognised by topic name and type.
    """
    told = told_inputs(log.attachments)
    known = {topic: name if name in INPUT_BY_NAME else topic for name, topic in told.items()}
    if not known:
        known = {topic: SIGNALS[signal].topic for signal, topic in log.signals.items()}
        for topic, info in log.topics.items():
            if info.type == INPUT_BY_NAME[PLANT_SAMPLE].type_name:
                known[topic] = PLANT_SAMPLE
    return {
        topic: name
        for topic, name in known.items()
        if topic in log.topics
        and log.topics[topic].count
        and log.topics[topic].type == INPUT_BY_NAME.get(name, INPUTS[0]).type_name
    }


def steps_of(log: LogContents) -> tuple[list[str], Iterator[Step]]:
    """Return the inputs that will be published, and the steps.

    Raises `DataError` if there is nothing to play.
    """
    if not log.topics:
        names = [SIGNALS[signal].topic for signal in sorted(log.signals)]
        messages = _table_messages(log)
    else:
        topics = input_topics(log)
        names = list(dict.fromkeys(topics.values()))
        messages = _recorded_messages(log, topics)
    if not names:
        raise DataError(f'{log.path}: there is nothing to play, no input of the monitor is in it.')
    # Successive messages with the same time are one step.
    steps = (
        Step(time_ns, [(name, data) for _, name, data in group])
        for time_ns, group in groupby(messages, key=itemgetter(0))
    )
    return names, steps


def _recorded_messages(
    log: LogContents, topics: dict[str, str]
) -> Iterator[tuple[int, str, bytes]]:
    earlier = {t for t in topics if has_earlier_codes(log.topics[t].definition)}
    for message in log.iter_messages(list(topics)):
        name, time_ns, data = topics[message.topic], message.publish_time_ns, message.data
        if name == PLANT_SAMPLE:
            time_ns = header_time_ns(data)
            if message.topic in earlier:
                data = with_todays_codes(data)
        yield time_ns, name, data


def _table_messages(log: LogContents) -> Iterator[tuple[int, str, bytes]]:
    r = log.readings
    columns = (r.time_ns.tolist(), r.signal.tolist(), r.value.tolist())
    for time_ns, signal, value in zip(*columns, strict=True):
        yield time_ns, SIGNALS[signal].topic, float64_bytes(value)


def main(args: Sequence[str] | None = None) -> int:
    """Replay or verify; return the exit status."""
    arguments = list(sys.argv if args is None else ['replay', *args])
    options = parser().parse_args(remove_ros_args(arguments)[1:])
    if not options.verify:
        stop = StopFlag().install()
        return run('replay', arguments, lambda: _replay(options, stop))
    try:
        return _verify(options.log)
    except ValveflowError as error:
        return complain('replay', str(error))
    except KeyboardInterrupt:
        print('valveflow replay: stopped.', file=sys.stderr)
        return _STOPPED
    except Exception as error:  # noqa: BLE001 - print a sentence instead of a traceback
        return complain('replay', f'failed unexpectedly: {with_place(error)}')


def _verify(path: str) -> int:
    bar = sys.stderr.isatty() and os.environ.get('TERM') != 'dumb'
    if not bar:
        # Progress lines are rare, and the first one comes after a while.
        print(
            f'Verifying {path}: its inputs are fed to the engine again, and every recorded output '
            'is compared byte for byte. The progress is printed from time to time.',
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


def _replay(options: argparse.Namespace, stop: StopFlag) -> int:
    node: Node | None = None
    try:
        try:
            log = open_log(options.log)
        except RefusedError as error:
            raise DataError(
                f'{error}\nreplay has no such options: make a log of the table first, with '
                f'valveflow import {quoted(options.log)} -o LOG.mcap and these options.'
            ) from None
        names, steps = steps_of(log)
        node = Node('replay')
        say = node.get_logger()
        for warning in log.warnings:
            say.warning(warning)
        player = Player(node, names, options.rate, not options.no_clock, lambda: bool(stop))
        missing = player.wait_for_listeners(options.wait)
        if missing and len(missing) == len(names) and options.wait > 0 and not stop:
            say.error(f'Nobody listened within {options.wait:g} s; nothing was played.')
            return 1
        say.info(f'Playing {options.log} on {", ".join(names)}.')
        player.play(steps, 'instant')
        return 0
    finally:
        stop.last()
        if node is not None:
            node.destroy_node()


if __name__ == '__main__':
    sys.exit(main())
