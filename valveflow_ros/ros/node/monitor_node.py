# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The node: lifecycle, parameters and services wired to a session, its loop and its watchdog."""

from __future__ import annotations

import contextlib
import functools
import gc
import os
import socket
import time
from collections.abc import Callable, Iterator, Mapping
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
from valveflow_ros.logs import RecorderState, RecorderStatus
from valveflow_ros.monitoring.alarm_state import AlarmAction
from valveflow_ros.parameters import Settings
from valveflow_ros.report.first_run import SENTENCE, is_first_run
from valveflow_ros.ros import declare
from valveflow_ros.ros.decoding import INPUTS
from valveflow_ros.ros.domain import Presence
from valveflow_ros.ros.encoding import encode
from valveflow_ros.ros.node.diagnostics import Changes, Item, Level, diagnostics_message
from valveflow_ros.ros.node.recording import check_record_directory
from valveflow_ros.ros.node.session import DIAGNOSTICS, Session
from valveflow_ros.ros.outputs import OUTPUTS, SERVICES
from valveflow_ros.ros.polled_subscription import answer_request
from valveflow_ros.ros.process import StopFlag, with_place

_SUCCESS = TransitionCallbackReturn.SUCCESS
_LOOK_AROUND_S = 5.0
_NOT_RUNNING = 'The monitor is not active; activate it first.'
_NOT_ON_DISK = 'It is not on disk yet; see recorder and state in /diagnostics.'
# A look costs the same for one message as for ten, and a plant is in no hurry. Where much comes,
# as from a replay, the next look follows at once.
_PERIOD_S = 0.02
_MUCH = 50
# Requests are looked for twice as often as messages.
_REQUESTS_EVERY_S = 0.01
# Of each look; a storm of requests must not keep samples waiting.
_REQUESTS_S = 0.05
# The executor has the rest, events of the middleware and /clock, and costs several times as much.
_SPIN_EVERY_S = 0.1
_FAREWELL_S = 0.5
# The default of ten loses the eleventh request of a burst without a word.
_REQUESTS = QoSProfile(depth=1000)
# The compiler works when a configuration runs for the first time, and an activation may feed what
# an earlier run recorded.
_LONGEST_START_S = 600.0
# A recorder that has been at one step for longer is not counted on.
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
    """Tells systemd how the process is, by the notify protocol, sd_notify(3).

    Where `NOTIFY_SOCKET` is not set nothing is ever sent. Pings are sent at twice the rate that
    `WATCHDOG_USEC` asks for, and only by `completed`: whoever calls it has just finished a cycle.

    Parameters
    ----------
    environ : mapping, optional
        Where the names of the protocol are looked up; the process's own by default.
    clock : callable
        Seconds by a clock that never goes back.

    Attributes
    ----------
    period_s : float
        Time between pings, 0 if none are asked for.
    stall_s : float
        How long a recorder may be at one step and still count as alive.
    """

    def __init__(
        self,
        environ: Mapping[str, str] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        environ = os.environ if environ is None else environ
        self._clock = clock
        name = environ.get('NOTIFY_SOCKET', '')
        # An @ stands for the abstract namespace.
        abstract = name.startswith('@') and len(name) > 1
        self._address = os.fsencode(f'\0{name[1:]}' if abstract else name)
        usec = environ.get('WATCHDOG_USEC', '')
        valid = usec.isascii() and usec.isdigit() and len(usec) < 19
        own = environ.get('WATCHDOG_PID', '') in ('', str(os.getpid()))
        if not (abstract or name.startswith('/')):
            self._address = b''
        self._usec = int(usec) if valid and own and self._address else 0
        self.period_s = self._usec / 2e6
        self.stall_s = min(_STALL_S, self.period_s)
        self._next_s = 0.0

    def ready(self, status: str) -> None:
        """Tell that the start is done."""
        self._send(f'READY=1\nSTATUS={_one_line(status)}\nWATCHDOG=1')

    def status(self, status: str) -> None:
        """Tell in a sentence what the process is doing."""
        self._send(f'STATUS={_one_line(status)}')

    def stopping(self, status: str) -> None:
        """Tell that the end has begun."""
        self._send(f'STOPPING=1\nSTATUS={_one_line(status)}')

    def completed(self, recorder: Callable[[], RecorderStatus | None]) -> None:
        """Ping, if it is time, after a cycle that came to its end.

        Parameters
        ----------
        recorder : callable
            Returns the status of the recorder, None where none is to be at work. It is asked
            only when a ping is due, and none is sent while the recorder is stuck.
        """
        now_s = self._clock()
        if not self._usec or now_s < self._next_s:
            return
        # What the manager did not take is sent again after the next cycle.
        if recorder_lives(recorder(), self.stall_s) and self._send('WATCHDOG=1'):
            self._next_s = now_s + self.period_s

    @contextlib.contextmanager
    def patient(self, limit_s: float) -> Iterator[None]:
        """Give one piece of work more time than a cycle has; afterwards the old limit holds."""
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
        # A manager that does not take a datagram at once must not hold up the loop.
        kind = socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK
        try:
            with socket.socket(socket.AF_UNIX, kind) as channel:
                channel.sendto(text.encode(), self._address)
        except OSError:
            return False
        return True


def _one_line(text: str) -> str:
    """Return a text without line breaks, as each would begin another assignment."""
    return ' '.join(text.split())


def recorder_lives(status: RecorderStatus | None, stall_s: float) -> bool:
    """Return False if only a new process can help the recorder.

    One that keeps trying on a full disk is alive. One whose thread has ended, or has not come
    back from a step for longer than ``stall_s``, is not.
    """
    if status is None:
        return True
    return status.state != RecorderState.STOPPED and status.stalled_s <= stall_s


def _logged(transition: _Transition) -> _Transition:
    """Log what goes wrong in a transition; rclpy alone would swallow it."""

    @functools.wraps(transition)
    def run(node: MonitorNode, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            return transition(node, state)
        except ValveflowError as error:
            node.get_logger().error(str(error))
        except Exception as error:  # noqa: BLE001 - whatever it is, it must be logged
            node.get_logger().error(f'The monitor failed unexpectedly: {with_place(error)}')
        return TransitionCallbackReturn.FAILURE

    return run


class MonitorNode(LifecycleNode):
    """The monitor as a managed node.

    Parameters
    ----------
    stop : callable
        Returns True if the process was asked to end.
    watchdog : Watchdog, optional

    Raises
    ------
    ParameterError
        The parameters given at the start cannot be used.
    """

    def __init__(
        self,
        stop: Callable[[], bool] = lambda: False,
        watchdog: Watchdog | None = None,
        **options: Any,
    ) -> None:
        super().__init__('valveflow_monitor', **options)
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
            'subscription': [self.resolve_topic_name(topic.name) for topic in INPUTS],
        })  # fmt: skip
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
        """Set parameters; refuse with the table's own sentence."""
        wanted = [p for p in declare.in_type(parameter_list) if not declare.stands(self, p)]
        result = self._check(wanted)
        if not wanted or not result.successful:
            return result
        return super().set_parameters_atomically(wanted)

    def _check(self, wanted: list[Parameter]) -> SetParametersResult:
        try:
            declare.changed(self.settings, wanted, running=self.session is not None)
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply(self, wanted: list[Parameter]) -> None:
        settings = declare.changed(self.settings, wanted, running=self.session is not None)
        # A new topic declares its quality of service; the session may not have begun then.
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
                # Known before the long work, for whoever watches the start; the unit is watched
                # all the same.
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
        """Unsubscribe; the curve and the alarm stay."""
        assert self.session is not None
        self.session.unsubscribe()
        return _SUCCESS

    @_logged
    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Finish the recording and forget everything."""
        self.end_session()
        return _SUCCESS

    @_logged
    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Finish the recording; the process ends afterwards."""
        self.end_session()
        self.finalized = True
        return _SUCCESS

    def end_session(self) -> None:
        """End what runs; doing it again changes nothing."""
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
        """Do what is due; return how many messages were taken."""
        found = self.session.step() if self.session is not None else 0
        now_s = time.monotonic()
        if now_s >= self._next_diagnostics_s:
            self._next_diagnostics_s = now_s + self.settings.real('diagnostics_period')
            self._publish_health(now_s)
        return found

    def recorder_status(self) -> RecorderStatus | None:
        """Return the status of the recorder, None where none is at work."""
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
        # These have a line of their own in the log, when it happens.
        others = (i for i in items if i.name not in ('alarm', 'model', 'diagnosis'))
        for item in self._changes.pick(others, now_s):
            alike.setdefault((item.level, item.sentence), []).append(item.name)
        for (level, sentence), names in alike.items():
            self._log(level, f'{", ".join(names)}: {sentence}')

    def unknown_parameters(self) -> list[Item]:
        """Return an item if a parameter was given that does not exist, else nothing."""
        if not self._ignored:
            return []
        # It stands in the health too: whoever set it takes it to be in force.
        ignored = 'It is ignored.' if len(self._ignored) == 1 else 'They are ignored.'
        sentence = f'{" ".join(self._ignored)} {ignored}'
        return [Item('parameters', Level.WARN, sentence, {'Ignored': len(self._ignored)})]

    def same_name(self, now_s: float) -> list[Item]:
        """Return an item if another node of the domain bears this one's name, else nothing."""
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
        # One call each: rclpy ties a severity to the place it is called from.
        if level == Level.OK:
            self.get_logger().info(text)
        elif level == Level.ERROR:
            self.get_logger().error(text)
        else:
            self.get_logger().warning(text)

    # Services

    def _serve(
        self, name: str, _request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        """Do what a service asks for."""
        response.success, response.message = self._done(functools.partial(self._answer, name))
        return response

    def _operate(
        self, request: OperateAlarm.Request, response: OperateAlarm.Response
    ) -> OperateAlarm.Response:
        """Do to one alarm what is asked for."""

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

        response.success, response.message = self._done(answer)
        return response

    def _done(self, answer: Callable[[Session], str]) -> tuple[bool, str]:
        """Return whether something was done, and a sentence; what was done is on disk then."""
        session = self.session
        if session is None or not session.listening:
            return False, _NOT_RUNNING
        try:
            sentence = answer(session)
        except ValveflowError as error:
            return False, str(error)
        return True, sentence if session.confirm() else f'{sentence} {_NOT_ON_DISK}'

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
    """Answer the requests that wait, of services and parameters; after that time the rest wait."""
    until_s, answered = time.monotonic() + longest_s, True
    while answered:
        # One of each service in turn, so that none waits for a storm at another.
        answered = False
        for service in tuple(node.services):
            if time.monotonic() > until_s:
                return
            answered |= answer_request(service, node.get_logger().error)


def _spin(executor: Executor, longest_s: float, failed: Callable[[str], None]) -> None:
    """Serve what else is ready; after that time the rest waits. What fails is said."""
    until_s = time.monotonic() + longest_s
    with contextlib.suppress(TimeoutException, ShutdownException):
        while time.monotonic() < until_s:
            handler, _, _ = executor.wait_for_ready_callbacks(timeout_sec=0)
            handler()
            # A request may come between the two looks.
            if (error := handler.exception()) is not None:
                failed(f'A callback failed: {with_place(error)}')


def run(stop: StopFlag, presence: Presence) -> int:
    """Watch until the process is asked to stop; return the exit status."""
    if stop:
        return 0
    watchdog = Watchdog()
    node = MonitorNode(lambda: bool(stop), watchdog, context=presence.settle())
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
        # What is there now stays: the collector need not go through the compiler's objects again
        # and again.
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
            # Taken, fed, handed to the recorder: only a whole cycle counts.
            watchdog.completed(node.recorder_status)
            while found < _MUCH and (left_s := begun_s + _PERIOD_S - time.monotonic()) > 0.0:
                time.sleep(min(left_s, _REQUESTS_EVERY_S))
                serve_requests(node, _REQUESTS_S)
        return 0
    finally:
        watchdog.stopping('Finishing the recording.')
        node.end_session()
        if node.finalized:
            # The answer to who asked for the shutdown is still on its way.
            time.sleep(_FAREWELL_S)
        executor.shutdown(timeout_sec=0.5)
        node.destroy_node()
