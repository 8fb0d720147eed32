# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Acts put together at random against a running monitor: its claims are held against the truth.

The truth is what the stock reader finds in the files, damaged ones recovered; the claims are the
closing account, the health and the exit status.
"""

from __future__ import annotations

import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray
from log_files import numbered
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_srvs.srv import Trigger

from benchmarks.torture.monitors import MANY, Inputs, killed, ros_node
from benchmarks.torture.stepped_clock import SECONDS
from benchmarks.torture.trial import Options, Outcome
from valveflow_ros.errors import ValveflowError
from valveflow_ros.logs import recover
from valveflow_ros.ros.demo import ros_arguments
from valveflow_ros.ros.node.outputs import OUTPUTS, SERVICES
from valveflow_ros.state import from_bytes

RUNS = 200
ACTS = (2, 5)
# Between two acts; the recorder looks twice a second.
PAUSE_S = (0.0, 1.5)
# Finished files are looked at each 2 s, and the health comes once a second.
HEALTH_S = 3.5
PERIOD_S = 0.01
PATIENCE_S = 60.0
END_S = 10.0
ANSWER_S = 1.0
BURST = 17
DAY_S = 86_400.0
# Latched outputs, each of which keeps some.
REPEATED = sum(topic.latched for topic in OUTPUTS.values())
Key = tuple[str, int]


@dataclass(slots=True)
class Session:
    """One process of the monitor and what it said."""

    process: subprocess.Popen[str]
    lines: list[str] = field(default_factory=list)
    listener: threading.Thread = field(init=False)

    def __post_init__(self) -> None:
        self.listener = threading.Thread(target=self._listen, daemon=True)
        self.listener.start()

    def _listen(self) -> None:
        assert self.process.stdout is not None
        self.lines.extend(self.process.stdout)

    def says(self, text: str) -> bool:
        """Tell whether it said so by now."""
        return any(text in line for line in list(self.lines))

    def claim(self) -> tuple[Path, int] | None:
        """Return the recording and the messages in it, by its closing account."""
        for line in self.lines:
            if match := re.search(r'Recorded (\d+) messages? to (\S+?)\.( |$)', line):
                return Path(match[2]), int(match[1])
        return None


class Gateway:
    """Publishes four signals without a pause, hears the health and calls the services."""

    def __init__(self, node: Node, executor: SingleThreadedExecutor) -> None:
        self.health: dict[str, str] = {}
        self._inputs, self._executor = Inputs(node), executor
        node.create_subscription(DiagnosticArray, '/diagnostics', self._heard, MANY)
        name = '/valveflow_monitor'
        self._triggers = [
            node.create_client(Trigger, f'{name}/{service}', qos_profile=MANY)
            for service in SERVICES
        ]
        self._setter = node.create_client(
            SetParameters, f'{name}/set_parameters', qos_profile=MANY
        )
        self._going, self._renew = True, threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def start_again(self) -> None:
        """Publish with new publishers, as a gateway that was started again."""
        self._renew.set()
        while self._renew.is_set():
            time.sleep(PERIOD_S)

    def _heard(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.endswith('recorder'):
                self.health = {value.key: value.value for value in status.values}

    def _run(self) -> None:
        while self._going:
            if self._renew.is_set():
                self._inputs.renew()
                self._renew.clear()
            self._inputs.publish()
            end_s = time.monotonic() + PERIOD_S
            while (left_s := end_s - time.monotonic()) > 0:
                self._executor.spin_once(timeout_sec=left_s)

    def storm(self) -> tuple[int, int, float]:
        """Call everything at once; return calls, answers, and how long the last one took."""
        value = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=7200.0)
        change = SetParameters.Request(
            parameters=[Parameter(name='alarm_shelve_time', value=value)]
        )
        begun_s = time.monotonic()
        futures = [
            *(t.call_async(Trigger.Request()) for t in self._triggers for _ in range(BURST)),
            *(self._setter.call_async(change) for _ in range(BURST)),
        ]
        while not all(f.done() for f in futures) and time.monotonic() < begun_s + PATIENCE_S / 4:
            time.sleep(0.005)
        return len(futures), sum(f.done() for f in futures), time.monotonic() - begun_s

    def close(self) -> None:
        """Publish no more."""
        self._going = False
        self._thread.join()


class World:
    """One composed run: a folder, a clock, and the monitors started in it."""

    def __init__(self, folder: Path, gateway: Gateway, generator: random.Random) -> None:
        self.folder, self.gateway, self.generator = folder, gateway, generator
        self.recordings = folder / 'recordings'
        self._clock = folder / 'clock'
        self.state = self.recordings / 'state_unit' / 'monitor.state'
        folder.mkdir()
        self._clock.write_bytes(SECONDS.pack(0.0))
        self.sessions: list[Session] = []
        self.storms: list[tuple[int, int, float]] = []
        self.problems: list[str] = []
        # Messages that were there when the last monitor began.
        self.before: dict[Path, set[Key]] = {}
        self.start()

    @property
    def session(self) -> Session:
        """Return the monitor that runs now."""
        return self.sessions[-1]

    def start(self) -> None:
        """Start a monitor and wait until it records."""
        self.sessions.append(self.new_session())
        self.wait(lambda: int(self.gateway.health.get('Messages written', 0)) > 0)

    def new_session(self) -> Session:
        """Start a monitor."""
        command = [sys.executable, '-m', 'benchmarks.torture.stepped_clock', str(self._clock)]
        parameters = {
            'record_directory': self.recordings, 'sample_period': 0.1,
            'record_rotation': 60.0, 'input_reliability': 'reliable',
        }  # fmt: skip
        self.gateway.health = {}
        process = subprocess.Popen(
            [*command, *ros_arguments(parameters)], text=True, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )  # fmt: skip
        return Session(process)

    def wait(self, done: Callable[[], object]) -> bool:
        """Wait until it is done or the monitor has ended; tell whether it is."""
        end_s = time.monotonic() + PATIENCE_S
        while not done() and time.monotonic() < end_s and self.session.process.poll() is None:
            time.sleep(0.02)
        return bool(done())

    def any_file(self) -> list[Path]:
        """Return a finished or growing file of any recording, if there is one."""
        found = [
            p for end in ('', '.part') for p in sorted(self.recordings.glob(f'*/*.mcap{end}'))
        ]
        return [self.generator.choice(found)] if found else []

    def recording(self) -> list[Path]:
        """Return the newest recording, if there is one."""
        return sorted(self.recordings.glob('valveflow_*'))[-1:]

    def aside(self) -> Path:
        """Return a new place outside of the recordings."""
        return self.folder / f'moved_{time.monotonic_ns()}'

    def step_clock(self, seconds: float) -> None:
        """Step the clock of all monitors."""
        now_s = SECONDS.unpack(self._clock.read_bytes())[0]
        with self._clock.open('r+b') as stream:
            stream.write(SECONDS.pack(now_s + seconds))

    def kill_and_start(self, later_s: float = 0.0) -> None:
        """Kill the monitor and start another, with a clock that went on meanwhile."""
        killed(self.session.process)
        self.before = truth(self.folder)
        self.step_clock(later_s)
        self.start()


Act = Callable[[World], object]


def truth(folder: Path) -> dict[Path, set[Key]]:
    """Return what a reader finds in each recording: topic and number of each message."""
    found: dict[Path, set[Key]] = {}
    for path in sorted(folder.glob('recordings/valveflow_*/*.mcap*')):
        keys = found.setdefault(path.parent, set())
        try:
            keys |= _keys(path)
        except Exception:  # noqa: BLE001 - readers raise what they like
            with tempfile.TemporaryDirectory() as scratch, suppress(ValveflowError):
                recover(path, Path(scratch, 'whole.mcap'))
                keys |= _keys(Path(scratch, 'whole.mcap'))
    return found


def _keys(path: Path) -> set[Key]:
    return {(message.topic, number) for message, number in numbered(path)}


# The acts. Each takes a world and does one thing to it.


def _truncate(path: Path, generator: random.Random) -> None:
    os.truncate(path, generator.randrange(path.stat().st_size + 1))


def _extend(path: Path, generator: random.Random) -> None:
    with path.open('ab') as stream:
        stream.write(generator.randbytes(100))


def _overwrite(path: Path, generator: random.Random) -> None:
    with path.open('r+b') as stream:
        stream.seek(generator.randrange(path.stat().st_size + 1))
        stream.write(generator.randbytes(50))


def _to_a_file(change: Callable[[Path, random.Random], object]) -> Act:
    return lambda world: [change(path, world.generator) for path in world.any_file()]


def _move(find: Callable[[World], list[Path]], *, link: bool = False) -> Act:
    def act(world: World) -> None:
        for path in find(world):
            moved = path.rename(world.aside())
            if link:
                path.symlink_to(moved)

    return act


def _remove(find: Callable[[World], list[Path]]) -> Act:
    return lambda world: [shutil.rmtree(path, ignore_errors=True) for path in find(world)]


def _truncate_state_file(world: World) -> None:
    with suppress(FileNotFoundError):
        os.truncate(world.state, 20)


def _delete_lock_and_start_another(world: World) -> None:
    world.state.with_name('lock').unlink(missing_ok=True)
    before = truth(world.folder)
    second = world.new_session()
    time.sleep(world.generator.uniform(2.0, 5.0))
    world.problems += end(second)
    claim = second.claim()
    if claim is None:
        if not second.says('another monitor'):
            world.problems.append(f'the second one: no account: {second.lines[-3:]}')
        return
    folder, claimed = claim
    found = len(truth(world.folder).get(folder, set()) - before.get(folder, set()))
    if found != claimed:
        world.problems.append(f'the second one: {claimed} claimed, {found} found in {folder}')


def _fill_disk(world: World) -> None:
    pid = world.session.process.pid
    _, hard = resource.prlimit(pid, resource.RLIMIT_FSIZE)
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (0, hard))
    time.sleep(world.generator.uniform(0.2, 2.0))
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (hard, hard))


def _stop_process(world: World) -> None:
    world.session.process.send_signal(signal.SIGSTOP)
    time.sleep(world.generator.uniform(0.2, 2.0))
    world.session.process.send_signal(signal.SIGCONT)


def _restart_gateway(world: World) -> None:
    for _ in range(world.generator.randint(1, 4)):
        world.gateway.start_again()
        time.sleep(0.3)


ALL_ACTS: dict[str, Act] = {
    'delete_file': _to_a_file(lambda path, _: path.unlink()),
    'move_file': _move(World.any_file),
    'link_file': _move(World.any_file, link=True),
    'truncate_file': _to_a_file(_truncate),
    'extend_file': _to_a_file(_extend),
    'overwrite_file': _to_a_file(_overwrite),
    'delete_recording': _remove(World.recording),
    'move_recording': _move(World.recording),
    'delete_all_recordings': _remove(lambda world: [world.recordings]),
    'delete_state': _remove(lambda world: [world.state.parent]),
    'delete_state_file': lambda world: world.state.unlink(missing_ok=True),
    'truncate_state_file': _truncate_state_file,
    'delete_lock_and_start_another': _delete_lock_and_start_another,
    'fill_disk': _fill_disk,
    'stop_process': _stop_process,
    'kill_process': World.kill_and_start,
    'kill_process_and_wait_400_days': lambda world: world.kill_and_start(400.0 * DAY_S),
    'step_clock_back': lambda w: w.step_clock(-w.generator.uniform(0.1, 2.0) * DAY_S),
    'step_clock_on': lambda w: w.step_clock(w.generator.uniform(0.001, 2.0) * DAY_S),
    'restart_gateway': _restart_gateway,
    'storm_of_requests': lambda world: world.storms.append(world.gateway.storm()),
}


def adversary(options: Options) -> Outcome:
    """Compose acts from a seed, end the monitor, and compare its claims with what is there."""
    outcome = Outcome()
    table: dict[str, dict[str, int]] = {}
    with ros_node('adversary') as (node, executor):
        gateway = Gateway(node, executor)
        for run in range(options.many(RUNS, 2)):
            _run(run, options, gateway, table, outcome)
        gateway.close()
    outcome.counts['acts'] = dict(sorted(table.items()))
    counts = outcome.counts
    outcome.sentence = (
        f'{counts["runs"]} runs, {counts["composed"]} acts: '
        f'{counts["claimed"]} messages claimed, {counts["found"]} found, {outcome.failed} false '
        f'claims; {counts.get("answered", 0)} of {counts.get("asked", 0)} requests answered, the '
        f'last of a burst after {outcome.measured.get("longest_answer_s", 0.0):.2f} s at most'
    )
    return outcome


def _run(
    run: int, options: Options, gateway: Gateway, table: dict[str, dict[str, int]],
    outcome: Outcome,
) -> None:  # fmt: skip
    """Compose one run and judge it; add to the table of acts."""
    generator = random.Random(f'{options.seed} {run}')
    names = generator.choices(list(ALL_ACTS), k=generator.randint(*ACTS))
    world = World(options.folder / str(run), gateway, generator)
    for name in names:
        time.sleep(generator.uniform(*PAUSE_S))
        ALL_ACTS[name](world)
    time.sleep(generator.uniform(*PAUSE_S))
    outcome.count('composed', len(names))
    before = outcome.failed
    claimed, found = _judge(world, f'run {run} ({", ".join(names)})', outcome)
    false = int(outcome.failed > before)
    for name in set(names):
        row = table.setdefault(name, dict.fromkeys(('runs', 'claimed', 'found', 'false'), 0))
        for key, value in zip(row, (1, claimed, found, false), strict=True):
            row[key] += value
    if not false:
        shutil.rmtree(world.folder)


def _judge(world: World, what: str, outcome: Outcome) -> tuple[int, int]:
    """End the monitor; return the messages that it claimed and those that are found."""
    outcome.count('runs')
    session = world.session
    told = 0
    if world.generator.random() < 0.5:
        # In some runs the health has the time to say what happened.
        time.sleep(HEALTH_S)
        told = int(world.gateway.health.get('Messages written', 0))
        outcome.count('asked_for_health')
    for problem in [*world.problems, *end(session)]:
        outcome.expect(False, f'{what}: {problem}')
    claim = session.claim()
    if claim is None:
        outcome.expect(False, f'{what}: no account: {session.lines[-3:]}')
        return 0, 0
    folder, claimed = claim
    found = len(truth(world.folder).get(folder, set()) - world.before.get(folder, set()))
    outcome.count('claimed', claimed)
    outcome.count('found', found)
    # What is latched stands at the head of the next file too, where a lost one may be found.
    more = REPEATED * ACTS[1]
    outcome.expect(
        claimed <= found <= claimed + more, f'{what}: {claimed} claimed, {found} found in {folder}'
    )
    outcome.expect(told <= found, f'{what}: {told} written by the health, {found} found')
    if not session.says('he state cannot be saved'):
        try:
            from_bytes(world.state.read_bytes())
        except (OSError, ValueError, ValveflowError) as error:
            outcome.expect(False, f'{what}: no word that there is no state ({error})')
    for asked, answered, seconds in world.storms:
        outcome.count('asked', asked)
        outcome.count('answered', answered)
        outcome.worst('longest_answer_s', round(seconds, 2))
        outcome.expect(answered == asked, f'{what}: {answered} of {asked} requests answered')
        outcome.wish(seconds <= ANSWER_S, f'{what}: answers took {seconds:.2f} s')
    return claimed, found


def end(session: Session) -> list[str]:
    """Ask a monitor to end; return what was wrong with its end."""
    process, wrong = session.process, []
    process.terminate()
    try:
        process.wait(END_S)
    except subprocess.TimeoutExpired:
        wrong.append(f'it did not end within {END_S:g} s')
        killed(process)
    session.listener.join()
    if session.says('Traceback'):
        wrong.append(f'a traceback: {session.lines[-5:]}')
    # One that finds another monitor at work refuses to start.
    if process.returncode != 0 and not session.says('another monitor'):
        wrong.append(f'status {process.returncode}: {session.lines[-3:]}')
    return wrong
