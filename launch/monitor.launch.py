# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""Start the monitor; the option --show-args of `ros2 launch` explains the arguments."""

from ament_index_python.packages import PackageNotFoundError, get_package_prefix
from launch.actions import (
    DeclareLaunchArgument,
    IncludeLaunchDescription,
    OpaqueFunction,
    TimerAction,
)
from launch.conditions import IfCondition
from launch.events.process import ProcessExited
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from launch import LaunchContext, LaunchDescription
from valveflow_ros.ros.process import parameter_file

# Arguments that stand above the parameter file where they are given, and the type of each.
OVERRIDES = {
    'unit_tag': (str, 'Tag of the unit; frame_id and hardware_id of messages.'),
    'record': (bool, 'Whether to record inputs and outputs to MCAP (true, false).'),
    'record_directory': (str, 'Folder of the recordings.'),
    'autostart': (bool, 'Whether the node configures and activates itself (true, false).'),
}


def argument(name: str, about: str, default: object = '') -> DeclareLaunchArgument:
    """Declare an argument."""
    return DeclareLaunchArgument(name, default_value=default, description=about)


_TRUE = ('true', '1', 'yes', 'on')
_FALSE = ('false', '0', 'no', 'off', '')


def typed(kind: type, text: str) -> object:
    """Turn an argument's text into a parameter's value."""
    if kind is not bool:
        return text
    word = text.strip().lower()
    if word not in (*_TRUE, *_FALSE):
        raise ValueError(f"'{text}' is neither true nor false")
    return word in _TRUE


def monitor(context: LaunchContext) -> list[Node]:
    """Make the node, with those parameters that were given."""

    def given(name: str) -> str:
        return LaunchConfiguration(name).perform(context)

    overrides = {
        name: typed(kind, given(name)) for name, (kind, _) in OVERRIDES.items() if given(name)
    }
    overrides['use_sim_time'] = typed(bool, given('use_sim_time'))
    # When it is started again the arguments may be those of another unit's include, or gone.
    pushed, namespace = context.launch_configurations.get('ros_namespace', ''), given('namespace')
    if (pushed or namespace) and not namespace.startswith('/'):
        namespace = f'/{pushed.strip("/")}/{namespace}'.replace('//', '/').rstrip('/')
    fixed = {
        'namespace': namespace,
        'parameters': [given('params_file'), parameter_file(overrides)],
        'arguments': ['--ros-args', '--log-level', given('log_level')],
    }
    again = typed(bool, given('use_respawn'))

    def node() -> Node:
        return Node(
            package='valveflow_ros',
            executable='monitor',
            name='valveflow_monitor',
            on_exit=start_again if again else None,
            output='screen',
            **fixed,
        )

    def start_again(event: ProcessExited, context: LaunchContext) -> list[TimerAction]:
        """Start it again; one that ended in order, as by its lifecycle, stays down."""
        if event.returncode == 0 or context.is_shutdown:
            return []
        return [TimerAction(period=2.0, actions=[node()], cancel_on_shutdown=True)]

    return [node()]


def bridge(context: LaunchContext) -> list[Node]:
    """Make the bridge for Foxglove, where it is wanted and installed."""
    port = LaunchConfiguration('foxglove_port').perform(context).strip()
    if not port:
        return []
    try:
        get_package_prefix('foxglove_bridge')
    except PackageNotFoundError:
        raise RuntimeError(
            'foxglove_port was given and foxglove_bridge is not installed: '
            'sudo apt install ros-jazzy-foxglove-bridge'
        ) from None
    if not port.isdecimal() or not 1 <= int(port) <= 65535:
        raise ValueError(f"foxglove_port must be a port such as 8765, not '{port}'")
    return [
        Node(
            package='foxglove_bridge',
            executable='foxglove_bridge',
            name='foxglove_bridge',
            namespace=LaunchConfiguration('namespace').perform(context),
            # It only looks: nothing can be published, called or set through it.
            parameters=[
                {
                    'address': '127.0.0.1',
                    'port': int(port),
                    'capabilities': ['connectionGraph'],
                }
            ],
            output='screen',
        )
    ]


def generate_launch_description() -> LaunchDescription:
    """Describe the launch."""
    share = FindPackageShare('valveflow_ros')
    defaults = PathJoinSubstitution([share, 'config', 'monitor.yaml'])
    loopback = PathJoinSubstitution([share, 'launch', 'loopback.launch.py'])
    return LaunchDescription(
        [
            argument('namespace', 'Namespace of the node and its relative topics.'),
            argument('params_file', 'Parameter file (YAML).', defaults),
            argument('use_sim_time', 'Whether to take times from /clock (true, false).', 'false'),
            argument('log_level', 'debug, info, warn, error or fatal.', 'info'),
            argument(
                'use_respawn', 'Whether to start it again when it dies (true, false).', 'false'
            ),
            # Not by default: a gateway on another machine would go unheard without a word.
            argument(
                'loopback_only',
                'Whether DDS, of this node and of all started after it, stays on 127.0.0.1 '
                '(true, false).',
                'false',
            ),
            argument(
                'foxglove_port',
                'Port of foxglove_bridge on 127.0.0.1, such as 8765; empty: it is not started.',
            ),
            *(
                argument(name, f'{about} Empty: as in the parameter file.')
                for name, (_, about) in OVERRIDES.items()
            ),
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(loopback),
                condition=IfCondition(LaunchConfiguration('loopback_only')),
            ),
            OpaqueFunction(function=monitor),
            OpaqueFunction(function=bridge),
        ]
    )
