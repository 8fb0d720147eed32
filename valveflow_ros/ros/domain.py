# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Entering the ROS domain: transport, security, and being discovered early.

Fast DDS (2.14) announces a participant before it reads its own sockets. Whoever is on the same
host answers within a millisecond, the answer is lost, and the next one comes after the period of
3 s: about half of all neighbours are discovered that late. So the monitor enters the domain as
soon as it can, as five participants with a node that does nothing, while compiler and libraries
load. Then it continues as the one that has discovered most neighbours.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, MutableMapping, Sequence

import rclpy
from ament_index_python.packages import PackageNotFoundError, get_package_share_directory
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import get_default_context, get_rmw_implementation_identifier

from valveflow_ros.errors import InputError, ValveflowError
from valveflow_ros.ros.process import one_line

_FAST_DDS = ('rmw_fastrtps_cpp', 'rmw_fastrtps_dynamic_cpp')


def start_ros(args: Sequence[str] | None) -> None:
    """Choose the transport, check security and initialise the default context.

    Raises
    ------
    ValveflowError
        ROS could not be started, or security cannot be had.
    """
    choose_transport()
    check_security(args)
    _initialise(args)


def _initialise(args: Sequence[str] | None) -> None:
    try:
        rclpy.init(
            args=None if args is None else list(args),
            signal_handler_options=SignalHandlerOptions.NO,
        )
    except Exception as error:  # noqa: BLE001 - rclpy raises what its C++ gave it
        raise ValveflowError(f'ROS could not be started: {one_line(error)}') from None


# Transport: sockets, not shared memory. Fast DDS offers both and prefers shared memory. A process
# that was killed leaves its segment behind; at the restart the segment is made anew under the same
# name, while a process that sent to the old one goes on writing to what nobody reads (Fast DDS
# issues 5053 and 4728): a restarted monitor would hear nothing. Over sockets that cannot happen,
# nothing is left in /dev/shm, and another user's files there do no harm (issue 3535).

_TRANSPORTS = 'FASTDDS_BUILTIN_TRANSPORTS'
_PROFILES = ('FASTDDS_DEFAULT_PROFILES_FILE', 'FASTRTPS_DEFAULT_PROFILES_FILE')
# With room for what comes while the monitor is held up, as far as the system grants it.
_SOCKETS = 'UDPv4?sockets_size=4MB'
_RANGE = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
# With one of these the middleware looks beyond this host in ways of its own.
_WIDER = ('ROS_LOCALHOST_ONLY', 'ROS_STATIC_PEERS', 'ROS_DISCOVERY_SERVER')


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
    if middleware not in _FAST_DDS or any(environ.get(n) for n in (_TRANSPORTS, *_PROFILES)):
        return
    if environ.get(_RANGE, '').upper() != 'LOCALHOST':
        environ[_TRANSPORTS] = _SOCKETS
        return
    try:
        share = get_package_share_directory('valveflow_ros')
    except (PackageNotFoundError, ValueError):
        return
    profile = os.path.join(share, 'config', 'fastdds_loopback.xml')
    # Without the file Fast DDS would go beyond this host.
    if os.access(profile, os.R_OK) and not any(environ.get(name) for name in _WIDER):
        environ.update(dict.fromkeys(_PROFILES, profile))
        environ[_RANGE] = 'SYSTEM_DEFAULT'


# Security. The ROS client library turns it on for the exact word `true` only, continues without it
# for any other word, and with the strategy `Permissive` also where no keys are found. A middleware
# built without security says so only when a node is made. Each of these ends here, before anything
# is sent or received.

_ENABLE, _STRATEGY = 'ROS_SECURITY_ENABLE', 'ROS_SECURITY_STRATEGY'
_KEYSTORE = 'ROS_SECURITY_KEYSTORE'
_NO = ('', 'false', '0', 'no', 'off')
# These refuse to make a node where security is enforced and they cannot give it. Another one might
# ignore the wish.
_REFUSING = (*_FAST_DDS, 'rmw_cyclonedds_cpp')


class InsecureError(InputError):
    """Security is demanded and cannot be had."""

    def __init__(self, problem: str) -> None:
        super().__init__(f'Not started, because security is demanded ({_ENABLE}): {problem}.')


def security_wanted(environ: Mapping[str, str]) -> bool:
    """Return True if security is asked for, in whatever words."""
    return environ.get(_ENABLE, '').lower() not in _NO


