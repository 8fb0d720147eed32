"""Being known in the domain before the work begins.

Fast DDS (2.14) announces a participant before its own sockets are read. Who is on the same host
answers within a millisecond, the answer is lost, and the next one comes with the period of 3 s:
two of five processes hear of a neighbour that late. So the process shows itself first, with a
node that does nothing, and loads and compiles afterwards. Where nobody has answered after a
moment, it takes the node back and shows itself anew, for who has heard of it before does not
answer again.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Sequence
from types import TracebackType

import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import get_rmw_implementation_identifier

from valveflow_ros.ros.transport import FAST_DDS

# Whose answer was heard is known by name within 75 ms, and within 170 ms while this process is
# busy with loading.
_ANSWER_S = 0.25
_LOOK_S = 0.01
# With two of five answers lost, one start in forty is still alone after that many.
_TRIES = 4


class Presence:
    """Takes part in the domain as soon as it is made; the default context is up from then on.

    Others are looked for in a thread of its own, which ends by itself after less than a second.

    Parameters
    ----------
    args : sequence of str, optional
        The arguments for `rclpy.init`; those of the process by default.
    tries : int, optional
        How often to show itself as long as nobody is heard of. Without it once, or four times
        where the middleware is Fast DDS.

    Raises
    ------
    Exception
        Whatever rclpy raises when ROS cannot be started.
    """

    def __init__(self, args: Sequence[str] | None = None, tries: int | None = None) -> None:
        if tries is None:
            tries = _TRIES if get_rmw_implementation_identifier() in FAST_DDS else 1
        self._args = None if args is None else list(args)
        self._enough = threading.Event()
        self._error: Exception | None = None
        self._node: Node | None = None
        self.tries = 0
        self._enter()
        self._thread = threading.Thread(target=self._seek, args=(tries,), daemon=True)
        self._thread.start()

    def settle(self) -> bool:
        """Wait for the end of the search; tell whether anybody is known.

        Raises
        ------
        Exception
            Whatever rclpy raised when ROS was started anew.
        """
        self._thread.join()
        if self._error is not None:
            raise self._error
        return self._known()

    def end(self) -> None:
        """Take the node away; the context stays, and with another node the participant too."""
        self._enough.set()
        self._thread.join()
        if self._node is not None:
            self._node.destroy_node()
            self._node = None

    def __enter__(self) -> Presence:
        """Return it; it ends with the block."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """End it, and ROS with it if nothing came of the block."""
        self.end()
        if error is not None:
            rclpy.try_shutdown()

    def _enter(self) -> None:
        rclpy.init(args=self._args, signal_handler_options=SignalHandlerOptions.NO)
        try:
            # The underscore keeps it out of lists of nodes; it is not what remaps and parameters
            # are meant for.
            self._node = rclpy.create_node(
                f'_valveflow_starting_{os.getpid()}', use_global_arguments=False,
                enable_rosout=False, start_parameter_services=False,
            )  # fmt: skip
        except Exception:
            rclpy.try_shutdown()
            raise
        self.tries += 1

    def _seek(self, tries: int) -> None:
        try:
            while not self._heard() and self.tries < tries and not self._enough.is_set():
                self._leave()
                self._enter()
        except Exception as error:  # noqa: BLE001 - told by `settle`
            self._error = error

    def _heard(self) -> bool:
        """Wait a moment for others; tell whether any are known."""
        end_s = time.monotonic() + _ANSWER_S
        while not (known := self._known()) and time.monotonic() < end_s:
            if self._enough.wait(_LOOK_S):
                break
        return known

    def _known(self) -> bool:
        return self._node is not None and len(self._node.get_node_names()) > 1

    def _leave(self) -> None:
        if self._node is not None:
            self._node.destroy_node()
            self._node = None
        rclpy.shutdown()
