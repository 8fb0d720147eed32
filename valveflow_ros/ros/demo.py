"""The demo: a simulated plant and the monitor as two real processes, and what comes of it."""

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

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from valveflow_msgs.msg import FlowCharacteristic

from valveflow_ros.errors import ValveflowError, counted
from valveflow_ros.plant.simulator import DEFAULT_START_NS
from valveflow_ros.plant.unit import UnitDescription
from valveflow_ros.report.first_run import SENTENCE, is_first_run
from valveflow_ros.report.terminal.text import number, whole
from valveflow_ros.ros.conversions import from_time
from valveflow_ros.ros.demo_watch import Story, Watch, moment
from valveflow_ros.ros.process import Parser, StopFlag, with_place

# The command line of the demo.


def parser() -> argparse.ArgumentParser:
    """Return the description of the command line."""
    made = Parser(
        prog='python -m valveflow_ros.ros.demo',
        description='Run a simulated plant and the monitor as two ROS 2 processes, switch a '
        'fault on, and show what the monitor says and records.',
    )
    made.add_argument('--output', type=Path, required=True, metavar='DIR', help='for all results')
    made.add_argument(
        '--days', metavar='D', default=3.0, help='of plant (default: 3)',
        type=number('a number of days', 0, 400, '--days 3', above=True),
    )  # fmt: skip
    made.add_argument(
        '--seed', metavar='N', default=1, help='of the plant (default: 1)',
        type=whole('a whole number', 0, None, '--seed 1'),
    )  # fmt: skip
    made.add_argument(
        '--rate',
        metavar='R',
        type=number('plant seconds in a second', 0, 1e6, '--rate 600'),
        default=0.0,
        help='plant seconds in a second; 0: as fast as the monitor takes it (default: 0)',
    )
    return made


# The demo's processes: started with their output in files, and ended in order.


_PATIENCE_S = 10.0


def ros_arguments(parameters: Mapping[str, object]) -> list[str]:
    """Return parameters as they follow a node's command."""
    words = ['--ros-args']
    for name, value in parameters.items():
        text = str(value).lower() if isinstance(value, bool) else str(value)
        words += ['-p', f'{name}:={text}']
    return words


class Process:
    """A module of ours as a process of its own.

    Parameters
    ----------
    name : str
        For sentences and the name of the log file.
    module : str
    arguments : list of str
    folder : Path
        Where the log file goes.
    environment : mapping
    """

    def __init__(
        self,
        name: str,
        module: str,
        arguments: list[str],
        folder: Path,
        environment: Mapping[str, str],
    ) -> None:
        self.name = name
        self.log = folder / f'{name}.log'
        with self.log.open('wb') as out:
            self._process = subprocess.Popen(
                [sys.executable, '-m', module, *arguments],
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=subprocess.STDOUT,
                env=dict(environment),
                # Ctrl-C comes to the demo alone, which then ends the others in order.
                start_new_session=True,
            )

    @property
    def status(self) -> int | None:
        """Return the exit status, None while it runs."""
        return self._process.poll()

    def must_run(self) -> None:
        """Raise `ValveflowError` with its last words if it has ended with an error."""
        if self.status:
            raise ValveflowError(
                f'The process {self.name} ended with status {self.status}: {self.last_line()}'
            )

    def last_line(self) -> str:
        """Return the last line of its output."""
        lines = self.log.read_text(errors='replace').strip().splitlines()
        return lines[-1] if lines else f'it said nothing (see {self.log})'

    def end(self) -> int:
        """Ask it to end, wait, and return its exit status; doing it again changes nothing."""
        if self.status is None:
            self._process.send_signal(signal.SIGTERM)
            try:
                self._process.wait(_PATIENCE_S)
            except subprocess.TimeoutExpired:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(self._process.pid, signal.SIGKILL)
                self._process.wait()
        return self._process.returncode


_DAY_NS = 86400 * 10**9
_FAULT = 'curve_step'
_FAULT_MW = -12.0
_FAULT_FROM = 0.5  # share of the run after which the fault begins
_QUIET_LOOKS = 3
_LONGEST_WAIT_S = 120.0


def tell(line: str) -> None:
    """Say something to the person in front."""
    print(line, flush=True)


