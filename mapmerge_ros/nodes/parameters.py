# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of the fusion node: all with a default, a description and a range."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor

from mapmerge_ros.errors import InvalidValue
from mapmerge_ros.fusion import FusionConfig

Value = bool | int | float | str

CONFIG = FusionConfig()


@dataclass(frozen=True, slots=True)
class Setting:
    """A parameter of a node; its type is that of the default."""

    name: str
    default: Value
    description: str
    low: float = 0.0
    high: float = 0.0
    """Range of a number; low = high = 0 is none"""
    choices: tuple[str, ...] = ()
    """Allowed texts; none = any"""


NODE_SETTINGS = (
    Setting('merge_period', 1.0, 'Seconds of node time between merges.', 0.01, 3600.0),
    Setting(
        'discovery_pattern',
        '.*/submap$',
        'Regular expression; topics of type SubMap whose whole name matches are subscribed to.',
    ),
    Setting('depth', 200, 'Messages of a topic that may wait to be read.', 1, 100_000),
    Setting(
        'reliability',
        'auto',
        'Demanded of publishers; auto: the best that all publishers of a topic offer.',
        choices=('auto', 'reliable', 'best_effort'),
    ),
    Setting(
        'durability',
        'auto',
        'Demanded of publishers; auto: the best that all publishers of a topic offer.',
        choices=('auto', 'transient_local', 'volatile'),
    ),
)

CONFIG_SETTINGS = (
    Setting('map_id', '', 'Name of the global map; default: <name of this node>/global.'),
    Setting('global_frame', CONFIG.global_frame, 'frame_id of the global map.'),
    Setting(
        'min_shared',
        CONFIG.min_shared,
        'Landmarks that two sub-maps must share to be joined directly.',
        3,
        1000,
    ),
    Setting(
        'contradiction_ratio',
        CONFIG.contradiction_ratio,
        'Times the median distance of a pair, in standard deviations, from which on equal ids '
        'are not the same point.',
        1.0,
        1e6,
    ),
    Setting(
        'contradiction_extent',
        CONFIG.contradiction_extent,
        "Share of the common area's size which that distance must have as well.",
        1e-6,
        1e3,
    ),
    Setting(
        'significance',
        CONFIG.significance,
        'p-value below which a merge is not believed.',
        1e-12,
        0.5,
    ),
    Setting('max_iterations', CONFIG.max_iterations, 'Gauss-Newton steps of a merge.', 1, 10_000),
    Setting(
        'max_starts',
        CONFIG.max_starts,
        'Starts of a merge whose rotations are weakly determined.',
        1,
        1000,
    ),
    Setting(
        'relative_decrease',
        CONFIG.relative_decrease,
        'Share of the cost: a merge that promises to gain less has converged.',
        1e-16,
        0.1,
    ),
    Setting(
        'max_landmarks',
        CONFIG.max_landmarks,
        'Landmarks that the global map stays compressed to.',
        3,
        2700,
    ),
    Setting(
        'catalogue',
        CONFIG.catalogue,
        'Whether the global map carries the other landmarks, position and descriptor only.',
    ),
    Setting(
        'match_descriptors',
        CONFIG.match_descriptors,
        'Whether landmarks without a common id space are matched by descriptors and geometry.',
    ),
    Setting(
        'ask',
        CONFIG.ask,
        'Whether robots are asked to compress the landmarks that other sub-maps have too.',
    ),
    Setting(
        'request_landmarks',
        CONFIG.request_landmarks,
        'Landmarks that one sub-map is asked for at most.',
        3,
        2700,
    ),
    Setting(
        'request_bytes',
        CONFIG.request_bytes,
        'Largest message that a robot may answer with, its catalogue included; 0: no limit.',
        -1,
        128 * 2**20,
    ),
    Setting(
        'request_coverage',
        CONFIG.request_coverage,
        'Share of what a pair of sub-maps could have in common that is enough not to ask again.',
        0.01,
        1.0,
    ),
    Setting(
        'request_period',
        CONFIG.request_period,
        'Seconds of node time until a request without an answer is repeated; then doubled.',
        0.01,
        3600.0,
    ),
)


@dataclass(frozen=True, slots=True)
class NodeSettings:
    """Parameters that are about topics and time, not about the merge."""

    merge_period: float
    """[s] of node time"""
    discovery_pattern: re.Pattern[str]
    depth: int
    reliability: str
    durability: str


def declare_settings(node: Any) -> NodeSettings:
    """
    Declare and read the parameters about topics and time.

    Raises
    ------
    InvalidValue
        A value that its descriptor cannot exclude by itself.

    """
    values = {setting.name: declare(node, setting) for setting in NODE_SETTINGS}
    try:
        values['discovery_pattern'] = re.compile(values['discovery_pattern'])
    except re.error as err:
        raise InvalidValue(f'discovery_pattern: not a regular expression: {err}') from err
    return NodeSettings(**values)


def declare_config(node: Any) -> FusionConfig:
    """Declare and read the parameters of the engine."""
    own_map_id = f'{node.get_fully_qualified_name()[1:]}/global'
    first, *others = CONFIG_SETTINGS
    settings = (replace(first, default=own_map_id), *others)
    return FusionConfig(**{setting.name: declare(node, setting) for setting in settings})


def declare(node: Any, setting: Setting) -> Any:
    """
    Declare one parameter and return its value, of the type of its default.

    Raises
    ------
    InvalidValue
        It is of another type, out of its range, or none of its choices.

    """
    value: Any = node.declare_parameter(setting.name, setting.default, _descriptor(setting)).value
    wanted = type(setting.default)
    if wanted is float and type(value) is int:
        value = float(value)
    matches = type(value) is wanted  # bool is an int to isinstance
    if not matches:
        raise InvalidValue(f'{setting.name}: {value!r} is not of type {wanted.__name__}')
    if setting.low != setting.high and not setting.low <= value <= setting.high:
        raise InvalidValue(
            f'{setting.name}: {value} is not between {setting.low:g} and {setting.high:g}'
        )
    if setting.choices and value not in setting.choices:
        raise InvalidValue(f'{setting.name}: {value!r} is none of {", ".join(setting.choices)}')
    return value


def _descriptor(setting: Setting) -> Any:
    descriptor = ParameterDescriptor(
        description=setting.description,
        additional_constraints=' | '.join(setting.choices),
        read_only=True,
        # `-p merge_period:=2` is an integer to the parser: it is converted, not refused.
        dynamic_typing=isinstance(setting.default, float),
    )
    if setting.low == setting.high:
        return descriptor
    if isinstance(setting.default, float):
        descriptor.floating_point_range = [
            FloatingPointRange(from_value=float(setting.low), to_value=float(setting.high))
        ]
    else:
        descriptor.integer_range = [
            IntegerRange(from_value=int(setting.low), to_value=int(setting.high), step=1)
        ]
    return descriptor
