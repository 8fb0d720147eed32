"""The node: lifecycle, parameters and services, wired to a session."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import SetParametersResult
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from valveflow_ros.errors import ParameterError, ValveflowError, counted
from valveflow_ros.parameters import Settings
from valveflow_ros.report.first_run import SENTENCE, is_first_run
from valveflow_ros.ros import declare
from valveflow_ros.ros.conversions import encode
from valveflow_ros.ros.diagnostics import Changes, Item, Level, array
from valveflow_ros.ros.node.session import DIAGNOSTICS, Session
from valveflow_ros.ros.process import with_place
from valveflow_ros.ros.record_place import check_record_place
from valveflow_ros.ros.services import SERVICES

_SUCCESS = TransitionCallbackReturn.SUCCESS
_LOOK_AROUND_S = 5.0
_NOT_RUNNING = 'The monitor is not active; activate it first.'


_Transition = Callable[['MonitorNode', LifecycleState], TransitionCallbackReturn]


def _spoken(transition: _Transition) -> _Transition:
    """Log what goes wrong in a transition; rclpy alone would swallow it."""

    @functools.wraps(transition)
    def run(node: MonitorNode, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            return transition(node, state)
        except ValveflowError as error:
            node.get_logger().error(str(error))
        except Exception as error:  # noqa: BLE001 - whatever it is, it is to be heard
            node.get_logger().error(f'The monitor failed unexpectedly: {with_place(error)}')
        return TransitionCallbackReturn.FAILURE

    return run


class MonitorNode(LifecycleNode):
    """The monitor as a managed node.

    Parameters
    ----------
    stop : callable
        Tells whether the process was asked to end.

    Raises
    ------
    ParameterError
        The parameters given at the start cannot be used.
    """

    def __init__(self, stop: Callable[[], bool] = lambda: False, **options: Any) -> None:
        super().__init__('valveflow_monitor', **options)
        self._stop = stop
        self.session: Session | None = None
        self.finalized = False
        self._next_diagnostics_s = 0.0
        self._changes = Changes()
        self._look_around_s, self._alike = 0.0, 1
        self.settings = Settings(declare.declare(self))
        self._ignored = declare.unknown_overrides(self)
        self.add_on_set_parameters_callback(self._judge)
        self.add_post_set_parameters_callback(self._take)
        self._health = self.create_publisher(DiagnosticArray, DIAGNOSTICS, 10)
        works = (
            self._refit, self._acknowledge, self._shelve, self._unshelve, self._set_reference,
            self._diagnose,
        )  # fmt: skip
        self._offered = [
            self.create_service(Trigger, f'~/{name}', self._service(work))
            for name, work in zip(SERVICES, works, strict=True)
        ]

    # Parameters

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """Set parameters; refuse with the table's own sentence."""
        result = self._judge(parameter_list)
        return super().set_parameters_atomically(parameter_list) if result.successful else result

    def _judge(self, wanted: list[Parameter]) -> SetParametersResult:
        try:
            declare.changed(self.settings, wanted)
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _take(self, wanted: list[Parameter]) -> None:
        self.settings = declare.changed(self.settings, wanted)
        if self.session is not None:
            self.session.reconfigure(self.settings)

    # Lifecycle

    @_spoken
    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start the fit process, compile, open the recording."""
        del state
        log = self.get_logger()
        try:
            check_record_place(self.settings)
        except ValveflowError as error:
            # Known before the long work, for whoever watches the start; the unit is watched all
            # the same.
            log.warning(str(error))
        begun_s = time.monotonic()
        log.info(SENTENCE if is_first_run() else 'Loading the engine.')
        self.session = session = Session(self, self.settings, self._stop, self._log)
        log.info(f'Ready after {time.monotonic() - begun_s:.1f} s of loading and compiling.')
        if session.recording.problem:
            log.warning(session.recording.problem)
        return _SUCCESS

    @_spoken
    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Listen."""
        del state
        assert self.session is not None
        self.session.listen()
        self.get_logger().info(self._introduction(self.session))
        return _SUCCESS

    @_spoken
    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop listening; the curve and the alarm stay."""
        del state
        assert self.session is not None
        self.session.hush()
        return _SUCCESS

    @_spoken
    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Finish the recording and forget everything."""
        del state
        self.end_session()
        return _SUCCESS

    @_spoken
    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Finish the recording; the process ends afterwards."""
        del state
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
            self.get_logger().info(
                f'Recorded {counted(status.written, "message")} to {session.recording.folder}.'
            )
        if status is not None and session.recording.problem:
            self.get_logger().error(session.recording.problem)

    def _introduction(self, session: Session) -> str:
        settings = self.settings
        folder = session.recording.folder
        return (
            f'{settings.text("unit_tag")}: listening to {", ".join(session.inputs.values())} '
            f'({settings.text("input_reliability")}), publishing below '
            f'{self.get_fully_qualified_name()}/; '
            f'{f"recording to {folder}" if session.recording.on else "not recording"}.'
        )

    # What the loop calls

    def step(self) -> int:
        """Do what is due; return how many messages were taken."""
        found = self.session.step() if self.session is not None else 0
        now_s = time.monotonic()
        if now_s >= self._next_diagnostics_s:
            self._next_diagnostics_s = now_s + self.settings.real('diagnostics_period')
            self._say_health(now_s)
        return found

    def _say_health(self, now_s: float) -> None:
        session = self.session
        if session is None:
            items = [Item('fit', Level.STALE, 'The monitor is not configured.')]
        else:
            items = [*session.items(), *self.misspelt(), *self.namesakes(now_s)]
        now_ns = time.time_ns()
        data = encode(array(items, self.settings.text('unit_tag'), now_ns))
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

    def misspelt(self) -> list[Item]:
        """Return an item if a parameter was given that there is not, else nothing."""
        if not self._ignored:
            return []
        # It stands in the health too: whoever set it takes it to be in force.
        sentence = f'{" ".join(self._ignored)} Ignored.'
        return [Item('parameters', Level.WARN, sentence, {'Ignored': len(self._ignored)})]

    def namesakes(self, now_s: float) -> list[Item]:
        """Return an item if another node of the domain bears this one's name, else nothing."""
        if now_s >= self._look_around_s:
            self._look_around_s = now_s + _LOOK_AROUND_S
            own = (self.get_name(), self.get_namespace())
            self._alike = sum(found == own for found in self.get_node_names_and_namespaces())
        if self._alike < 2:
            return []
        sentence = (
            f'{self._alike} nodes are called {self.get_fully_qualified_name()}: topics are mixed, '
            'and a service or a parameter reaches all of them. Give each a namespace or a '
            'ROS_DOMAIN_ID of its own.'
        )
        return [Item('name', Level.ERROR, sentence, {'Nodes of this name': self._alike})]

    def _log(self, level: Level, text: str) -> None:
        # One call each: rclpy ties a severity to the place it is called from.
        if level == Level.OK:
            self.get_logger().info(text)
        elif level == Level.ERROR:
            self.get_logger().error(text)
        else:
            self.get_logger().warning(text)

    # Services

    def _service(self, work: Callable[[Session], str]) -> Callable[..., Trigger.Response]:
        """Return a service that does some work and always answers with a sentence."""

        def serve(_request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            response.success = False
            session = self.session
            if session is None or not session.listening:
                response.message = _NOT_RUNNING
                return response
            try:
                response.message = work(session)
                response.success = True
            except ValveflowError as error:
                response.message = str(error)
            return response

        return serve

    def _refit(self, session: Session) -> str:
        session.tell(session.engine.request_fit())
        return 'A refit was started; the curve follows on ~/characteristic.'

    def _acknowledge(self, session: Session) -> str:
        session.tell(session.engine.acknowledge())
        return 'The alarm is acknowledged.'

    def _shelve(self, session: Session) -> str:
        session.tell(session.engine.shelve())
        hours = self.settings.real('alarm_shelve_time') / 3600.0
        return (
            f'The standing alarms are put aside for {hours:g} h; then they come back by '
            'themselves if their cause is still there. New alarms are not hidden.'
        )

    def _unshelve(self, session: Session) -> str:
        session.tell(session.engine.unshelve())
        return 'The alarms are no longer put aside.'

    def _set_reference(self, session: Session) -> str:
        session.tell(session.engine.set_reference())
        curve = session.engine.monitor.reference.curve
        assert curve is not None
        return f'Curve {curve.model_id} is the reference that later ones are judged against.'

    def _diagnose(self, session: Session) -> str:
        session.tell(session.engine.request_diagnosis())
        return 'A diagnosis was started; the result follows on ~/diagnosis.'
