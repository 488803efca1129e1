# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
Two fleets on one network: each has a namespace, a fusion node and a global frame of its own.

A robot of the red fleet publishes /red/NAME/submap. Its compressor node finds its fusion node by
the remappings below.
"""

from launch import LaunchDescription
from launch.substitutions import PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

FLEETS = ('red', 'blue')


def generate_launch_description():
    """Describe what to start."""
    folder = FindPackageShare('mapmerge_ros')
    return LaunchDescription(
        [
            Node(
                package='mapmerge_ros',
                executable='fusion_node',
                namespace=fleet,
                parameters=[
                    PathJoinSubstitution([folder, 'config', 'fusion.yaml']),
                    # Frames are shared by all on the network, whatever their namespace.
                    {'global_frame': f'{fleet}_global'},
                ],
                output='screen',
            )
            for fleet in FLEETS
        ]
        + [
            Node(
                package='mapmerge_ros',
                executable='compressor_node',
                namespace=f'{fleet}/drone0',
                parameters=[PathJoinSubstitution([folder, 'config', 'compressor.yaml'])],
                remappings=[
                    ('/fusion_node/requests', f'/{fleet}/fusion_node/requests'),
                    ('/fusion_node/global_map', f'/{fleet}/fusion_node/global_map'),
                ],
                output='screen',
            )
            for fleet in FLEETS
        ]
    )
