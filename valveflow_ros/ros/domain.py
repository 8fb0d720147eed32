# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Joins the ROS domain: transport, security and early discovery.

Fast DDS (2.14) announces a participant before it reads its own sockets. Participants on the same
host answer within a millisecond, the answer is lost, and the next one comes after the period of
3 s. About half of all neighbours are discovered that late. The monitor therefore joins the domain
as early as possible, as five participants with an idle node each, while compiler and libraries
load. It then continues with the participant that has discovered the most neighbours.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Mapping, MutableMapping, Sequence
from contextlib import contextmanager

import rclpy
from ament_index_python.packages import PackageNotFoundError, get_package_share_directory
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import get_default_context, get_rmw_implementation_identifier

from valveflow_ros.errors import InputError, ValveflowError
from valveflow_ros.ros.process import complain, one_line, with_place

_FAST_DDS = ('rmw_fastrtps_cpp', 'rmw_fastrtps_dynamic_cpp')


def run(executable: str, args: Sequence[str] | None, work: Callable[[], int]) -> int:
    """Start ROS and work until the end; return the exit status.

    Each error is printed as a sentence with the name of the executable.
    """
    try:
        choose_transport()
        check_security(args)
        _initialise(args)
        return work()
    except ValveflowError as error:
        return complain(executable, str(error))
    except Exception as error:  # noqa: BLE001 - print a sentence instead of a traceback
        return complain(executable, f'failed unexpectedly: {with_place(error)}')
    finally:
        rclpy.try_shutdown()


@contextmanager
def spinning(node: Node) -> Iterator[SingleThreadedExecutor]:
    """Give an executor for a node; both end with the block."""
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    try:
        yield executor
    finally:
        executor.shutdown(timeout_sec=0.5)
        node.destroy_node()


def _initialise(args: Sequence[str] | None) -> None:
    try:
        rclpy.init(
            args=None if args is None else list(args),
            signal_handler_options=SignalHandlerOptions.NO,
        )
    except Exception as error:  # noqa: BLE001 - rclpy raises many kinds of exceptions
        raise ValveflowError(f'ROS could not be started: {one_line(error)}') from None


# Transport: sockets, not shared memory. Fast DDS offers both and prefers shared memory. A killed
# process leaves its segment behind. At a restart a new segment is created under the same name,
# while other processes still write to the old one, which nobody reads (Fast DDS issues 5053 and
# 4728), so a restarted monitor would receive nothing. Sockets avoid this, leave nothing in
# /dev/shm, and do not depend on another user's files there (issue 3535).

_TRANSPORTS = 'FASTDDS_BUILTIN_TRANSPORTS'
_PROFILES = ('FASTDDS_DEFAULT_PROFILES_FILE', 'FASTRTPS_DEFAULT_PROFILES_FILE')
# Buffers for messages that arrive while the monitor is delayed, as far as the system allows.
_SOCKETS = 'UDPv4?sockets_size=4MB'
_RANGE = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
# Each of these changes how the middleware discovers other hosts.
_WIDER = ('ROS_LOCALHOST_ONLY', 'ROS_STATIC_PEERS', 'ROS_DISCOVERY_SERVER')


