# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
Write docs/interfaces.md: every topic, service and parameter that the running nodes have.

Names, types and qualities are asked of the nodes themselves; the words are those of docs/node.md,
which has to have a row for each. Needs ROS, and tf2_msgs; `make interfaces` calls it.
"""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import rclpy
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

from mapmerge_ros.cli.processes import free_domain, local_environment
from mapmerge_ros.io import encode_submap, read_submaps
from mapmerge_ros.nodes.compressor_node import CompressorNode
from mapmerge_ros.nodes.frames import MISSING, TFMessage
from mapmerge_ros.nodes.fusion_node import FusionNode
from mapmerge_ros.nodes.record_node import RecordNode
from mapmerge_ros.nodes.robot_node import RobotNode

DOCS = Path(__file__).resolve().parent
PAGE = DOCS / 'interfaces.md'
RECORDING = DOCS.parent / 'bags' / 'four_drones.mcap'

EVERYWHERE = re.compile(
    r'/(rosout|parameter_events|transition_event|get_type_description|[gs]et_parameters'
    r'|(describe|list)_parameters|get_parameter_types|set_parameters_atomically'
    r'|(change|get)_state|get_(available_states|available_transitions|transition_graph))$'
)
"""What rclpy gives to every node, or every managed node."""

HEAD = """\
<!-- Made by docs/generate_interfaces.py from the running nodes: do not edit. -->

# Topics, services and parameters

