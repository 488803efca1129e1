# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of the compressor node."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from mapmerge_ros.geometry import Gauge
from mapmerge_ros.nodes.settings import Setting, declare
from mapmerge_ros.submap import Request

SETTINGS = (
    Setting(
        'bundle',
        '',
        'Folder of a COLMAP model, or a recording of Bundle messages; empty: they come on the '
        'topic `bundle`.',
    ),
    Setting(
        'robot_id',
        '',
        'Name of the robot, by default that of the folder; in a recording or on the topic: '
        'which robot to be, may be empty if there is only one.',
    ),
    Setting('id_space', '', 'For a model: its point3D ids mean the same in all of this name.'),
    Setting(
        'gauge',
        '7',
        'For a model: 7 monocular, 6 metric, 4 metric with z up.',
        choices=('7', '6', '4'),
    ),
    Setting(
        'max_bytes_per_s',
        0.0,
        'Bytes of sub-maps that are sent per second on average; 0: no limit.',
        0.0,
        1e9,
    ),
    Setting(
        'max_landmarks',
        0,
        'Landmarks that an answer has at most, the most wanted ones; 0: as many as are asked for.',
        0,
        2700,
    ),
    Setting(
        'max_bytes',
        0,
        'Largest sub-map that is sent as an answer, its catalogue included; fewer landmarks are '
        'compressed to keep it. 0: what the request says.',
        0,
        128 * 2**20,
    ),
    Setting(
        'relinearise_rounds',
        0,
        'Times that the map is linearised again where the fusion put its landmarks, and sent, '
        'after each answer to a request; 0: only when the service is called.',
        0,
        100,
    ),
)


@dataclass(frozen=True, slots=True)
class CompressorSettings:
    """Their values."""

    bundle: str
    robot_id: str
    id_space: str
    gauge: Gauge
    max_bytes_per_s: float
    max_landmarks: int
    max_bytes: int
    relinearise_rounds: int

    def limited(self, request: Request) -> Request:
        """Return what of a request is within the limits; 0 is none."""
        limits = [size for size in (request.max_bytes, self.max_bytes) if size]
        ids = request.landmark_ids[: self.max_landmarks or None]
        return replace(request, landmark_ids=ids, max_bytes=min(limits, default=0))


def declare_settings(node: Any) -> CompressorSettings:
    """
    Declare and read the parameters.

    Raises
    ------
    InvalidValue
        One is not within its range or choices.

    """
    values = {setting.name: declare(node, setting) for setting in SETTINGS}
    values['gauge'] = Gauge(int(values['gauge']))
    return CompressorSettings(**values)
