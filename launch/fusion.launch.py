# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
Start the fusion node, and on request a recording, its robots one by one, and RViz.

  ros2 launch mapmerge_ros fusion.launch.py
  ros2 launch mapmerge_ros fusion.launch.py bag:=four_drones.mcap rviz:=true
  ros2 launch mapmerge_ros fusion.launch.py bag:=four_drones.mcap robots:=drone0,drone1
  ros2 launch mapmerge_ros fusion.launch.py namespace:=red
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

PACKAGE = 'mapmerge_ros'

ARGUMENTS = {
    'config': (None, 'Parameters of the fusion node; default: config/fusion.yaml.'),
    'namespace': ('', 'Of the fusion node; it then hears the robots below this name only.'),
    'bag': ('', 'Recording to play: an mcap file or a rosbag2 folder.'),
    'robots': (
        '',
        'Names with commas between: these robots of the recording, each by a node of its own; '
        'empty: all of it by ros2 bag play.',
    ),
    'rate': ('1.0', 'Times as fast as recorded.'),
    'rviz': ('false', 'Whether to start RViz.'),
    'autostart': ('true', 'Whether the fusion node brings itself up.'),
}


def share(*parts):
    """Path of an installed file."""
    return PathJoinSubstitution([FindPackageShare(PACKAGE), *parts])


def players(context):
    """Return what plays the recording, if there is one."""
    bag, robots, rate = (
        LaunchConfiguration(name).perform(context) for name in ('bag', 'robots', 'rate')
    )
    if not bag:
        return []
    names = [name.strip() for name in robots.split(',') if name.strip()]
    if not names:
        overrides = share('config', 'qos_overrides.yaml').perform(context)
        play = ['ros2', 'bag', 'play', bag, '--clock', '--rate', rate]
        play += ['--qos-profile-overrides-path', overrides]
        return [ExecuteProcess(cmd=play, output='screen')]
    return [
        Node(
            package=PACKAGE,
            executable='robot_node',
            name=f'robot_{name}',
            parameters=[{'recording': bag, 'robot_id': name, 'rate': float(rate)}],
            output='screen',
        )
        for name in names
    ]


def fusion(context):
    """Return the fusion node, in the time of the recording where ros2 bag plays one."""
    bag, robots = (LaunchConfiguration(name).perform(context) for name in ('bag', 'robots'))
    autostart = ParameterValue(LaunchConfiguration('autostart'), value_type=bool)
    return [
        Node(
            package=PACKAGE,
            executable='fusion_node',
            namespace=LaunchConfiguration('namespace'),
            parameters=[
                LaunchConfiguration('config'),
                {'use_sim_time': bool(bag and not robots), 'autostart': autostart},
            ],
            output='screen',
        )
    ]


def generate_launch_description():
    """Describe what to start."""
    arguments = [
        DeclareLaunchArgument(
            name,
            default_value=share('config', 'fusion.yaml') if default is None else default,
            description=description,
        )
        for name, (default, description) in ARGUMENTS.items()
    ]
    rviz = Node(
        package='rviz2',
        executable='rviz2',
        arguments=['-d', share('rviz', 'fusion.rviz')],
        condition=IfCondition(LaunchConfiguration('rviz')),
    )
    starts = [OpaqueFunction(function=fusion), OpaqueFunction(function=players), rviz]
    return LaunchDescription([*arguments, *starts])
