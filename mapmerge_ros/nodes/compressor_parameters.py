# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of the compressor node."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mapmerge_ros.geometry import Gauge
from mapmerge_ros.nodes.settings import Setting, declare

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
    relinearise_rounds: int


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
