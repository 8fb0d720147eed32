# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The monitor node: lifecycle, parameters, services, main loop and watchdog."""

from __future__ import annotations

import contextlib
import functools
import gc
import os
import socket
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import SetParametersResult
from rclpy.executors import (
    Executor,
    ShutdownException,
    SingleThreadedExecutor,
    TimeoutException,
)
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from std_srvs.srv import Trigger
from valveflow_msgs.srv import OperateAlarm

from valveflow_ros.errors import DataError, ParameterError, ValveflowError, counted, listed
from valveflow_ros.interface.settings import NODE, unmatched_files
from valveflow_ros.logs import RecorderState, RecorderStatus
from valveflow_ros.monitoring.alarm_state import AlarmAction
from valveflow_ros.parameters import Settings
from valveflow_ros.report.first_run import SENTENCE, is_first_run
from valveflow_ros.ros import declare
from valveflow_ros.ros.domain import Presence
from valveflow_ros.ros.encoding import encode
from valveflow_ros.ros.node.diagnostics import (
    Changes,
    Item,
    Level,
    diagnostics_message,
    log_at,
)
from valveflow_ros.ros.node.outputs import OUTPUTS, SERVICES
from valveflow_ros.ros.node.polled_subscription import answer_request
from valveflow_ros.ros.node.recording import check_record_directory
from valveflow_ros.ros.node.session import DIAGNOSTICS, Session
from valveflow_ros.ros.process import StopFlag, with_place

_SUCCESS = TransitionCallbackReturn.SUCCESS
_LOOK_AROUND_S = 5.0
_NOT_RUNNING = 'The monitor is not active; activate it first.'
_NOT_ON_DISK = 'It is not on disk yet; see recorder and state in /diagnostics.'
# Polling costs the same for one message as for ten, so it need not be frequent. After many
# messages, as in a replay, the next poll follows at once.
_PERIOD_S = 0.02
_MUCH = 50
# Service requests are polled twice as often as messages.
_REQUESTS_EVERY_S = 0.01
# Maximum time for requests per cycle, so that many requests do not delay the samples.
_REQUESTS_S = 0.05
# The executor handles middleware events and /clock, and costs several times as much.
_SPIN_EVERY_S = 0.1
_FAREWELL_S = 0.5
# With the default of ten, the eleventh request of a burst is lost without a message.
_REQUESTS = QoSProfile(depth=1000)
# The first configuration compiles the code, and an activation may process what an earlier run
# recorded.
_LONGEST_START_S = 600.0
# A recorder that needs longer for one step is considered stuck.
_STALL_S = 1.0

_Transition = Callable[['MonitorNode', LifecycleState], TransitionCallbackReturn]

_ALARM_SERVICES = {
    'acknowledge_alarms': (AlarmAction.ACKNOWLEDGE, 'The alarm is acknowledged.'),
    'shelve_alarms': (
        AlarmAction.SHELVE,
        'The standing alarms are shelved for {:g} h; then they come back by themselves if their '
        'condition is still present. New alarms are not hidden.',
    ),
    'unshelve_alarms': (AlarmAction.UNSHELVE, 'The alarms are no longer shelved.'),
}
_ONE_ALARM = {
    AlarmAction.ACKNOWLEDGE: 'The alarm {} is acknowledged.',
    AlarmAction.SHELVE: 'The alarm {} is shelved for {:g} h; then it comes back by itself if '
    'its condition is still present.',
    AlarmAction.UNSHELVE: 'The alarm {} is no longer shelved.',
}


