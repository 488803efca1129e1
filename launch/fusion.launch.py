# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Start the fusion node with config/fusion.yaml, or with another file of parameters."""

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription


def generate_launch_description() -> LaunchDescription:
    """Describe what to start."""
    default = PathJoinSubstitution([FindPackageShare('mapmerge_ros'), 'config', 'fusion.yaml'])
    return LaunchDescription(
        [
            DeclareLaunchArgument('config', default_value=default, description='Parameters.'),
            DeclareLaunchArgument('namespace', default_value='', description='Of the node.'),
            Node(
                package='mapmerge_ros',
                executable='fusion_node',
                namespace=LaunchConfiguration('namespace'),
                parameters=[LaunchConfiguration('config')],
                output='screen',
            ),
        ]
    )
