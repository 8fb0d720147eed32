# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The demo of OPC UA: a server with a simulated plant, the gateway and the monitor, both ways."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime, timedelta, timezone
from pathlib import Path

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import Executor
from rclpy.node import Node
from valveflow_msgs.msg import PlantSample

from valveflow_ros.errors import ValveflowError
from valveflow_ros.opcua.mapping import Security
from valveflow_ros.opcua.plant_server import NAMESPACE
from valveflow_ros.opcua.results_server import read_results
from valveflow_ros.opcua.session import check_installed
from valveflow_ros.records import SIGNALS
from valveflow_ros.ros.demo import Process, tell
from valveflow_ros.ros.domain import run, spinning
from valveflow_ros.ros.process import Parser, StopFlag

_HOURS = 6.0
_PATIENCE_S = 180.0
_UNENCRYPTED = {'policy': 'None', 'allow_unencrypted': True}
_STATUS = ('unknown', 'fresh', 'stale', 'refused', 'provisional')


class _Stopped(Exception):  # noqa: N818 - it is no error
    """The user pressed Ctrl-C, or a command failed."""


class Demo:
    """Runs the processes of the demo and subscribes to their topics.

    Logs, the mapping, the recording and the report go to ``folder``.
    """

    def __init__(self, node: Node, executor: Executor, folder: Path, stop: StopFlag) -> None:
        self._executor, self._folder, self._stop = executor, folder, stop
        self._sample: PlantSample | None = None
        self._link = ''
        node.create_subscription(PlantSample, '/plant_sample', self._on_sample, 10)
        node.create_subscription(DiagnosticArray, '/diagnostics', self._on_health, 10)
        self._port, self._offered = _free_port(), _free_port()

    def run(self) -> None:
        """Run all steps of the demo and print what happens."""
        mapping = self._write_mapping()
        with contextlib.ExitStack() as stack:
            plant = stack.enter_context(self._plant())
            tell(
                f'An OPC UA server with a simulated plant: opc.tcp://127.0.0.1:{self._port}, with '
                f'{_HOURS:g} hours of history.'
            )
            recordings = {'unit_tag': 'U1', 'record_directory': str(self._folder / 'recordings')}
            given = {'mapping_file': str(mapping)}
            for process in (
                Process('monitor', 'monitor_main', recordings, self._folder),
                Process('gateway', 'gateway_main', given, self._folder),
            ):
                stack.callback(process.end)
            self._until(self._good, 'a sample')
            values = ', '.join(f'{getattr(self._sample, i.topic):.6g} {i.unit}' for i in SIGNALS)
            tell(f'The gateway publishes plant_sample once a second: {values}.')
            self._until(self._offers, 'the way back')
            plant.kill()
            self._until(lambda: 'No link' in self._link, 'the loss')
            tell(f'The server is killed. /diagnostics: {self._link}')
            stack.enter_context(self._plant())
            self._until(lambda: 'Connected' in self._link and self._good(), 'the link')
            tell(f'It is started again. /diagnostics: {self._link}')
            self._import(mapping)

    def _import(self, mapping: Path) -> None:
        end = datetime.now(timezone.utc)
        words = ['import', f'opcua://127.0.0.1:{self._port}', '--mapping', str(mapping), '--from',
                 (end - timedelta(hours=_HOURS)).isoformat(), '--to', end.isoformat(),
                 '-o', str(self._folder / 'history.mcap'), '--overwrite']  # fmt: skip
        tell('A curve takes hours of data; the server has them: valveflow import opcua://...')
        self._valveflow(*words)
        tell('valveflow identify:')
        report = self._folder / 'result'
        self._valveflow('identify', str(self._folder / 'history.mcap'), '-o', str(report))
        tell(f'The report: {report / "report.html"}')

    def _valveflow(self, *words: str) -> None:
        command = [sys.executable, '-m', 'valveflow_ros.cli', *words, '--quiet']
        if subprocess.run(command, check=False).returncode or self._stop:
            raise _Stopped

    def _offers(self) -> bool:
        none = Security('None', '', None, None, ())
        names = [f'U1.characteristic.{name}' for name in ('status', 'cause')]
        endpoint = f'opc.tcp://127.0.0.1:{self._offered}'
        status, cause = asyncio.run(read_results(endpoint, none, names))
        if status is None:
            return False
        tell(f'Read back at {endpoint}: {names[0]} is {_STATUS[status]}. {cause}')
        return True

    @contextlib.contextmanager
    def _plant(self) -> Iterator[subprocess.Popen[bytes]]:
        log = self._folder / 'plant_server.log'
        module = 'valveflow_ros.opcua.plant_server'
        with log.open('wb') as out:
            made = subprocess.Popen(
                [sys.executable, '-m', module, '--port', str(self._port), '--hours', str(_HOURS)],
                stdin=subprocess.DEVNULL, stdout=out, stderr=out, start_new_session=True,
            )  # fmt: skip
        try:
            self._until(lambda: b'The plant is at' in log.read_bytes(), 'the server')
            yield made
        finally:
            made.kill()
            made.wait()

    def _until(self, condition: Callable[[], bool], what: str) -> None:
        end_s = time.monotonic() + _PATIENCE_S
        while not condition():
            if self._stop:
                raise _Stopped
            if time.monotonic() > end_s:
                raise ValveflowError(f'{what} did not come; see the logs in {self._folder}.')
            self._executor.spin_once(timeout_sec=0.1)

    def _good(self) -> bool:
        sample = self._sample
        return sample is not None and sample.generated_power_quality == PlantSample.QUALITY_GOOD

    def _on_sample(self, message: PlantSample) -> None:
        self._sample = message

    def _on_health(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == 'opcua_gateway: link':
                self._link = status.message

    def _write_mapping(self) -> Path:
        signals = {
            i.topic: {'node': f'nsu={NAMESPACE};s={i.topic}', 'unit': i.unit} for i in SIGNALS
        }
        path = self._folder / 'opcua.yaml'
        path.write_text(json.dumps({  # JSON is YAML
            'endpoint': f'opc.tcp://127.0.0.1:{self._port}', 'security': _UNENCRYPTED,
            'units': [{'namespace': '', 'tag': 'U1', 'signals': signals}],
            'server': {'endpoint': f'opc.tcp://127.0.0.1:{self._offered}',
                      'security': _UNENCRYPTED},
        }, indent=1))  # fmt: skip
        return path


def _free_port() -> int:
    with socket.create_server(('127.0.0.1', 0)) as free:
        return int(free.getsockname()[1])


def main(args: Sequence[str] | None = None) -> int:
    """Run the demo; return the exit status."""
    parser = Parser(prog='python -m valveflow_ros.ros.opcua_demo', description=__doc__)
    parser.add_argument(
        '--output', type=Path, required=True, metavar='DIR', help='for all results'
    )
    options: argparse.Namespace = parser.parse_args(args)
    stop = StopFlag().install()
    return run('opcua_demo', [], lambda: _run(options.output.resolve(), stop))


def _run(folder: Path, stop: StopFlag) -> int:
    check_installed()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        node = rclpy.create_node('opcua_demo')
        with spinning(node) as executor:
            Demo(node, executor, folder, stop).run()
    except _Stopped:
        return 130
    except OSError as error:
        raise ValveflowError(str(error)) from None
    return 0


if __name__ == '__main__':
    sys.exit(main())
