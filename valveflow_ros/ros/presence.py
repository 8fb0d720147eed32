"""Being known in the domain before the work begins.

Fast DDS (2.14) announces a participant before its own sockets are read. Who is on the same host
answers within a millisecond, the answer is lost, and the next one comes with the period of 3 s:
almost half of the processes hear of a neighbour that late. So the process shows itself first,
with a node that does nothing, and loads and compiles meanwhile. Where nobody has answered after a
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

# Whose answer was heard is known by name after 0.1 to 0.2 s.
_ANSWER_S = 0.25
_LOOK_S = 0.01
# With almost one of two answers lost, one start in 200 is still alone after that many.
_TRIES = 6


class Presence:
    """Takes part in the domain as soon as it is made; the default context is up from then on.

    Others are looked for in a thread of its own, which ends by itself after a second or two.

    Parameters
    ----------
    args : sequence of str, optional
        The arguments for `rclpy.init`; those of the process by default.
    tries : int, optional
        How often to show itself as long as nobody is heard of. Without it once, or six times
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
        return bool(self._known())

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
        met: set[str] = set()
        answered = 0
        try:
            while True:
                found = self._heard(met)
                answered += bool(found)
                # One alone may be one of two that answered; once more it hardly is.
                whole = found >= met and len(found) + answered > 2
                met |= found
                if whole or self.tries >= tries or self._enough.is_set():
                    return
                self._leave()
                self._enter()
        except Exception as error:  # noqa: BLE001 - told by `settle`
            self._error = error

    def _heard(self, met: set[str]) -> set[str]:
        """Wait a moment for those met before, or for anybody; return who is known."""
        end_s = time.monotonic() + _ANSWER_S
        while not (met and self._known() >= met) and time.monotonic() < end_s:
            if self._enough.wait(_LOOK_S):
                break
        return self._known()

    def _known(self) -> set[str]:
        """Return the others by their full names."""
        if self._node is None:
            return set()
        own = self._node.get_fully_qualified_name()
        found = (f'{space.rstrip("/")}/{name}' for name, space in
                 self._node.get_node_names_and_namespaces())  # fmt: skip
        return {name for name in found if name != own}

    def _leave(self) -> None:
        if self._node is not None:
            self._node.destroy_node()
            self._node = None
        rclpy.shutdown()