What the nodes have by default, as they tell it themselves; what it means, and how it plays
together, is in [the nodes](node.md). Names that begin with `~/` are below the name of the node.
Beside these every node has the parameter `use_sim_time`, its parameter services,
`/parameter_events` and `/rosout`; the fusion node has those of a lifecycle node too.
"""


def words(node: str, name: str) -> str:
    """
    Return what docs/node.md says of a topic or service of a node.

    Raises
    ------
    LookupError
        It says nothing.

    """
    sections = re.split(r'^## ', (DOCS / 'node.md').read_text(), flags=re.M)
    section = next(part for part in sections if part.startswith(f'`{node}`'))
    for line in section.splitlines():
        cells = re.split(r'\s*(?<!\\)\|\s*', line.strip('| '))
        if line.startswith('|') and f'`{name}`' in cells[0]:
            said = re.sub(r'^(in|out)[,;:] ', '', cells[-1])
            return re.sub(r'\]\(#', '](node.md#', said)
    raise LookupError(f'docs/node.md has no row for {name} of {node}')


def short(node: Any, name: str) -> str:
    """Name of an endpoint as the documentation has it: below the node, or its namespace."""
    own = node.get_fully_qualified_name() + '/'
    if name.startswith(own):
        return f'~/{name.removeprefix(own)}'
    relative = {node.resolve_topic_name(x): x for x in ('submaps', 'submap', 'bundle', 'path')}
    relative[node.resolve_topic_name('landmarks')] = 'landmarks'
    return relative.get(name, name)


def quality(ends: Sequence[Any]) -> str:
    """Reliability and durability of the ends of a topic that belong to one node."""
    said = []
    for end in ends:
        profile = end.qos_profile
        is_reliable = profile.reliability == ReliabilityPolicy.RELIABLE
        is_latched = profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
        said.append(('reliable' if is_reliable else 'best effort') + ', latched' * is_latched)
    return '; also '.join(sorted(set(said)))


def ours(found: Sequence[tuple[str, Sequence[str]]]) -> list[tuple[str, str]]:
    """Name and type of what not every node has, in order."""
    found = [(name, types[0]) for name, types in found if not EVERYWHERE.search(name)]
    return sorted((name, re.sub('/(msg|srv)/', '/', kind)) for name, kind in found)


def topics(node: Any) -> Iterator[str]:
    """Rows of what a node publishes and subscribes to."""
    name = node.get_name()
    at = name, node.get_namespace()
    for arrow, found, ends_of in (
        (
            'in',
            node.get_subscriber_names_and_types_by_node(*at),
            node.get_subscriptions_info_by_topic,
        ),
        (
            'out',
            node.get_publisher_names_and_types_by_node(*at),
            node.get_publishers_info_by_topic,
        ),
    ):
        for topic, kind in ours(found):
            ends = [end for end in ends_of(topic) if end.node_name == name]
            called = short(node, topic)
            said = words(name, called)
            yield f'| `{called}` | {arrow} | `{kind}` | {quality(ends)} | {said} |'


def services(node: Any) -> Iterator[str]:
    """Rows of the services of a node."""
    at = node.get_name(), node.get_namespace()
    for name, kind in ours(node.get_service_names_and_types_by_node(*at)):
        called = short(node, name)
        yield f'| `{called}` | `{kind}` | {words(node.get_name(), called)} |'


def parameters(node: Any) -> Iterator[str]:
    """Rows of the parameters that a node has declared."""
    for name in sorted(node.list_parameters([], 0).names):
        if name in ('use_sim_time', 'start_type_description_service'):
            continue
        found = node.describe_parameter(name)
        limits = [*found.floating_point_range, *found.integer_range]
        bounds = ''.join(f'{_number(x.from_value)} to {_number(x.to_value)}' for x in limits)
        value = node.get_parameter(name).value
        default = str(value).lower() if isinstance(value, bool) else repr(value)
        choices, _, change = found.additional_constraints.rpartition('; ')
        allowed = bounds or choices.replace(' | ', ', ')
        when = change.removeprefix('may change ')
        said = found.description.replace('<', '&lt;')
        yield f'| `{name}` | `{default}` | {allowed} | {said} | {when} |'


def _number(value: float) -> str:
    return str(value) if isinstance(value, int) else f'{value:g}'


def section(node: Any, title: str) -> str:
    """Return what one node has; a node that only plays or records has the topics of its file."""
    tables = [
        (
            'Parameters',
            '| parameter | default | allowed | | may change |\n|---|---|---|---|---|',
            parameters(node),
        )
    ]
    if title == node.get_name():
        tables[:0] = [
            ('Topics', '| topic | | type | quality | |\n|---|---|---|---|---|', topics(node)),
            ('Services', '| service | type | |\n|---|---|---|', services(node)),
        ]
    parts = [f'## {title}']
    for kind, head, rows in tables:
        parts += [f'### {kind} of {title}', '\n'.join([head, *rows])]
    return '\n\n'.join(parts)


def page() -> str:
    """Start every node once, in this process, and return what they have."""
    os.environ.update(local_environment(free_domain()))
    rclpy.init()
    value = rclpy.Parameter
    try:
        with tempfile.TemporaryDirectory() as folder:
            output = f'{folder}/x.mcap'
            robot = [value('recording', value=str(RECORDING)), value('robot_id', value='drone0')]
            parts = [
                _section(FusionNode(), 'fusion_node'),
                _section(compressor(), 'compressor_node'),
                _section(RobotNode(parameter_overrides=robot), 'robot_node (plays a robot)'),
                _section(
                    RecordNode(parameter_overrides=[value('output', value=output)]),
                    'record_node (mapmerge record)',
                ),
            ]
    finally:
        rclpy.try_shutdown()
    text = '\n\n'.join([HEAD.rstrip(), *parts]) + '\n'
    for given in (output, str(RECORDING), 'drone0'):  # these have to be given: not defaults
        text = text.replace(f"'{given}'", "''")
    return text


def compressor() -> Any:
    """Make a robot that has sent a sub-map: before that it does not have the topic."""
    node = CompressorNode()
    submap = next(item.submap for item in read_submaps(RECORDING) if item.submap)
    node._publish(submap.map_id, encode_submap(submap))
    return node


def _section(node: Any, title: str) -> str:
    with closing(node):
        text = section(node, title)
    node.destroy_node()
    return text


if __name__ == '__main__':
    if TFMessage is None:
        raise SystemExit(MISSING)
    PAGE.write_text(page())
