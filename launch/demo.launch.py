# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""A simulated plant and a monitor; ends when the plant has run."""

from typing import Any

from launch.actions import (
    DeclareLaunchArgument,
    IncludeLaunchDescription,
    OpaqueFunction,
    Shutdown,
)
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from launch import LaunchContext, LaunchDescription
from valveflow_ros.ros.process import parameter_file

PLANT = {
    'days': ('3.0', 'How many days the plant is simulated.'),
    'seed': ('1', 'Seed of every random number.'),
    'rate': ('0.0', 'Plant seconds in a second; 0: as fast as the monitor takes them.'),
    'effects': (
        'step',
        'What is wrong with the plant: name:key=value,..., several with semicolons between them, '
        "quoted for the shell: effects:='curve_step:s_mw=-12,t0_days=2.7;backlash'. step: it "
        'gives 12 MW less after nine tenths of the days; none: nothing.',
    ),
}
MONITOR = {
    'namespace': ('', 'Namespace of both nodes.'),
    'unit_tag': ('demo', 'Tag of the unit.'),
    'use_sim_time': ('true', "Whether the monitor goes by the plant's clock (true, false)."),
    'record': ('true', 'Whether to record inputs and outputs to MCAP (true, false).'),
    'record_directory': ('', 'Folder of the recordings; empty: valveflow_recordings here.'),
    'log_level': ('info', 'debug, info, warn, error or fatal.'),
    # The environment that the monitor's launch file sets is the plant's too, which comes after it.
    'loopback_only': ('false', 'Whether DDS of both nodes stays on 127.0.0.1 (true, false).'),
}


def given(context: LaunchContext, name: str, kind: type = str) -> Any:
    """Return the value of an argument."""
    text = LaunchConfiguration(name).perform(context)
    try:
        return kind(text)
    except ValueError:
        raise RuntimeError(f"{name} must be a number, not '{text}'") from None


def values(context: LaunchContext) -> dict[str, object]:
    """Return the parameters of the plant."""
    days, effects = given(context, 'days', float), given(context, 'effects')
    # A command line of ros2 launch cannot give an empty text.
    known = {'step': f'curve_step:s_mw=-12,t0_days={0.9 * days:g}', 'none': ''}
    return {
        'days': days,
        'seed': given(context, 'seed', int),
        'rate': given(context, 'rate', float),
        'effects': known.get(effects, effects),
        'unit_tag': given(context, 'unit_tag'),
        'stamped': True,
        'use_clock': True,
    }


def check(context: LaunchContext) -> None:
    """Refuse an argument before the monitor is started, which would be left running."""
    values(context)


def plant(context: LaunchContext) -> list[Node]:
    """Make the plant; everything ends when it has run."""
    return [
        Node(
            package='valveflow_ros',
            executable='plant_simulator',
            name='plant_simulator',
            namespace=given(context, 'namespace'),
            parameters=[parameter_file(values(context))],
            output='screen',
            on_exit=[Shutdown(reason='the plant has run')],
        )
    ]


def generate_launch_description() -> LaunchDescription:
    """Describe the launch."""
    monitor = PathJoinSubstitution(
        [FindPackageShare('valveflow_ros'), 'launch', 'monitor.launch.py']
    )
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=about)
                for name, (default, about) in (PLANT | MONITOR).items()
            ),
            OpaqueFunction(function=check),
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(monitor),
                launch_arguments=[(name, LaunchConfiguration(name)) for name in MONITOR],
            ),
            OpaqueFunction(function=plant),
        ]
    )
