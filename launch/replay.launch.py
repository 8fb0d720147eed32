# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Play a log on the input topics and let a monitor listen to it."""

from launch.actions import (
    DeclareLaunchArgument,
    IncludeLaunchDescription,
    OpaqueFunction,
    Shutdown,
)
from launch.conditions import IfCondition
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from launch import LaunchContext, LaunchDescription


def replay(context: LaunchContext) -> list[Node]:
    """Make the node that plays; everything ends when it has played."""

    def given(name: str) -> str:
        return LaunchConfiguration(name).perform(context)

    return [
        Node(
            package='valveflow_ros',
            executable='replay',
            name='replay',
            namespace=given('namespace'),
            arguments=[given('log'), '--rate', given('rate')],
            output='screen',
            on_exit=[Shutdown(reason='the log has been played')],
        )
    ]


def generate_launch_description() -> LaunchDescription:
    """Describe the launch."""
    share = FindPackageShare('valveflow_ros')
    loopback = PathJoinSubstitution([share, 'launch', 'loopback.launch.py'])
    passed_on = ('namespace', 'params_file', 'log_level', 'record', 'record_directory')
    return LaunchDescription(
        [
            DeclareLaunchArgument('log', description='.mcap, rosbag2 folder, .csv or .parquet.'),
            DeclareLaunchArgument(
                'rate',
                default_value='0.0',
                description="Seconds of the log's time in a second; 0: as fast as the monitor "
                'takes it.',
            ),
            DeclareLaunchArgument(
                'monitor',
                default_value='true',
                description='Whether to start a monitor that listens (true, false).',
            ),
            DeclareLaunchArgument(
                'namespace', default_value='', description='Namespace of both nodes.'
            ),
            DeclareLaunchArgument(
                'params_file',
                default_value=PathJoinSubstitution([share, 'config', 'monitor.yaml']),
                description='Parameter file of the monitor (YAML).',
            ),
            DeclareLaunchArgument(
                'log_level', default_value='info', description='debug, info, warn, error or fatal.'
            ),
            DeclareLaunchArgument(
                'record', default_value='false', description='Whether to record the replay.'
            ),
            DeclareLaunchArgument(
                'record_directory', default_value='', description='Folder of the recordings.'
            ),
            DeclareLaunchArgument(
                'loopback_only',
                default_value='false',
                description='Whether DDS of both nodes stays on 127.0.0.1 (true, false).',
            ),
            # Also where no monitor is started that would do it.
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(loopback),
                condition=IfCondition(LaunchConfiguration('loopback_only')),
            ),
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(
                    PathJoinSubstitution([share, 'launch', 'monitor.launch.py'])
                ),
                condition=IfCondition(LaunchConfiguration('monitor')),
                launch_arguments=[
                    ('use_sim_time', 'true'),
                    *((name, LaunchConfiguration(name)) for name in passed_on),
                ],
            ),
            OpaqueFunction(function=replay),
        ]
    )
