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
from collections.abc import Mapping, MutableMapping, Sequence
from pathlib import Path

import rclpy
from ament_index_python.packages import PackageNotFoundError, get_package_share_directory
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import get_default_context, get_rmw_implementation_identifier

from valveflow_ros.ros.secure_start import security_wanted

# Which way messages take on one machine: sockets, not shared memory.
#
# Fast DDS offers both and prefers shared memory. A process that was killed leaves its part of it
# behind; when it is started again the part is thrown away and made anew under the same name, while
# a process that sent to the old one goes on writing to what nobody reads (Fast DDS issues 5053 and
# 4728). A monitor that was killed and started again would then hear nothing, and nobody would say
# why. Over sockets that cannot happen, nothing is left in /dev/shm, and another user's files there
# are in nobody's way (issue 3535).


_TRANSPORTS = 'FASTDDS_BUILTIN_TRANSPORTS'
_PROFILES = ('FASTDDS_DEFAULT_PROFILES_FILE', 'FASTRTPS_DEFAULT_PROFILES_FILE')
# With room for what comes while the monitor is held up, as far as the system grants it.
_SOCKETS = 'UDPv4?sockets_size=4MB'
_RANGE = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
# With one of these the middleware looks for more than this host in ways of its own.
_OTHERWISE = ('ROS_LOCALHOST_ONLY', 'ROS_STATIC_PEERS', 'ROS_DISCOVERY_SERVER')
# Those to which this applies.
FAST_DDS = ('rmw_fastrtps_cpp', 'rmw_fastrtps_dynamic_cpp')


def choose_transport(
    environ: MutableMapping[str, str] | None = None, middleware: str | None = None
) -> None:
    """Keep Fast DDS off shared memory unless the environment says what is wanted.

    Where discovery is limited to this host, ROS adds shared memory whatever Fast DDS is told;
    there the profile `config/fastdds_loopback.xml` takes the place of that limit. It limits to
    this host as well, and binds its sockets to 127.0.0.1.

    Parameters
    ----------
    environ : mutable mapping, optional
        The process's own environment by default. It is read when the first node is made.
    middleware : str, optional
        The name of the ROS middleware, the one in use by default.
    """
    environ = os.environ if environ is None else environ
    middleware = get_rmw_implementation_identifier() if middleware is None else middleware
    if middleware not in FAST_DDS or any(environ.get(n) for n in (_TRANSPORTS, *_PROFILES)):
        return
    if environ.get(_RANGE, '').upper() != 'LOCALHOST':
        environ[_TRANSPORTS] = _SOCKETS
        return
    profile = _profile()
    if profile is not None and not any(environ.get(name) for name in _OTHERWISE):
        environ.update(dict.fromkeys(_PROFILES, str(profile)))
        environ[_RANGE] = 'SYSTEM_DEFAULT'


def _profile() -> Path | None:
    """Return the profile as it was installed, None where it was not."""
    try:
        share = Path(get_package_share_directory('valveflow_ros'))
    except (PackageNotFoundError, ValueError):
        return None
    path = share / 'config' / 'fastdds_loopback.xml'
    # Without it Fast DDS would go beyond this host.
    return path if os.access(path, os.R_OK) else None


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