def check_security(
    args: Sequence[str] | None = None, environ: Mapping[str, str] | None = None
) -> None:
    """Return if no security is demanded, or if a node can be made with it.

    Parameters
    ----------
    args : sequence of str, optional
        The arguments that `rclpy.init` will get; an enclave may be named in them.
    environ : mapping, optional
        Where the wish stands; the process's own environment by default.

    Raises
    ------
    InsecureError
        Security is demanded in words that ROS does not heed, without being enforced, or of a
        middleware that cannot give it.
    """
    environ = os.environ if environ is None else environ
    if not security_wanted(environ):
        return
    wish, strategy = environ[_ENABLE], environ.get(_STRATEGY, '')
    if wish != 'true':
        raise InsecureError(
            f"ROS understands only the word true, not '{wish}', and would run without security"
        )
    if strategy != 'Enforce':
        said = f"'{strategy}'" if strategy else 'not set'
        raise InsecureError(
            f'{_STRATEGY} is {said}; only Enforce keeps a node without keys from running without '
            'security'
        )
    keystore = environ.get(_KEYSTORE, '')
    if not keystore or not os.path.isdir(os.path.join(keystore, 'enclaves')):
        raise InsecureError(
            f"{_KEYSTORE} ('{keystore}') names no folder with a folder enclaves in it"
        )
    middleware = str(get_rmw_implementation_identifier())
    if middleware not in _REFUSING:
        raise InsecureError(
            f'of {middleware} it is not known whether it refuses to run without security'
        )
    context = Context()
    try:
        # A node as it will be made, thrown away at once.
        rclpy.init(
            args=None if args is None else list(args),
            context=context,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        Node('security_check', context=context, start_parameter_services=False).destroy_node()
    except Exception as error:  # noqa: BLE001 - rclpy raises what its C++ gave it
        said = one_line(error)
        if 'security libraries' in said:
            raise InsecureError(
                'this Fast DDS is built without DDS security, as that of the ROS wheels is; take '
                'a ROS installation that has it'
            ) from None
        raise InsecureError(f'no node can be made with it ({said.rstrip(".")})') from None
    finally:
        rclpy.try_shutdown(context=context)


# Each after the first takes ten milliseconds. In ten starts beside one neighbour at least one of
# the five discovered it each time, and one to five did.
_PARTICIPANTS = 5
# The underscore keeps it out of lists of nodes.
_NAME = '_valveflow_starting'


class Presence:
    """Takes part in the domain as soon as it is made; the default context is up from then on.

    Parameters
    ----------
    args : sequence of str, optional
        The arguments for `rclpy.init`; those of the process by default.
    count : int, optional
        Number of participants; by default five, and none before the real node where the
        middleware is not Fast DDS or security is wanted: a policy lets in known names only.
    environ : mapping, optional
        Where the wish for security stands; the process's own environment by default.

    Raises
    ------
    ValveflowError
        ROS could not be started.
    """

    def __init__(
        self,
        args: Sequence[str] | None = None,
        count: int | None = None,
        environ: Mapping[str, str] | None = None,
    ) -> None:
        if count is None:
            secured = security_wanted(os.environ if environ is None else environ)
            fast_dds = get_rmw_implementation_identifier() in _FAST_DDS
            count = _PARTICIPANTS if fast_dds and not secured else 0
        self._args = None if args is None else list(args)
        # Its context alone keeps the log of the process.
        _initialise(args)
        self._contexts: list[Context] = [get_default_context()]
        self._nodes: list[Node] = []
        for _ in range(count):
            if not self._add_participant():
                break

    def settle(self) -> Context:
        """Return the context that has discovered most neighbours; the others leave the domain.

        It is the one to make nodes in. Until `end` a node of its own keeps it there.
        """
        if not self._nodes:
            return self._contexts[0]
        best = max(self._nodes, key=_neighbours)
        for node in self._nodes:
            if node is not best:
                node.destroy_node()
                if node.context is not self._contexts[0]:
                    node.context.try_shutdown()
                    self._contexts.remove(node.context)
        self._nodes = [best]
        return best.context

    def end(self) -> None:
        """Destroy the remaining node; a context with another node in it stays in the domain."""
        for node in self._nodes:
            node.destroy_node()
        self._nodes = []

    def close(self) -> None:
        """Shut everything of ROS down."""
        self.end()
        for context in self._contexts[1:]:
            context.try_shutdown()
        self._contexts = []
        rclpy.try_shutdown()

    def _add_participant(self) -> bool:
        try:
            if self._nodes:
                context = Context()
                context.init(self._args, initialize_logging=False)
                self._contexts.append(context)
            # Remaps and parameters are meant for the real node.
            node = rclpy.create_node(
                _NAME, context=self._contexts[-1], use_global_arguments=False,
                enable_rosout=False, start_parameter_services=False,
                parameter_overrides=[Parameter('start_type_description_service', value=False)],
            )  # fmt: skip
        except Exception:  # noqa: BLE001 - the real node reports it if it meets the same
            return False
        self._nodes.append(node)
        return True


def _neighbours(node: Node) -> int:
    """Return how many nodes it has discovered, without hidden ones: these come and go."""
    try:
        return sum(not name.startswith('_') for name in node.get_node_names())
    except Exception:  # noqa: BLE001 - rclpy raises what its C++ gave it; another may know
        return 0
