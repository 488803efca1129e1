# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Configuration, launch files and layouts say what the nodes do."""

from __future__ import annotations

import importlib.util
import json
import re
import sys
import types
import xml.etree.ElementTree as Xml
from pathlib import Path
from typing import Any

import pytest

REMEDY = 'needs ROS: pip install .[ros] ./msg_schemas'
yaml = pytest.importorskip('yaml', reason=REMEDY)
pytest.importorskip('rclpy', reason=REMEDY)

from mapmerge_ros.nodes import compressor_parameters  # noqa: E402
from mapmerge_ros.nodes.live_parameters import own_settings  # noqa: E402

ROOT = Path(__file__).parents[1]
GIVEN = re.compile(
    r'~/(describe|get|list|set)_parameter(s|_types|s_atomically)|~/get_type_description'
    r'|~/(change|get)_state|~/get_(available_states|available_transitions|transition_graph)'
)
"""Services that rclpy gives to a node."""
OWN = {'map_id', 'discovery_pattern'}
"""Their defaults are made of the name of the node."""


def parameters(name: str) -> dict[str, Any]:
    found = yaml.safe_load((ROOT / 'config' / name).read_text())
    return dict(found['/**']['ros__parameters'])


@pytest.mark.parametrize(
    ('name', 'settings'),
    [
        ('fusion.yaml', [x for x in own_settings('/', 'fusion_node') if x.name not in OWN]),
        ('compressor.yaml', compressor_parameters.SETTINGS),
    ],
)
def test_every_parameter_is_in_its_file_with_its_default(name: str, settings: Any) -> None:
    assert parameters(name) == {setting.name: setting.default for setting in settings}
    text = (ROOT / 'config' / name).read_text()
    assert all(f' {setting.name}:' in text for setting in settings)


def test_qualities_are_those_that_rosbag2_reads() -> None:
    overrides = yaml.safe_load((ROOT / 'config' / 'qos_overrides.yaml').read_text())
    assert {'/submaps', '/fusion_node/global_map', '/fusion_node/requests'} <= set(overrides)
    for profile in overrides.values():
        assert set(profile) == {'history', 'depth', 'reliability', 'durability'}


def test_layouts_show_the_topics_of_the_node() -> None:
    topics = ('/fusion_node/points', '/fusion_node/markers')
    rviz = yaml.safe_load((ROOT / 'rviz' / 'fusion.rviz').read_text())
    displays = rviz['Visualization Manager']['Displays']
    shown = {item['Topic']['Value'] for item in displays if 'Topic' in item}
    assert set(topics) <= shown
    assert rviz['Visualization Manager']['Global Options']['Fixed Frame'] == 'global'
    for item in displays:
        if 'Topic' in item:
            assert item['Topic']['Durability Policy'] == 'Transient Local'
    layout = json.loads((ROOT / 'rviz' / 'fusion.foxglove.json').read_text())
    assert set(topics) <= set(layout['configById']['3D!fusion']['topics'])
    panels = set(layout['configById'])
    assert panels == set(leaves_of(layout['layout']))


def leaves_of(tree: Any) -> list[str]:
    if isinstance(tree, str):
        return [tree]
    return [*leaves_of(tree['first']), *leaves_of(tree['second'])]


def test_the_security_policy_allows_what_the_nodes_have_and_no_more() -> None:
    page = (ROOT / 'docs' / 'interfaces.md').read_text()
    every = {'/rosout', '/parameter_events', '/clock', '~/transition_event'}
    profiles = list(Xml.parse(ROOT / 'config' / 'sros2_policy.xml').getroot().iter('profile'))
    assert {profile.get('node') for profile in profiles} == {'fusion_node', 'compressor_node'}
    for profile in profiles:
        start = page.index(f'### Topics of {profile.get("node")}')
        part = page[start : page.index('### Parameters', start)]
        rows = set(re.findall(r'^\| `([^`]+)` \|', part, re.M))
        allowed = {x.text or '' for kind in ('topic', 'service') for x in profile.iter(kind)}
        robots = {name for name in allowed if re.fullmatch(r'/drone\d/submap', name)}
        assert rows == {name for name in allowed - every - robots if not GIVEN.fullmatch(name)}


def test_what_is_imported_is_declared() -> None:
    declared = {x.text for x in Xml.parse(ROOT / 'package.xml').getroot().iter('exec_depend')}
    for package in ('lifecycle_msgs', 'nav_msgs', 'sensor_msgs', 'tf2_msgs', 'std_srvs'):
        assert package in declared


class Stub:
    """Stands for any action or substitution of launch; keeps what it was made of."""

    def __init__(self, *arguments: Any, **values: Any) -> None:
        self.arguments, self.values = arguments, values

    def perform(self, context: Any) -> str:
        return str(context.get(str(self.arguments[0]), 'a/path'))


def launched(name: str, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The module of a launch file; where launch is not installed, with stubs for its classes."""
    names = {
        'launch': ('LaunchDescription',),
        'launch.actions': ('DeclareLaunchArgument', 'ExecuteProcess', 'OpaqueFunction'),
        'launch.conditions': ('IfCondition',),
        'launch.substitutions': ('LaunchConfiguration', 'PathJoinSubstitution'),
        'launch_ros': (),
        'launch_ros.actions': ('Node',),
        'launch_ros.parameter_descriptions': ('ParameterValue',),
        'launch_ros.substitutions': ('FindPackageShare',),
    }
    for module, classes in names.items():
        stub = types.ModuleType(module)
        for item in classes:
            setattr(stub, item, type(item, (Stub,), {}))
        monkeypatch.setitem(sys.modules, module, stub)
    spec = importlib.util.spec_from_file_location('launched', ROOT / 'launch' / name)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_launch_starts_what_its_arguments_say(monkeypatch: pytest.MonkeyPatch) -> None:
    module = launched('fusion.launch.py', monkeypatch)
    (entities,) = module.generate_launch_description().arguments
    declared = {x.arguments[0] for x in entities if type(x).__name__ == 'DeclareLaunchArgument'}
    assert {'bag', 'robots', 'rviz', 'namespace', 'config'} <= declared
    bag = {'bag': 'x.mcap', 'robots': '', 'rate': '2.0'}
    (play,) = module.players(bag)
    assert play.values['cmd'][:4] == ['ros2', 'bag', 'play', 'x.mcap']
    assert module.fusion(bag)[0].values['parameters'][1]['use_sim_time']
    both = {**bag, 'robots': 'drone0, drone1'}
    robots = module.players(both)
    assert [x.values['parameters'][0]['robot_id'] for x in robots] == ['drone0', 'drone1']
    assert not module.fusion(both)[0].values['parameters'][1]['use_sim_time']
    assert module.players({'bag': '', 'robots': '', 'rate': '1.0'}) == []


def test_two_fleets_share_no_name(monkeypatch: pytest.MonkeyPatch) -> None:
    module = launched('two_fleets.launch.py', monkeypatch)
    (nodes,) = module.generate_launch_description().arguments
    spaces = [node.values['namespace'] for node in nodes]
    assert sorted(spaces) == ['blue', 'blue/drone0', 'red', 'red/drone0']
