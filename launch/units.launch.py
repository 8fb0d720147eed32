# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Several units on one host: a monitor each, and the OPC UA gateways that their list names."""

from launch.actions import (
    DeclareLaunchArgument,
    GroupAction,
    IncludeLaunchDescription,
    OpaqueFunction,
)
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from launch import LaunchContext, LaunchDescription
from valveflow_ros.ros.process import parameter_file, read_units

COMMON = {
    'log_level': ('info', 'debug, info, warn, error or fatal.'),
    'use_respawn': ('false', 'Whether to start what dies again (true, false).'),
    'loopback_only': ('false', 'Whether DDS of all nodes stays on 127.0.0.1 (true, false).'),
}


def nodes(context: LaunchContext) -> list[GroupAction | Node]:
    """Make the monitors and gateways; a gateway's file that two units name is started once."""
    given = {name: LaunchConfiguration(name).perform(context) for name in ('units', *COMMON)}
    monitor = PathJoinSubstitution(
        [FindPackageShare('valveflow_ros'), 'launch', 'monitor.launch.py']
    )
    found: list[GroupAction | Node] = []
    gateways: dict[str, str] = {}
    for unit in read_units(given.pop('units')):
        if unit.gateway:
            gateways.setdefault(unit.gateway, unit.namespace)
        arguments = {**given, 'namespace': unit.namespace, 'params_file': unit.params_file}
        found.append(
            GroupAction([
                IncludeLaunchDescription(
                    PythonLaunchDescriptionSource(monitor),
                    launch_arguments=list(arguments.items()),
                )
            ])
        )  # fmt: skip
    for path, namespace in gateways.items():
        found.append(
            Node(
                package='valveflow_ros',
                executable='opcua_gateway',
                name='opcua_gateway',
                namespace=namespace,
                parameters=[parameter_file({'mapping_file': path})],
                arguments=['--ros-args', '--log-level', given['log_level']],
                respawn=given['use_respawn'] == 'true',
                respawn_delay=2.0,
                output='screen',
            )
        )
    return found


def generate_launch_description() -> LaunchDescription:
    """Describe the launch."""
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                'units', description='List of the units (YAML), such as config/units.yaml.'
            ),
            *(
                DeclareLaunchArgument(name, default_value=default, description=about)
                for name, (default, about) in COMMON.items()
            ),
            OpaqueFunction(function=nodes),
        ]
    )
