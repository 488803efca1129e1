# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of the fusion node: all with a default, a description and a range."""

from __future__ import annotations

import re
from dataclasses import dataclass

from mapmerge_ros.fusion import FusionConfig
from mapmerge_ros.nodes.settings import Change, Setting

CONFIG = FusionConfig()

NODE_SETTINGS = (
    Setting(
        'autostart',
        True,
        'Whether the node configures and activates itself; false: a lifecycle manager does.',
    ),
    Setting(
        'merge_period',
        1.0,
        'Seconds of node time between merges.',
        0.01,
        3600.0,
        change=Change.ALWAYS,
    ),
    Setting(
        'discovery_pattern',
        '.*/submap$',
        'Regular expression; topics of type SubMap whose whole name matches are subscribed to. '
        'A node in a namespace looks only below it by default.',
        change=Change.UNCONFIGURED,
        is_pattern=True,
    ),
    Setting(
        'depth',
        200,
        'Messages of a topic that may wait to be read.',
        1,
        100_000,
        change=Change.UNCONFIGURED,
    ),
    Setting(
        'reliability',
        'auto',
        'Demanded of publishers; auto: the best that all publishers of a topic offer.',
        choices=('auto', 'reliable', 'best_effort'),
        change=Change.UNCONFIGURED,
    ),
    Setting(
        'durability',
        'auto',
        'Demanded of publishers; auto: the best that all publishers of a topic offer.',
        choices=('auto', 'transient_local', 'volatile'),
        change=Change.UNCONFIGURED,
    ),
    Setting(
        'robot_timeout',
        0.0,
        'Seconds of node time without a message or a publisher after which a robot counts as '
        'stale in the diagnostics; its maps stay. 0: never.',
        0.0,
        86_400.0,
        change=Change.ALWAYS,
    ),
    Setting(
        'publish_tf',
        True,
        'Whether the frames of merged sub-maps are sent on /tf_static, below the global frame.',
        change=Change.UNCONFIGURED,
    ),
    Setting(
        'max_ellipsoids',
        100,
        'Landmarks whose uncertainty is drawn in ~/markers, the least certain ones first.',
        0,
        10_000,
        change=Change.ALWAYS,
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
        'convergence',
        CONFIG.convergence,
        'Standard deviations from the optimum, in the worst direction, at which a merge ends.',
        1e-6,
        0.01,
    ),
    Setting(
        'max_landmarks',
        CONFIG.max_landmarks,
        'Landmarks that the global map stays compressed to.',
        3,
        2700,
    ),
    Setting(
        'max_bytes',
        CONFIG.max_bytes,
        'Largest global map that is sent; fewer landmarks stay compressed to keep it, and the '
        'catalogue goes along if it leaves half of the bytes to them; 0: no limit.',
        0,
        128 * 2**20,
    ),
    Setting(
        'catalogue',
        CONFIG.catalogue,
        'Whether the global map carries the other landmarks, position and descriptor only.',
    ),
    Setting(
        'unlock',
        CONFIG.unlock,
        'Whether landmarks that moved or do not fit are taken out, and the rest is merged without '
        'them.',
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
        0,
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
    robot_timeout: float
    """[s] of node time; 0 = never"""
    publish_tf: bool
    max_ellipsoids: int


FIXED_CONFIG = frozenset({'map_id', 'global_frame'})
"""Of the engine's parameters those that others know it by: they stay while it is configured."""
