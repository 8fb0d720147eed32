"""Which way messages take on one machine: sockets, not shared memory.

Fast DDS offers both and prefers shared memory. A process that was killed leaves its part of it
behind; when it is started again the part is thrown away and made anew under the same name, while
a process that sent to the old one goes on writing to what nobody reads (Fast DDS issues 5053 and
4728). A monitor that was killed and started again would then hear nothing, and nobody would say
why. Over sockets that cannot happen, nothing is left in /dev/shm, and another user's files there
are in nobody's way (issue 3535).
"""

from __future__ import annotations

import os
from collections.abc import MutableMapping
from pathlib import Path

from ament_index_python.packages import PackageNotFoundError, get_package_share_directory
from rclpy.utilities import get_rmw_implementation_identifier

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
