# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The demo: runs a simulated plant and the monitor as two processes and shows the results."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import Executor
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import Trigger
from valveflow_msgs.msg import Alarm, Diagnosis, FlowCharacteristic

from valveflow_ros.errors import ValveflowError, counted
from valveflow_ros.plant.simulator import DEFAULT_START_NS
from valveflow_ros.plant.unit import UnitDescription
from valveflow_ros.records import NS_PER_S
from valveflow_ros.report.first_run import SENTENCE, is_first_run
from valveflow_ros.report.terminal.text import number, whole
from valveflow_ros.report.words import moment
from valveflow_ros.ros.decoding import from_time
from valveflow_ros.ros.domain import run, spinning
from valveflow_ros.ros.listening import LATCHED
from valveflow_ros.ros.process import Parser, StopFlag

_HOUR_NS = 3600 * 10**9
_FAULT, _FAULT_MW = 'curve_step', -12.0
_FAULT_FROM = 0.5  # fraction of the run after which the fault begins
_MONITOR = '/valveflow_monitor'
_DAYS = 3.0
_BEFORE_ACKNOWLEDGING_S = 0.2
_PATIENCE_S = 10.0
_QUIET_LOOKS = 3
_LONGEST_WAIT_S = 120.0
_VERDICTS = {
    Diagnosis.NOTHING: 'nothing found',
    Diagnosis.UNEXPLAINED: 'something that it cannot name',
}


def parser() -> argparse.ArgumentParser:
    """Return the command-line parser."""
    made = Parser(
        prog='python -m valveflow_ros.ros.demo',
        description='Run a simulated plant and the monitor as two ROS 2 processes, switch a '
        'fault on, and show what the monitor says and records.',
    )
    made.add_argument('--output', type=Path, required=True, metavar='DIR', help='for all results')
    made.add_argument(
        '--days', metavar='D', default=_DAYS, help=f'of plant (default: {_DAYS:g})',
        type=number('a number of days', 0, 400, '--days 3', above=True),
    )  # fmt: skip
    made.add_argument(
        '--seed', metavar='N', default=1, help='of the plant (default: 1)',
        type=whole('a whole number', 0, None, '--seed 1'),
    )  # fmt: skip
    made.add_argument(
        '--rate', metavar='R', default=0.0,
        type=number('plant seconds in a second', 0, 1e6, '--rate 600'),
        help='plant seconds in a second; 0: as fast as the monitor takes it (default: 0)',
    )  # fmt: skip
    return made


def ros_arguments(parameters: Mapping[str, object]) -> list[str]:
    """Return parameters as ROS arguments of a command."""
    words = ['--ros-args']
    for name, value in parameters.items():
        text = str(value).lower() if isinstance(value, bool) else str(value)
        words += ['-p', f'{name}:={text}']
    return words


def tell(line: str) -> None:
    """Print a line."""
    print(line, flush=True)


def minute(time_ns: int) -> str:
    """Return a time as '2023-11-15 00:00', in UTC."""
    return moment(time_ns)[:16]