class Watchdog:
    """Reports the state of the process to systemd with the notify protocol, sd_notify(3).

    Nothing is sent if `NOTIFY_SOCKET` is not set. Pings are sent at twice the rate required by
    `WATCHDOG_USEC`, and only by `completed`, which is called after each complete cycle.
    """

    def __init__(
        self,
        environ: Mapping[str, str] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        environ = os.environ if environ is None else environ
        self._clock = clock
        name = environ.get('NOTIFY_SOCKET', '')
        # A leading @ means the abstract namespace.
        abstract = name.startswith('@') and len(name) > 1
        self._address = os.fsencode(f'\0{name[1:]}' if abstract else name)
        usec = environ.get('WATCHDOG_USEC', '')
        valid = usec.isascii() and usec.isdigit() and len(usec) < 19
        own = environ.get('WATCHDOG_PID', '') in ('', str(os.getpid()))
        if not (abstract or name.startswith('/')):
            self._address = b''
        self._usec = int(usec) if valid and own and self._address else 0
        self.period_s = self._usec / 2e6  # time between pings; 0 if none are required
        # Maximum duration of one step of the recorder before it is considered stuck.
        self.stall_s = min(_STALL_S, self.period_s)
        self._next_s = 0.0

    def ready(self, status: str) -> None:
        """Report that the start is complete."""
        self._send(f'READY=1\nSTATUS={_one_line(status)}\nWATCHDOG=1')

    def status(self, status: str) -> None:
        """Report in a sentence what the process is doing."""
        self._send(f'STATUS={_one_line(status)}')

    def stopping(self, status: str) -> None:
        """Report that the process is ending."""
        self._send(f'STOPPING=1\nSTATUS={_one_line(status)}')

    def completed(self, recorder: Callable[[], RecorderStatus | None]) -> None:
        """Send a ping, if one is due, after a complete cycle.

        ``recorder`` returns the status of the recorder, None if there is none, and is called only
        when a ping is due. No ping is sent while the recorder is stuck.
        """
        now_s = self._clock()
        if not self._usec or now_s < self._next_s:
            return
        # A ping that could not be sent is repeated after the next cycle.
        if recorder_lives(recorder(), self.stall_s) and self._send('WATCHDOG=1'):
            self._next_s = now_s + self.period_s

    @contextlib.contextmanager
    def patient(self, limit_s: float) -> Iterator[None]:
        """Extend the time limit for one operation; afterwards the old limit is restored."""
        if self._usec:
            self._send(f'WATCHDOG_USEC={max(self._usec, round(limit_s * 1e6))}\nWATCHDOG=1')
        try:
            yield
        finally:
            if self._usec:
                self._send(f'WATCHDOG_USEC={self._usec}\nWATCHDOG=1')

    def _send(self, text: str) -> bool:
        if not self._address:
            return False
        # Non-blocking, so that a busy manager does not delay the loop.
        kind = socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK
        try:
            with socket.socket(socket.AF_UNIX, kind) as channel:
                channel.sendto(text.encode(), self._address)
        except OSError:
            return False
        return True


def _one_line(text: str) -> str:
    """Return a text without line breaks; each would begin another assignment."""
    return ' '.join(text.split())


def recorder_lives(status: RecorderStatus | None, stall_s: float) -> bool:
    """Return False if the recorder is stuck, so that the process must be restarted.

    A recorder that keeps retrying on a full disk is alive. It is stuck if its thread has ended,
    or if one step takes longer than ``stall_s``.
    """
    if status is None:
        return True
    return status.state != RecorderState.STOPPED and status.stalled_s <= stall_s


def _logged(transition: _Transition) -> _Transition:
    """Log the exceptions of a transition; rclpy alone would not report them."""

    @functools.wraps(transition)
    def run(node: MonitorNode, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            return transition(node, state)
        except ValveflowError as error:
            node.get_logger().error(str(error))
        except Exception as error:  # noqa: BLE001 - every exception must be logged
            node.get_logger().error(f'The monitor failed unexpectedly: {with_place(error)}')
        return TransitionCallbackReturn.FAILURE

    return run


class MonitorNode(LifecycleNode):
    """The monitor as a managed node.

    ``stop`` returns True if the process must end, ``args`` is the command line. Raises
    `ParameterError` if the parameters given at the start are invalid.
    """

    def __init__(
        self,
        stop: Callable[[], bool] = lambda: False,
        watchdog: Watchdog | None = None,
        args: Sequence[str] = (),
        **options: Any,
    ) -> None:
        super().__init__(NODE, **options)
        self._stop = stop
        self._watchdog = watchdog or Watchdog({})
        self.session: Session | None = None
        self.finalized = False
        self._next_diagnostics_s = 0.0
        self._changes = Changes()
        self._look_around_s, self._same_name = 0.0, 1
        self.settings = Settings(declare.declare(self))
        self._ignored = declare.unknown_overrides(self) + declare.check_qos_overrides(self, {
            'publisher': [self.resolve_topic_name(f'~/{name}') for name in OUTPUTS],
            'subscription': declare.inputs(self, self.settings).values(),
        })  # fmt: skip
        self._ignored += unmatched_files(args, self.get_fully_qualified_name())
        self.add_pre_set_parameters_callback(declare.in_type)
        self.add_on_set_parameters_callback(self._check)
        self.add_post_set_parameters_callback(self._apply)
        self._health = self.create_publisher(DiagnosticArray, DIAGNOSTICS, 10)
        self._trigger_services = [
            self.create_service(
                Trigger, f'~/{name}', functools.partial(self._serve, name), qos_profile=_REQUESTS
            )
            for name in SERVICES
        ]
        self._operate_service = self.create_service(
            OperateAlarm, '~/operate_alarm', self._operate, qos_profile=_REQUESTS
        )

    # Parameters

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """Set parameters; the reason of a refusal comes from the parameter table."""
        wanted = [p for p in declare.in_type(parameter_list) if not declare.stands(self, p)]
        result = self._check(wanted)
        if not wanted or not result.successful:
            return result
        return super().set_parameters_atomically(wanted)

    def _check(self, wanted: list[Parameter]) -> SetParametersResult:
        try:
            found = declare.changed(self.settings, wanted, running=self.session is not None)
            declare.inputs(self, found)
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply(self, wanted: list[Parameter]) -> None:
        settings = declare.changed(self.settings, wanted, running=self.session is not None)
        # A new topic declares QoS parameters, possibly before the session exists.
        if settings == self.settings:
            return
        self.settings = settings
        if self.session is not None:
            self.session.reconfigure(settings)

    # Lifecycle

    @_logged
    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start the fit process, compile, open the recording."""
        log = self.get_logger()
        with self._watchdog.patient(_LONGEST_START_S):
            try:
                check_record_directory(self.settings)
            except ValveflowError as error:
                # Logged before the long start, so that the user sees it early; the monitor runs
                # anyway.
                log.warning(str(error))
            begun_s = time.monotonic()
            log.info(SENTENCE if is_first_run() else 'Loading the engine.')
            self.session = session = Session(self, self.settings, self._stop, self._log)
            log.info(f'Ready after {time.monotonic() - begun_s:.1f} s of loading and compiling.')
            if session.recording.problem:
                log.warning(session.recording.problem)
        return _SUCCESS

    @_logged
    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Subscribe to the inputs."""
        session = self.session
        assert session is not None
        with self._watchdog.patient(_LONGEST_START_S):
            session.subscribe()
        folder = session.recording.folder
        self.get_logger().info(
            f'{self.settings.text("unit_tag")}: listening to {", ".join(session.inputs.values())} '
            f'({self.settings.text("input_reliability")}), publishing below '
            f'{self.get_fully_qualified_name()}/; '
            f'{f"recording to {folder}" if session.recording.on else "not recording"}.'
        )
        return _SUCCESS

    @_logged
    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Unsubscribe from the inputs; the curve and the alarm are kept."""
        assert self.session is not None
        self.session.unsubscribe()
        return _SUCCESS

    @_logged
    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Finish the recording and delete the session."""
        self.end_session()
        return _SUCCESS

    @_logged
    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Finish the recording; the process ends afterwards."""
        self.end_session()
        self.finalized = True
        return _SUCCESS

    def end_session(self) -> None:
        """End the session; without a session nothing happens."""
        session, self.session = self.session, None
        if session is None:
            return
        status = session.close()
        if status is not None:
            told = f'Recorded {counted(status.written, "message")} to {session.recording.folder}.'
            if status.removed:
                told += f' {status.removed} more were in files that were removed since.'
            self.get_logger().info(told)
        if status is not None and session.recording.problem:
            self.get_logger().error(session.recording.problem)

    # What the loop calls

    def step(self) -> int:
        """Run one cycle; return the number of messages received."""
        found = self.session.step() if self.session is not None else 0
        now_s = time.monotonic()
        if now_s >= self._next_diagnostics_s:
            self._next_diagnostics_s = now_s + self.settings.real('diagnostics_period')
            self._publish_health(now_s)
        return found

    def recorder_status(self) -> RecorderStatus | None:
        """Return the status of the recorder, None if there is no recorder."""
        return None if self.session is None else self.session.recording.status()

    def _publish_health(self, now_s: float) -> None:
        session = self.session
        if session is None:
            items = [Item('fit', Level.STALE, 'The monitor is not configured.')]
        else:
            items = [*session.items(), *self.unknown_parameters(), *self.same_name(now_s)]
        now_ns = self.get_clock().now().nanoseconds
        name = self.get_fully_qualified_name().lstrip('/')
        data = encode(diagnostics_message(items, name, self.settings.text('unit_tag'), now_ns))
        self._health.publish(data)
        if session is not None:
            session.record(DIAGNOSTICS, data, now_ns)
        alike: dict[tuple[Level, str], list[str]] = {}
        # These are logged when they happen.
        others = (i for i in items if i.name not in ('alarm', 'model', 'diagnosis'))
        for item in self._changes.pick(others, now_s):
            alike.setdefault((item.level, item.sentence), []).append(item.name)
        for (level, sentence), names in alike.items():
            self._log(level, f'{", ".join(names)}: {sentence}')

    def unknown_parameters(self) -> list[Item]:
        """Return an item if a given parameter or parameter file has no effect, else nothing."""
        if not self._ignored:
            return []
        # Also reported as health, because the user expects an effect of them.
        ignored = 'It is ignored.' if len(self._ignored) == 1 else 'They are ignored.'
        sentence = f'{" ".join(self._ignored)} {ignored}'
        return [Item('parameters', Level.WARN, sentence, {'Ignored': len(self._ignored)})]

    def same_name(self, now_s: float) -> list[Item]:
        """Return an item if another node of the domain has the same name, else nothing."""
        if now_s >= self._look_around_s:
            self._look_around_s = now_s + _LOOK_AROUND_S
            own = (self.get_name(), self.get_namespace())
            self._same_name = sum(found == own for found in self.get_node_names_and_namespaces())
        if self._same_name < 2:
            return []
        sentence = (
            f'{self._same_name} nodes are called {self.get_fully_qualified_name()}: topics are '
            'mixed, and a service or a parameter reaches all of them. Give each a namespace or a '
            'ROS_DOMAIN_ID of its own.'
        )
        return [Item('name', Level.ERROR, sentence, {'Nodes of this name': self._same_name})]

    def _log(self, level: Level, text: str) -> None:
        log_at(self.get_logger(), level, text)

    # Services

    def _serve(
        self, name: str, _request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        """Execute a service request."""
        return self._done(functools.partial(self._answer, name), response)

    def _operate(
        self, request: OperateAlarm.Request, response: OperateAlarm.Response
    ) -> OperateAlarm.Response:
        """Execute a request for one alarm."""

        def answer(session: Session) -> str:
            actions = [action.value for action in AlarmAction]
            if request.action not in actions:
                raise DataError(
                    f"There is no action '{request.action}'; choose {listed(actions, 'or')}."
                )
            action = AlarmAction(request.action)
            session.publish(session.engine.monitor.operate_alarms(action, request.name))
            hours = self.settings.real('alarm_shelve_time') / 3600.0
            return _ONE_ALARM[action].format(request.name, hours)

        return self._done(answer, response)

    def _done(self, answer: Callable[[Session], str], response: Any) -> Any:
        """Execute an action; the sentence of the response says if it is not on disk yet."""
        session = self.session
        response.success, response.message = False, _NOT_RUNNING
        if session is None or not session.listening:
            return response
        try:
            sentence = answer(session)
        except ValveflowError as error:
            response.message = str(error)
            return response
        on_disk = session.confirm()
        response.success = True
        response.message = sentence if on_disk else f'{sentence} {_NOT_ON_DISK}'
        return response

    def _answer(self, name: str, session: Session) -> str:
        monitor, engine = session.engine.monitor, session.engine
        if name == 'refit':
            session.publish(engine.request_fit())
            return 'A refit was started; the curve follows on ~/characteristic.'
        if name == 'diagnose':
            session.publish(engine.request_diagnosis())
            return 'A diagnosis was started; the result follows on ~/diagnosis.'
        if name in _ALARM_SERVICES:
            action, sentence = _ALARM_SERVICES[name]
            session.publish(monitor.operate_alarms(action))
            return sentence.format(self.settings.real('alarm_shelve_time') / 3600.0)
        session.publish(monitor.set_reference())
        curve = monitor.reference.curve
        assert curve is not None
        return f'Curve {curve.model_id} is the reference that later ones are judged against.'


def serve_requests(node: Node, longest_s: float) -> None:
    """Answer waiting requests of services and parameters, for at most ``longest_s`` seconds."""
    until_s, answered = time.monotonic() + longest_s, True
    while answered:
        # One request per service in turn, so that many requests to one do not delay the others.
        answered = False
        for service in tuple(node.services):
            if time.monotonic() > until_s:
                return
            answered |= answer_request(service, node.get_logger().error)


def _spin(executor: Executor, longest_s: float, failed: Callable[[str], None]) -> None:
    """Run other ready callbacks for at most ``longest_s`` seconds; report failures."""
    until_s = time.monotonic() + longest_s
    with contextlib.suppress(TimeoutException, ShutdownException):
        while time.monotonic() < until_s:
            handler, _, _ = executor.wait_for_ready_callbacks(timeout_sec=0)
            handler()
            # It may also be a request that came after `serve_requests`.
            if (error := handler.exception()) is not None:
                failed(f'A callback failed: {with_place(error)}')


def run(stop: StopFlag, presence: Presence) -> int:
    """Run the monitor until the process is asked to stop; return the exit status."""
    if stop:
        return 0
    watchdog = Watchdog()
    node = MonitorNode(lambda: bool(stop), watchdog, presence.args, context=presence.settle())
    presence.end()
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    try:
        watchdog.status('Loading and compiling.')
        if node.settings.flag('autostart'):
            for transition in (node.trigger_configure, node.trigger_activate):
                if transition() != _SUCCESS:
                    return 0 if stop else 1
        watchdog.ready('Listening.' if node.session else 'Waits to be configured.')
        # Exclude the objects that exist now, mainly those of the compiler, from garbage
        # collection.
        gc.collect()
        gc.freeze()
        spin_s = 0.0
        while not stop and not node.finalized and node.context.ok():
            begun_s = time.monotonic()
            found = node.step()
            serve_requests(node, _REQUESTS_S)
            if begun_s >= spin_s:
                spin_s = begun_s + _SPIN_EVERY_S
                _spin(executor, _REQUESTS_S, node.get_logger().error)
            # Only a complete cycle counts: receive, process and record.
            watchdog.completed(node.recorder_status)
            while found < _MUCH and (left_s := begun_s + _PERIOD_S - time.monotonic()) > 0.0:
                time.sleep(min(left_s, _REQUESTS_EVERY_S))
                serve_requests(node, _REQUESTS_S)
        return 0
    finally:
        watchdog.stopping('Finishing the recording.')
        node.end_session()
        if node.finalized:
            # The response to the shutdown request is still being sent.
            time.sleep(_FAREWELL_S)
        executor.shutdown(timeout_sec=0.5)
        node.destroy_node()