class Demo:
    """One run of the demo.

    Parameters
    ----------
    options : argparse.Namespace
    stop : StopFlag
    """

    def __init__(self, options: argparse.Namespace, stop: StopFlag) -> None:
        self._options = options
        self._stop = stop
        self.folder: Path = options.output.resolve()
        self.fault_ns = DEFAULT_START_NS + round(_FAULT_FROM * options.days * _DAY_NS)
        self._story = Story(self.fault_ns, tell)
        self._processes: list[Process] = []

    def run(self) -> int:
        """Do everything; return the exit status."""
        self.folder.mkdir(parents=True, exist_ok=True)
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
        watch = Watch(DEFAULT_START_NS, self._story)
        executor = SingleThreadedExecutor()
        executor.add_node(watch)
        try:
            self._introduce()
            begun_s = time.monotonic()
            monitor, plant = self._start()
            self._follow(watch, executor, monitor, plant)
            if self._stop:
                return 130
            self._close(monitor, watch, time.monotonic() - begun_s)
            return self._conclude(watch)
        finally:
            for process in self._processes:
                process.end()
            executor.shutdown()
            watch.destroy_node()
            rclpy.try_shutdown()

    def _introduce(self) -> None:
        o = self._options
        speed = f'{o.rate:g} times real time' if o.rate else 'as fast as the monitor takes them'
        tell(
            f"{counted(o.days, 'day')} of the paper's unit (seed {o.seed}), from "
            f'{moment(DEFAULT_START_NS)} UTC on, {speed}.'
        )
        tell(
            f'Hidden in it: from {moment(self.fault_ns)} on one of the valves gives up to '
            f'{-_FAULT_MW:g} MW less, whenever the load needs that valve. The monitor is not told.'
        )
        domain = os.environ['ROS_DOMAIN_ID']
        tell(
            'To look on from another terminal (after: source env.sh): '
            f'ROS_DOMAIN_ID={domain} valveflow watch'
        )
        tell(f'Starting the monitor. {SENTENCE}' if is_first_run() else 'Starting the monitor.')

    def _start(self) -> tuple[Process, Process]:
        o = self._options
        monitor = self._process(
            'monitor',
            'valveflow_ros.ros.monitor_main',
            {
                'unit_tag': 'demo',
                'record_directory': self.folder / 'recordings',
                # Shown anew each time.
                'keep_state': False,
                'refit_period': 14400.0,
                'refit_segments': 0,
                # Here a night is over before a diagnosis is.
                'diagnosis_hour': -1,
                # The plant does not wait for the disk; neither does a demo for a slow one.
                'record_flush': 1.0,
            },
        )
        fault = f'{_FAULT}:s_mw={_FAULT_MW:g},t0_days={_FAULT_FROM * o.days:.6g}'
        plant = self._process(
            'plant',
            'valveflow_ros.ros.simulator_main',
            {
                'days': o.days,
                'seed': o.seed,
                'rate': float(o.rate),
                'stamped': True,
                'unit_tag': 'demo',
                'effects': f'"{fault}"',
                'wait': 600.0,
            },
        )
        return monitor, plant

    def _process(self, name: str, module: str, parameters: dict[str, object]) -> Process:
        process = Process(name, module, ros_arguments(parameters), self.folder, os.environ)
        self._processes.append(process)
        return process

    def _follow(
        self, watch: Watch, executor: SingleThreadedExecutor, monitor: Process, plant: Process
    ) -> None:
        """Listen until the plant has ended, all of it was diagnosed, and nothing is left to do."""
        quiet, seen, samples = 0, 0, -1
        ended_s: float | None = None
        while not self._stop and quiet < _QUIET_LOOKS:
            executor.spin_once(timeout_sec=0.1)
            watch.work()
            monitor.must_run()
            plant.must_run()
            if monitor.status is not None:
                raise ValveflowError(f'The monitor ended by itself: {monitor.last_line()}')
            if plant.status is None:
                continue
            ended_s = ended_s or time.monotonic()
            if time.monotonic() - ended_s > _LONGEST_WAIT_S:
                raise ValveflowError(f'The monitor does not come to rest; see {monitor.log}.')
            if watch.health_seen > seen:
                seen = watch.health_seen
                still = watch.samples == samples and not watch.busy
                quiet = quiet + 1 if still else 0
                samples = watch.samples
            if quiet == _QUIET_LOOKS and not watch.asked:
                watch.ask_for_diagnosis()
                quiet = 0

    def _close(self, monitor: Process, watch: Watch, seconds: float) -> None:
        status = monitor.end()
        tell(
            f'The plant has ended: {counted(watch.samples, "sample")} in {seconds:.0f} s; '
            f'monitor closed with status {status}.'
        )
        if status != 0:
            raise ValveflowError(f'The monitor ended with status {status}: {monitor.last_line()}')

    def _conclude(self, watch: Watch) -> int:
        found = (self.folder / 'recordings').glob('valveflow_*')
        recording = max(found, key=lambda p: p.stat().st_mtime)
        result = self.folder / 'result'
        ok = self._run('replay --verify', 'ros.replay_main', str(recording), '--verify')
        for verb in ('identify', 'diagnose'):
            files = str(recording), '-o', str(result / verb)
            ok &= self._run(f'valveflow {verb}', 'cli', verb, *files)
        curve = self._last_clean(watch.curves)
        if curve is None:
            tell('No curve was found before the fault.')
            return 1
        self._compare(curve)
        told = [time_ns for time_ns in self._story.raised if time_ns >= self.fault_ns]
        tell(self._story.outcome())
        named = self._named(watch)
        self._point_out(recording, result)
        if ok and told and watch.acknowledged and named:
            return 0
        tell('Not all of it came out: a run of three days (the default) is enough for that.')
        return 1

    def _named(self, watch: Watch) -> bool:
        """Tell what the last diagnosis named, and whether that is what was hidden."""
        last = watch.diagnoses[-1] if watch.diagnoses else None
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
        return found == [_FAULT]

    def _run(self, what: str, module: str, *arguments: str) -> bool:
        """Run a command of ours to its end; show its last line."""
        tell(f'{what} ...')
        done = subprocess.run(
            [sys.executable, '-m', f'valveflow_ros.{module}', *arguments],
            capture_output=True,
            text=True,
            check=False,
        )
        lines = (done.stdout if done.returncode == 0 else done.stderr or done.stdout).strip()
        tell(f'  {lines.splitlines()[-1] if lines else "done"}')
        return done.returncode == 0

    def _last_clean(self, curves: list[FlowCharacteristic]) -> FlowCharacteristic | None:
        """Return the last curve fitted to data without the fault."""
        clean = [c for c in curves if from_time(c.window_end) <= self.fault_ns]
        return clean[-1] if clean else None

    def _compare(self, found: FlowCharacteristic) -> None:
        true = UnitDescription().curve
        tell(
            f'The last curve before the fault (data until {moment(from_time(found.window_end))}), '
            'and the truth, which only the simulated plant knows:'
        )
        tell('  piece   slope, 95 % [MW per % MPa^(9/8)]     true     knee found (95 %)     true')
        for k in range(max(found.pieces, len(true.slopes))):
            line = f'  {k + 1:>5}   '
            if k < found.pieces:
                line += f'{found.slopes[k]:.4f} +- {1.96 * found.slope_stderr[k]:.4f}'
            line = f'{line:<47}'
            line += f'{true.slopes[k]:.4f}   ' if k < len(true.slopes) else '     -   '
            if k < found.pieces - 1:
                low, high = found.breakpoint_low[k], found.breakpoint_high[k]
                line += f'{found.breakpoints[k + 1]:.0f} ({low:.0f} to {high:.0f})'
            line = f'{line:<78}'
            tell(line + (f'{true.knots[k + 1]:.0f}' if k < len(true.slopes) - 1 else ''))

    def _point_out(self, recording: Path, result: Path) -> None:
        files = sorted(recording.glob('*.mcap'))
        table = result / 'identify' / 'characteristic.json'
        pieces = len(json.loads(table.read_text())['pieces']) if table.exists() else 0
        tell(f'Recording  {", ".join(map(str, files))}')
        report = result / 'identify' / 'report.html'
        tell(f'Report     {report} ({pieces} pieces over the whole run, fault included)')
        tell(f'Diagnosis  {result / "diagnose" / "report.html"}')
        tell('Replay it to another monitor (after: source env.sh):')
        tell(f'  python -m valveflow_ros.ros.replay_main {recording} --rate 600')
        tell('  python -m valveflow_ros.ros.monitor_main --ros-args -p use_sim_time:=true')


def main(args: Sequence[str] | None = None) -> int:
    """Run the demo; return the exit status."""
    options = parser().parse_args(args)
    # A domain of its own: two demos, or a demo beside a plant, do not meet.
    os.environ['ROS_DOMAIN_ID'] = str(os.getpid() % 101 + 1)
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    stop = StopFlag().install()
    try:
        status = Demo(options, stop).run()
    except ValveflowError as error:
        print(f'valveflow demo: {error}', file=sys.stderr)
        return 1
    except OSError as error:
        place = error.filename or options.output
        print(f'valveflow demo: {place}: {error.strerror}', file=sys.stderr)
        return 1
    except Exception as error:  # noqa: BLE001 - a person is owed a sentence, not a trace
        print(f'valveflow demo: failed unexpectedly: {with_place(error)}', file=sys.stderr)
        return 1
    if stop:
        tell('Stopped; nothing is left running.')
    return status


if __name__ == '__main__':
    sys.exit(main())
