"""Being known in the domain before the work begins.

Fast DDS (2.14) announces a participant before its own sockets are read. Who is on the same host
answers within a millisecond, the answer is lost, and the next one comes with the period of 3 s:
about half of all neighbours are heard of that late. So a process shows itself as soon as it can,
and five times at once, as five participants with a node that does nothing; compiler and libraries
load meanwhile. Then it goes on as the one that has heard of most neighbours. Whom that one missed
it hears of with the neighbour's period, counted from the start and not from when all is loaded.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence

import rclpy
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import get_default_context, get_rmw_implementation_identifier

from valveflow_ros.ros.secure_start import security_wanted
from valveflow_ros.ros.transport import FAST_DDS

# Each after the first takes ten milliseconds. In ten starts beside one neighbour at least one of
# the five heard it each time, and one to five did.
_AT_ONCE = 5
# The underscore keeps it out of lists of nodes.
_NAME = '_valveflow_starting'


class Presence:
    """Takes part in the domain as soon as it is made; the default context is up from then on.

    Parameters
    ----------
    args : sequence of str, optional
        The arguments for `rclpy.init`; those of the process by default.
    count : int, optional
        As how many participants; by default five, and none before the real node where the
        middleware is not Fast DDS or security is wanted: a policy lets in known names only.
    environ : mapping, optional
        Where the wish for security stands; the process's own environment by default.

    Raises
    ------
    Exception
        Whatever rclpy raises when ROS cannot be started.
    """

    def __init__(
        self,
        args: Sequence[str] | None = None,
        count: int | None = None,
        environ: Mapping[str, str] | None = None,
    ) -> None:
        if count is None:
            plain = not security_wanted(os.environ if environ is None else environ)
            helps = plain and get_rmw_implementation_identifier() in FAST_DDS
            count = _AT_ONCE if helps else 0
        self._args = None if args is None else list(args)
        # Its context alone keeps the log of the process.
        rclpy.init(args=self._args, signal_handler_options=SignalHandlerOptions.NO)
        self._contexts: list[Context] = [get_default_context()]
        self._nodes: list[Node] = []
        for number in range(count):
            if not self._shown(first=number == 0):
                break

    def settle(self) -> Context:
        """Return the context that has heard of most neighbours; the others leave the domain.

        It is the one to make nodes in. Until `end` a node of its own keeps it there.
        """
        if not self._nodes:
            return self._contexts[0]
        best = max(self._nodes, key=_neighbours)
        for node in self._nodes:
            if node is not best:
                self._leave(node)
        self._nodes = [best]
        return best.context

    def end(self) -> None:
        """Take what is there of nodes away; a context with another node in it stays known."""
        for node in self._nodes:
            node.destroy_node()
        self._nodes = []

    def close(self) -> None:
        """Take everything away; nothing of ROS is up afterwards."""
        self.end()
        for context in self._contexts[1:]:
            context.try_shutdown()
        self._contexts = []
        rclpy.try_shutdown()

    def _shown(self, first: bool) -> bool:
        """Make one more participant; tell whether that went well."""
        try:
            if not first:
                context = Context()
                context.init(self._args, initialize_logging=False)
                self._contexts.append(context)
            # Remaps and parameters are meant for the real node.
            node = rclpy.create_node(
                _NAME, context=self._contexts[-1], use_global_arguments=False,
                enable_rosout=False, start_parameter_services=False,
                parameter_overrides=[Parameter('start_type_description_service', value=False)],
            )  # fmt: skip
        except Exception:  # noqa: BLE001 - the real node will tell, if it meets the same
            return False
        self._nodes.append(node)
        return True

    def _leave(self, node: Node) -> None:
        context = node.context
        node.destroy_node()
        if context is not self._contexts[0]:
            context.try_shutdown()
            self._contexts.remove(context)


def _neighbours(node: Node) -> int:
    """Return how many nodes it has heard of, without hidden ones: these come and go."""
    try:
        return sum(not name.startswith('_') for name in node.get_node_names())
    except Exception:  # noqa: BLE001 - rclpy raises what its C++ gave it; another may know
        return 0