def choose_transport(
    environ: MutableMapping[str, str] | None = None, middleware: str | None = None
) -> None:
    """Disable shared memory in Fast DDS unless the environment selects a transport.

    If discovery is limited to this host, ROS adds shared memory in any case. Then the profile
    `config/fastdds_loopback.xml` replaces this limit. It also limits discovery to this host, and
    binds its sockets to 127.0.0.1. ROS reads the environment when the first node is created.
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
    # Without the file Fast DDS would discover other hosts.
    if os.access(profile, os.R_OK) and not any(environ.get(name) for name in _WIDER):
        environ.update(dict.fromkeys(_PROFILES, profile))
        environ[_RANGE] = 'SYSTEM_DEFAULT'


# Security. The ROS client library enables it only for the exact word `true`. For any other word,
# and with the strategy `Permissive` also if no keys are found, it continues without security. A
# middleware built without security reports this only when a node is created. In all these cases
# the process ends here, before anything is sent or received.

_ENABLE, _STRATEGY = 'ROS_SECURITY_ENABLE', 'ROS_SECURITY_STRATEGY'
_KEYSTORE = 'ROS_SECURITY_KEYSTORE'
_NO = ('', 'false', '0', 'no', 'off')
# These middlewares refuse to create a node if security is enforced and not available. Others may
# ignore the setting.
_REFUSING = (*_FAST_DDS, 'rmw_cyclonedds_cpp')


class InsecureError(InputError):
    """Security is required but not available."""

    def __init__(self, problem: str) -> None:
        super().__init__(f'Not started, because security is demanded ({_ENABLE}): {problem}.')


def security_wanted(environ: Mapping[str, str]) -> bool:
    """Return True if the environment requests security, with any word for yes."""
    return environ.get(_ENABLE, '').lower() not in _NO


def check_security(
    args: Sequence[str] | None = None, environ: Mapping[str, str] | None = None
) -> None:
    """Check that a node can be created with security, if security is required.

    Raises `InsecureError` if security is required with a word that ROS ignores, or without being
    enforced, or the middleware cannot provide it.
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
        # A trial node with the same arguments, destroyed at once.
        rclpy.init(
            args=None if args is None else list(args),
            context=context,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        Node('security_check', context=context, start_parameter_services=False).destroy_node()
    except Exception as error:  # noqa: BLE001 - rclpy raises many kinds of exceptions
        said = one_line(error)
        if 'security libraries' in said:
            raise InsecureError(
                'this Fast DDS is built without DDS security, as that of the ROS wheels is; take '
                'a ROS installation that has it'
            ) from None
        raise InsecureError(f'no node can be made with it ({said.rstrip(".")})') from None
    finally:
        rclpy.try_shutdown(context=context)


# Each after the first takes 10 ms. In ten starts with one neighbour, between one and five of the
# five participants discovered it.
_PARTICIPANTS = 5
# The underscore hides the node from node lists.
_NAME = '_valveflow_starting'


class Presence:
    """Joins the domain on construction and initialises the default context.

    Raises `ValveflowError` if ROS could not be started.

    Parameters
    ----------
    args : sequence of str, optional
        The arguments for `rclpy.init`; by default those of the process.
    count : int, optional
        Number of participants before the real node. By default five, or none if the middleware
        is not Fast DDS or security is required, since a policy accepts only known node names.
    environ : mapping, optional
        Environment variables for security; by default those of the process.
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
        # Only this context initialises logging for the process.
        _initialise(args)
        self._contexts: list[Context] = [get_default_context()]
        self._nodes: list[Node] = []
        for _ in range(count):
            if not self._add_participant():
                break

    @property
    def args(self) -> list[str]:
        """Return the arguments for `rclpy.init`."""
        return sys.argv[1:] if self._args is None else self._args

    def settle(self) -> Context:
        """Return the context that has discovered most neighbours; the others leave the domain.

        New nodes must use this context. Until `end`, an idle node keeps it in the domain.
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
        """Destroy the idle node; a context with another node stays in the domain."""
        for node in self._nodes:
            node.destroy_node()
        self._nodes = []

    def close(self) -> None:
        """Shut down all of ROS."""
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
            # Remaps and parameters apply to the real node only.
            node = rclpy.create_node(
                _NAME, context=self._contexts[-1], use_global_arguments=False,
                enable_rosout=False, start_parameter_services=False,
                parameter_overrides=[Parameter('start_type_description_service', value=False)],
            )  # fmt: skip
        except Exception:  # noqa: BLE001 - the real node reports the same problem
            return False
        self._nodes.append(node)
        return True


def _neighbours(node: Node) -> int:
    """Return the number of nodes that ``node`` has discovered, without hidden nodes."""
    try:
        return sum(not name.startswith('_') for name in node.get_node_names())
    except Exception:  # noqa: BLE001 - rclpy raises many kinds; another node may succeed
        return 0
