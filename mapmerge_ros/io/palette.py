# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Colours of sub-maps, the same in the report and in the point cloud."""

from __future__ import annotations

import colorsys
from collections.abc import Iterable, Mapping

Rgb = tuple[int, int, int]

SHARED: Rgb = (96, 100, 108)
"""Points that several sub-maps have: grey is seen on black as on white."""

# Okabe and Ito, told apart by colour-blind readers too; without their black and yellow.
_FIRST: tuple[Rgb, ...] = (
    (0, 114, 178),
    (230, 120, 0),
    (0, 158, 115),
    (204, 85, 160),
    (86, 180, 233),
    (213, 50, 0),
    (130, 90, 200),
    (150, 140, 20),
)
_GOLDEN_RATIO = 0.618033988749895


def colours(count: int) -> tuple[Rgb, ...]:
    """Colours of `count` sub-maps in their order."""
    return (*_FIRST, *map(_spread, range(count - len(_FIRST))))[:count]


def robot_colours(robot_ids: Iterable[str]) -> dict[str, Rgb]:
    """Colour of every robot by its name: the same for the same robots."""
    robots = sorted(set(robot_ids))
    return dict(zip(robots, colours(len(robots)), strict=True))


def map_colours(robots: Mapping[str, str]) -> dict[str, Rgb]:
    """
    Colour of every sub-map: that of its robot, or its own where there is one robot only.

    `robots` is the robot of every sub-map, both by name.
    """
    by_robot = robot_colours(robots.values())
    if len(by_robot) == 1:
        return robot_colours(robots)
    return {map_id: by_robot[robot] for map_id, robot in robots.items()}


def _spread(k: int) -> Rgb:
    """Any number of hues, neighbours in number far apart in hue."""
    red, green, blue = colorsys.hls_to_rgb((k * _GOLDEN_RATIO) % 1.0, 0.45, 0.6)
    return round(255 * red), round(255 * green), round(255 * blue)


def hexadecimal(colour: Rgb) -> str:
    """Colour as `#rrggbb`."""
    return '#{:02x}{:02x}{:02x}'.format(*colour)
