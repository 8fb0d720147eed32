"""Whoever asks for DDS security gets it, or no start at all.

The ROS client library turns security on for the exact word `true` only, goes on in
the open for any other, and with the strategy `Permissive` does so again where
no keys are found. A middleware built without security says so only when a
node is made. Each of these ends here, before anything is heard or said.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence

import rclpy
from rclpy.context import Context
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import get_rmw_implementation_identifier

from valveflow_ros.errors import InputError
from valveflow_ros.ros.process import one_line

_ENABLE, _STRATEGY = 'ROS_SECURITY_ENABLE', 'ROS_SECURITY_STRATEGY'
_KEYSTORE = 'ROS_SECURITY_KEYSTORE'
_NO = ('', 'false', '0', 'no', 'off')
# Those that refuse to make a node where security is enforced and they cannot give it. Of another
# one it is not known, and it might ignore the wish.
_REFUSING = ('rmw_fastrtps_cpp', 'rmw_fastrtps_dynamic_cpp', 'rmw_cyclonedds_cpp')
_WITHOUT = 'security libraries'


class InsecureError(InputError):
    """Security is demanded and cannot be had."""

    def __init__(self, problem: str) -> None:
        super().__init__(f'Not started, because security is demanded ({_ENABLE}): {problem}.')


def security_wanted(environ: Mapping[str, str]) -> bool:
    """Tell whether security is asked for, in whatever words."""
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
    problem = _words(environ[_ENABLE], environ) or _middleware()
    if problem:
        raise InsecureError(problem)
    _try_out(args)


def _words(wish: str, environ: Mapping[str, str]) -> str:
    """Return what is wrong with how security is asked for."""
    if wish != 'true':
        return f"ROS understands only the word true, not '{wish}', and would run without security"
    strategy = environ.get(_STRATEGY, '')
    if strategy != 'Enforce':
        said = f"'{strategy}'" if strategy else 'not set'
        return (
            f'{_STRATEGY} is {said}; only Enforce keeps a node without keys from running without '
            'security'
        )
    keystore = environ.get(_KEYSTORE, '')
    if not os.path.isdir(os.path.join(keystore, 'enclaves')) or not keystore:
        return f"{_KEYSTORE} ('{keystore}') names no folder with a folder enclaves in it"
    return ''


def _middleware() -> str:
    name = str(get_rmw_implementation_identifier())
    if name in _REFUSING:
        return ''
    return f'of {name} it is not known whether it refuses to run without security'


def _try_out(args: Sequence[str] | None) -> None:
    """Make a node as it will be made, and throw it away."""
    context = Context()
    try:
        rclpy.init(
            args=None if args is None else list(args),
            context=context,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        Node('security_check', context=context, start_parameter_services=False).destroy_node()
    except Exception as error:  # noqa: BLE001 - rclpy raises what its C++ gave it
        said = one_line(error)
        if _WITHOUT in said:
            raise InsecureError(
                'this Fast DDS is built without DDS security, as that of the ROS wheels is; take '
                'a ROS installation that has it'
            ) from None
        raise InsecureError(f'no node can be made with it ({said.rstrip(".")})') from None
    finally:
        rclpy.try_shutdown(context=context)
