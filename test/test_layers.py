# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Dependencies point down only: proved by reading the imports, lazy ones too."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / 'mapmerge_ros'
LAYERS = [
    {'errors'},
    {'arrays'},
    {'blas', 'distributions'},
    {'geometry'},
    {'submap'},
    {'bundle'},
    {'association'},
    {'fusion'},
    {'io'},
    {'simulation'},
    {'experiments'},
    {'cli', 'nodes'},
]
RANK = {room: rank for rank, rooms in enumerate(LAYERS) for room in rooms}
ROS = {
    'rclpy',
    'mapmerge_msgs',
    'std_msgs',
    'geometry_msgs',
    'diagnostic_msgs',
    'rosidl_runtime_py',
    'lifecycle_msgs',
    'nav_msgs',
    'rcl_interfaces',
    'rosgraph_msgs',
    'sensor_msgs',
    'std_srvs',
    'tf2_msgs',
    'visualization_msgs',
}


def imports_of(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f'{path}: relative import'
            yield node.module
            yield from (f'{node.module}.{alias.name}' for alias in node.names)


MODULES = [
    path
    for path in sorted(PACKAGE.rglob('*.py'))
    if path.parent != PACKAGE or path.stem != '__init__'
]


@pytest.mark.parametrize('path', MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_point_down(path):
    own = path.relative_to(PACKAGE).with_suffix('').parts[0]
    for name in imports_of(path):
        parts = name.split('.')
        if parts[0] == 'mapmerge_ros' and len(parts) > 1 and parts[1] in RANK:
            lower = RANK[parts[1]] < RANK[own] or parts[1] == own
            assert lower, f'{own} may not import {name}'


@pytest.mark.parametrize('path', MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_only_nodes_and_the_demo_know_ros(path):
    relative = path.relative_to(PACKAGE)
    if relative.parts[0] == 'nodes' or relative.name == 'demo.py':
        return
    assert not ROS & {name.split('.')[0] for name in imports_of(path)}


def test_every_room_has_a_rank():
    rooms = {path.relative_to(PACKAGE).with_suffix('').parts[0] for path in MODULES}
    assert rooms <= set(RANK)