class Process:
    """A module of this package in its own process, with its output in the file ``name.log``."""

    def __init__(
        self, name: str, module: str, parameters: Mapping[str, object], folder: Path
    ) -> None:
        self.name, self.log = name, folder / f'{name}.log'
        command = [sys.executable, '-m', f'valveflow_ros.ros.{module}', *ros_arguments(parameters)]
        with self.log.open('wb') as out:
            # Ctrl-C reaches only the demo, which then ends the other processes in order.
            self._process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=out, stderr=out, start_new_session=True
            )

    @property
    def status(self) -> int | None:
        """Return the exit status, None while it runs; raise `ValveflowError` if it failed."""
        status = self._process.poll()
        if status:
            raise ValveflowError(
                f'The process {self.name} ended with status {status}: {self.last_line()}'
            )
        return status

    def last_line(self) -> str:
        """Return the last line of its output."""
        lines = self.log.read_text(errors='replace').strip().splitlines()
        return lines[-1] if lines else f'it said nothing (see {self.log})'

    def end(self) -> int:
        """Ask the process to end, wait, and return its exit status; may be called again."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGTERM)
            try:
                self._process.wait(_PATIENCE_S)
            except subprocess.TimeoutExpired:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(self._process.pid, signal.SIGKILL)
                self._process.wait()
        return self._process.returncode


class Story:
    """Prints the first curve, each alarm and each diagnosis of the monitor.

    ``fault_ns`` is the time at which the hidden fault begins.
    """

    def __init__(self, fault_ns: int) -> None:
        self._fault_ns, self._fault_told = fault_ns, False
        self._occurrences: dict[str, int] = {}
        self.alarms_of_fault: list[int] = []  # times of the alarms since then, in ns
        self.curves: list[FlowCharacteristic] = []
        self.cause = ''  # why there is no curve
        self.diagnoses: list[Diagnosis] = []

    def on_curve(self, message: FlowCharacteristic) -> None:
        """Keep a new curve; print the first one."""
        self.cause = message.cause
        time_ns = from_time(message.window_end)
        known = self.curves and self.curves[-1].model_id == message.model_id
        if message.status != FlowCharacteristic.FRESH or known:
            return
        self.reached(time_ns)
        self.curves.append(message)
        if len(self.curves) == 1:
            knees = ', '.join(f'{u:.0f}' for u in message.breakpoints[1:-1])
            pieces = counted(message.pieces, 'piece')
            where = f'breakpoints at u = {knees}' if knees else 'no breakpoint'
            _tell_at(time_ns, f'first curve: {pieces}, {where}')

    def on_alarm(self, message: Alarm) -> None:
        """Print a new alarm; one that was suppressed and is active again is not new."""
        time_ns = from_time(message.header.stamp)
        again = message.occurrence == self._occurrences.get(message.name)
        if message.state != Alarm.UNACKNOWLEDGED or again:
            return
        self.reached(time_ns)
        self._occurrences[message.name] = message.occurrence
        if time_ns >= self._fault_ns:
            self.alarms_of_fault.append(time_ns)
        _tell_at(time_ns, f'ALARM {message.name}: {message.sentence}')

    def on_diagnosis(self, message: Diagnosis) -> None:
        """Print a diagnosis."""
        if message.verdict == Diagnosis.UNKNOWN and not message.model_id:
            return
        self.diagnoses.append(message)
        until_ns = from_time(message.header.stamp)
        self.reached(until_ns)
        told = _VERDICTS.get(message.verdict, 'unknown')
        if message.causes:
            names = ', '.join(cause.name for cause in message.causes)
            told = f'named {names}. {message.sentence}'
        _tell_at(until_ns, f'diagnosis of the data so far: {told}')

    def outcome(self) -> str:
        """Return a sentence about the alarms on the fault."""
        told = self.alarms_of_fault
        if not told:
            return 'The fault raised no alarm.'
        hours = (told[0] - self._fault_ns) / _HOUR_NS
        more = '' if len(told) == 1 else f'; alarms in all: {len(told)}'
        began = f'The fault began {minute(self._fault_ns)}'
        return f'{began}; the first alarm came {hours:.1f} h later{more}.'

    def reached(self, time_ns: int) -> None:
        """Print that the fault begins, once the plant has reached that time."""
        if not self._fault_told and time_ns >= self._fault_ns:
            self._fault_told = True
            curves = counted(len(self.curves), 'curve')
            _tell_at(self._fault_ns, f'--- the fault begins; {curves} so far ---')


def _tell_at(time_ns: int, words: str) -> None:
    tell(f'{minute(time_ns)}  {words}')


class Watch(Node):
    """Subscribes to the monitor and acknowledges its alarms."""

    def __init__(self, story: Story) -> None:
        super().__init__('valveflow_demo')
        self._story = story
        self._acknowledge_at_s: float | None = None
        self.acknowledged = self.samples = self.health_seen = 0
        self.busy = self.asked = False
        for kind, topic, take in (
            (FlowCharacteristic, 'characteristic', story.on_curve),
            (Alarm, 'alarms', self._on_alarm),
            (Diagnosis, 'diagnosis', story.on_diagnosis),
        ):
            self.create_subscription(kind, f'{_MONITOR}/{topic}', take, LATCHED)
        self.create_subscription(DiagnosticArray, '/diagnostics', self._on_health, 10)
        self._acknowledge = self.create_client(Trigger, f'{_MONITOR}/acknowledge_alarms')
        self._diagnose = self.create_client(Trigger, f'{_MONITOR}/diagnose')

    def work(self) -> None:
        """Acknowledge an alarm after a short delay."""
        if self._acknowledge_at_s is None or time.monotonic() < self._acknowledge_at_s:
            return
        if self._acknowledge.service_is_ready():
            self._acknowledge_at_s = None
            future = self._acknowledge.call_async(Trigger.Request())
            future.add_done_callback(self._on_answer)

    def ask_for_diagnosis(self) -> None:
        """Request a diagnosis of all data; the health messages show when it has finished."""
        self.asked = True
        self._diagnose.call_async(Trigger.Request())

    def _on_alarm(self, message: Alarm) -> None:
        self._story.on_alarm(message)
        if message.state in (Alarm.UNACKNOWLEDGED, Alarm.RETURNED_UNACKNOWLEDGED):
            self._acknowledge_at_s = time.monotonic() + _BEFORE_ACKNOWLEDGING_S

    def _on_health(self, message: DiagnosticArray) -> None:
        values = {
            status.name.rpartition(' ')[2]: {item.key: item.value for item in status.values}
            for status in message.status
        }
        if 'fit' in values:
            self.samples = int(values['fit'].get('Samples taken in all runs', '0'))
            self._story.reached(DEFAULT_START_NS + self.samples * NS_PER_S)
        refitting = values.get('fit', {}).get('Refit under way for (s)', 'unknown') != 'unknown'
        self.busy = refitting or values.get('diagnosis', {}).get('Running') == 'yes'
        self.health_seen += 1

    def _on_answer(self, future: Future) -> None:
        response: Trigger.Response | None = future.result()
        self.acknowledged += int(response is not None and response.success)


def _show(options: argparse.Namespace, stop: StopFlag) -> int:
    folder: Path = options.output.resolve()
    fault_ns = DEFAULT_START_NS + round(_FAULT_FROM * options.days * 24 * _HOUR_NS)
    story = Story(fault_ns)
    watch = Watch(story)
    with contextlib.ExitStack() as stack:
        executor = stack.enter_context(spinning(watch))
        _introduce(options, fault_ns)
        begun_s = time.monotonic()
        processes = []
        for name, module, parameters in _commands(options, folder):
            processes.append(Process(name, module, parameters, folder))
            stack.callback(processes[-1].end)
        monitor, plant = processes
        _follow(watch, executor, monitor, plant, stop)
        if stop:
            return 130
        status = monitor.end()
        tell(
            f'The plant has ended: {counted(watch.samples, "sample")} in '
            f'{time.monotonic() - begun_s:.0f} s; monitor closed with status {status}.'
        )
        if status != 0:
            raise ValveflowError(f'The monitor ended with status {status}: {monitor.last_line()}')
        return _conclude(watch, story, folder, fault_ns, options.days)


def _introduce(options: argparse.Namespace, fault_ns: int) -> None:
    rate = options.rate
    speed = f'{rate:g} times real time' if rate else 'as fast as the monitor takes them'
    starting = f'Starting the monitor. {SENTENCE}' if is_first_run() else 'Starting the monitor.'
    for line in (
        f"{counted(options.days, 'day')} of the paper's unit (seed {options.seed}), from "
        f'{minute(DEFAULT_START_NS)} UTC on, {speed}.',
        f'Hidden in it: from {minute(fault_ns)} on one of the valves gives up to '
        f'{-_FAULT_MW:g} MW less, whenever the load needs that valve. The monitor is not told.',
        'To watch from another terminal (after: source env.sh): '
        f'ROS_DOMAIN_ID={os.environ["ROS_DOMAIN_ID"]} valveflow watch',
        starting,
    ):
        tell(line)


def _commands(
    options: argparse.Namespace, folder: Path
) -> list[tuple[str, str, dict[str, object]]]:
    """Return name, module and parameters of both processes."""
    monitor: dict[str, object] = {
        'unit_tag': 'demo', 'record_directory': folder / 'recordings',
        # Each demo starts without a saved state, and uses the plant's time.
        'keep_state': False, 'use_sim_time': True,
        'refit_period': 14400.0, 'refit_segments': 0,
        # A night takes less time here than a diagnosis.
        'diagnosis_hour': -1,
        # The simulated plant runs fast and does not wait for the disk.
        'record_flush': 1.0,
    }  # fmt: skip
    fault = f'{_FAULT}:s_mw={_FAULT_MW:g},t0_days={_FAULT_FROM * options.days:.6g}'
    plant: dict[str, object] = {
        'days': options.days, 'seed': options.seed, 'rate': float(options.rate), 'stamped': True,
        'use_clock': True, 'unit_tag': 'demo', 'effects': f'"{fault}"', 'wait': 600.0,
    }  # fmt: skip
    return [('monitor', 'monitor_main', monitor), ('plant', 'simulator_main', plant)]


def _follow(
    watch: Watch,
    executor: Executor,
    monitor: Process,
    plant: Process,
    stop: StopFlag,
) -> None:
    """Listen until the plant has ended, its data were diagnosed, and the monitor is idle."""
    quiet, seen, samples = 0, 0, -1
    ended_s: float | None = None
    while not stop and quiet < _QUIET_LOOKS:
        executor.spin_once(timeout_sec=0.1)
        watch.work()
        if monitor.status is not None:
            raise ValveflowError(f'The monitor ended by itself: {monitor.last_line()}')
        if plant.status is None:
            continue
        ended_s = ended_s or time.monotonic()
        if time.monotonic() - ended_s > _LONGEST_WAIT_S:
            raise ValveflowError(f'The monitor does not come to rest; see {monitor.log}.')
        if watch.health_seen > seen:
            still = watch.samples == samples and not watch.busy
            quiet = quiet + 1 if still else 0
            seen, samples = watch.health_seen, watch.samples
        if quiet == _QUIET_LOOKS and not watch.asked:
            watch.ask_for_diagnosis()
            quiet = 0


def _conclude(watch: Watch, story: Story, folder: Path, fault_ns: int, days: float) -> int:
    recording = max((folder / 'recordings').glob('valveflow_*'), key=lambda p: p.stat().st_mtime)
    result = folder / 'result'
    missing = []
    if not _run('replay --verify', 'ros.replay_main', str(recording), '--verify'):
        missing.append('the replay differs from the recording')
    for verb in ('identify', 'diagnose'):
        if not _run(f'valveflow {verb}', 'cli', verb, str(recording), '-o', str(result / verb)):
            missing.append(f'{verb} failed')
    clean = [c for c in story.curves if from_time(c.window_end) <= fault_ns]
    if not clean:
        if story.cause:
            tell(story.cause)
        tell(told_in_the_end(['no curve was found before the fault', *missing], days))
        return 1
    _compare(clean[-1])
    tell(story.outcome())
    last = story.diagnoses[-1] if story.diagnoses else None
    found = [] if last is None else [cause.name for cause in last.causes]
    tell(f'Hidden was {_FAULT}; the diagnosis named {", ".join(found) or "nothing"}.')
    if last is not None:
        tell(f'  {last.sentence}')
        if last.rmse_extended < last.rmse_simulation:
            tell(
                f'  On time it had not seen, the error falls from {last.rmse_simulation:.2f} '
                f'to {last.rmse_extended:.2f} MW with the cause in the model (noise: '
                f'{last.rmse_noise_floor:.2f} MW).'
            )
    table = result / 'identify' / 'characteristic.json'
    pieces = len(json.loads(table.read_text())['pieces']) if table.exists() else 0
    report = result / 'identify' / 'report.html'
    for line in (
        f'Recording  {", ".join(map(str, sorted(recording.glob("*.mcap"))))}',
        f'Report     {report} ({pieces} pieces over the whole run, fault included)',
        f'Diagnosis  {result / "diagnose" / "report.html"}',
        'Replay it to another monitor (after: source env.sh):',
        f'  python -m valveflow_ros.ros.replay_main {recording} --rate 600',
        '  python -m valveflow_ros.ros.monitor_main --ros-args -p use_sim_time:=true',
    ):
        tell(line)
    if not story.alarms_of_fault or not watch.acknowledged:
        missing.append('no alarm on the fault was raised and acknowledged')
    if found != [_FAULT]:
        missing.append('the diagnosis did not name the fault alone')
    tell(told_in_the_end(missing, days))
    return 1 if missing else 0


def told_in_the_end(missing: Sequence[str], days: float) -> str:
    """Return the last line of the demo: success, or what is missing."""
    if not missing:
        return 'All came out, and the replay was identical to the recording, byte for byte.'
    enough = f' {_DAYS:g} days (--days) are enough for that.' if days < _DAYS else ''
    return f'Not all came out: {"; ".join(missing)}.{enough}'


def _run(what: str, module: str, *arguments: str) -> bool:
    """Run a command of this package to its end and print its last line."""
    tell(f'{what} ...')
    command = [sys.executable, '-m', f'valveflow_ros.{module}', *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    lines = (done.stdout if done.returncode == 0 else done.stderr or done.stdout).strip()
    tell(f'  {lines.splitlines()[-1] if lines else "done"}')
    return done.returncode == 0


def _compare(found: FlowCharacteristic) -> None:
    """Print the fitted curve next to the true curve of the simulated plant."""
    true = UnitDescription().curve
    tell(
        f'The last curve before the fault (data until {minute(from_time(found.window_end))}), '
        'and the truth, which only the simulated plant knows:'
    )
    head = '  piece   slope, 95 % [MW per % MPa^(9/8)]'
    tell(f'{head:<47}{"true":<9}{"breakpoint (95 %)":<22}true')
    for k in range(max(found.pieces, len(true.slopes))):
        slope = knee = ''
        if k < found.pieces:
            slope = f'{found.slopes[k]:.4f} +- {1.96 * found.slope_stderr[k]:.4f}'
        if k < found.pieces - 1:
            low, high = found.breakpoint_low[k], found.breakpoint_high[k]
            knee = f'{found.breakpoints[k + 1]:.0f} ({low:.0f} to {high:.0f})'
        true_slope = f'{true.slopes[k]:.4f}   ' if k < len(true.slopes) else '     -   '
        true_knee = f'{true.knots[k + 1]:.0f}' if k < len(true.slopes) - 1 else ''
        line = f'{f"  {k + 1:>5}   {slope}":<47}{true_slope}{knee}'
        tell(f'{line:<78}{true_knee}')


def main(args: Sequence[str] | None = None) -> int:
    """Run the demo; return the exit status."""
    options = parser().parse_args(args)
    # Use a separate ROS domain, so that the demo does not interfere with others or a plant.
    os.environ['ROS_DOMAIN_ID'] = str(os.getpid() % 101 + 1)
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    stop = StopFlag().install()

    def work() -> int:
        try:
            options.output.mkdir(parents=True, exist_ok=True)
            return _show(options, stop)
        except OSError as error:
            place = error.filename or options.output
            raise ValveflowError(f'{place}: {error.strerror}') from None

    status = run('demo', [], work)
    if stop:
        tell('Stopped; nothing is left running.')
    return status


if __name__ == '__main__':
    sys.exit(main())
