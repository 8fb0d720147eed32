# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Keep DDS on this host, for everything that is started afterwards in the same scope."""

from pathlib import Path

from launch.actions import SetEnvironmentVariable
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

PACKAGE = 'valveflow_ros'
PROFILE = 'config/fastdds_loopback.xml'


def generate_launch_description() -> LaunchDescription:
    """Describe the launch."""
    profile = Path(FindPackageShare(PACKAGE).find(PACKAGE), PROFILE)
    if not profile.is_file():
        # DDS would go on without it, open to the network.
        raise FileNotFoundError(f'{profile} is missing; build the package again')
    environment = {
        # The second name is that of newer releases.
        'FASTRTPS_DEFAULT_PROFILES_FILE': str(profile),
        'FASTDDS_DEFAULT_PROFILES_FILE': str(profile),
        # Any other range adds sockets that are bound elsewhere, and shared memory.
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SYSTEM_DEFAULT',
    }
    return LaunchDescription(
        [SetEnvironmentVariable(name, value) for name, value in environment.items()]
    )
