# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Places to fly over, as values: landmarks, which way they face, what they look like."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mapmerge_ros.arrays import Bytes, Floats, Ids, Ints, frozen

DESCRIPTOR_BYTES = 32
"""ORB."""


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Landmarks of a place in the world frame [m], z up."""

    ids: Ids
    """(n,)"""
    points: Floats
    """(n, 3)"""
    normals: Floats
    """(n, 3) unit vector off the surface; zero: visible from all sides"""
    surfaces: Ints
    """(n,) number of the wall, façade or ground that it is on"""
    descriptors: Bytes
    """(n, 32) binary"""

    def __post_init__(self) -> None:
        n = len(self.ids)
        for name, dtype, shape in (
            ('ids', np.uint64, (n,)),
            ('points', np.float64, (n, 3)),
            ('normals', np.float64, (n, 3)),
            ('surfaces', np.int64, (n,)),
            ('descriptors', np.uint8, (n, DESCRIPTOR_BYTES)),
        ):
            object.__setattr__(self, name, frozen(name, getattr(self, name), dtype, shape))

    def __len__(self) -> int:
        return len(self.ids)

    def displaced(self, rows: Ints, displacement: Floats) -> Scene:
        """Return the scene after the landmarks in `rows` were moved by `displacement` (3,)."""
        points = self.points.copy()
        points[rows] += displacement
        return replace(self, points=points)

    def without(self, ids: Ids) -> Scene:
        """Return the scene without some landmarks."""
        kept = ~np.isin(self.ids, ids)
        return Scene(
            self.ids[kept],
            self.points[kept],
            self.normals[kept],
            self.surfaces[kept],
            self.descriptors[kept],
        )


def box_scene(
    rng: np.random.Generator, count: int, size: tuple[float, float, float] = (10.0, 6.0, 2.0)
) -> Scene:
    """Landmarks filling a box about the origin, visible from all sides (5.A.1 of the paper)."""
    points = (rng.random((count, 3)) - 0.5) * size
    return _scene(rng, points, np.zeros((count, 3)), np.zeros(count, np.int64))


def room_scene(
    rng: np.random.Generator,
    per_wall: int,
    size: tuple[float, float, float] = (5.0, 6.0, 2.0),
    *,
    per_corner: int = 6,
    corner_width: float = 0.5,
) -> Scene:
    """
    Four walls seen from inside, about the origin (5.A.3 of the paper).

    Surfaces 0 to 3 are the walls +x +y -x -y. Beside their `per_wall` landmarks there are
    `per_corner` within `corner_width` of each edge, on both its walls: surfaces 4 to 7, where
    4 + i is between the walls i and i + 1.
    """
    walls = [_rectangle(rng, per_wall, *_wall(i, size)) for i in range(4)]
    corners = [_corner(rng, per_corner, i, size, corner_width) for i in range(4)]
    points = np.concatenate([points for points, _ in walls + corners])
    normals = np.concatenate([normals for _, normals in walls + corners])
    counts = [per_wall] * 4 + [per_corner] * 4
    return _scene(rng, points, normals, np.repeat(np.arange(8), counts))


def yard_scene(
    rng: np.random.Generator,
    count: int,
    extent: tuple[float, float] = (60.0, 60.0),
    *,
    houses: int = 4,
    facade_ratio: float = 0.3,
) -> Scene:
    """
    Rolling ground with a few houses, about the origin: what drones see from above.

    `facade_ratio` of the `count` landmarks are on façades and roofs. Surface 0 is the ground.
    The ground goes on below the houses: nothing hides anything here.
    """
    on_houses = int(count * facade_ratio) if houses else 0
    ground = np.zeros((count - on_houses, 3))
    ground[:, :2] = (rng.random((len(ground), 2)) - 0.5) * extent
    # Waves of some decimetres: a perfectly flat ground would leave nadir views in weak geometry.
    ground[:, 2] = 0.5 * np.sin(0.21 * ground[:, 0]) * np.cos(0.17 * ground[:, 1])
    up: Floats = np.tile([0.0, 0.0, 1.0], (len(ground), 1))
    parts: list[tuple[Floats, Floats]] = [(ground, up)]
    for share in np.array_split(np.arange(on_houses), max(houses, 1)):
        parts.append(_house(rng, len(share), extent))
    surfaces = np.repeat(np.arange(len(parts)), [len(points) for points, _ in parts])
    points = np.concatenate([points for points, _ in parts])
    return _scene(rng, points, np.concatenate([normals for _, normals in parts]), surfaces)


def _scene(rng: np.random.Generator, points: Floats, normals: Floats, surfaces: Ints) -> Scene:
    descriptors = rng.integers(0, 256, (len(points), DESCRIPTOR_BYTES), dtype=np.uint8)
    ids = np.arange(1, len(points) + 1, dtype=np.uint64)
    return Scene(ids, points, normals, surfaces, descriptors)


def _rectangle(
    rng: np.random.Generator, count: int, centre: Floats, half_u: Floats, half_v: Floats
) -> tuple[Floats, Floats]:
    """Points and normals on a rectangle; the normal is half_u x half_v."""
    at = rng.uniform(-1.0, 1.0, (count, 2))
    normal = np.cross(half_u, half_v)
    points = centre + at[:, :1] * half_u + at[:, 1:] * half_v
    return points, np.tile(normal / np.linalg.norm(normal), (count, 1))


def _wall(i: int, size: tuple[float, float, float]) -> tuple[Floats, Floats, Floats]:
    """Centre and half axes of wall i (+x +y -x -y), facing inwards."""
    half = 0.5 * np.array(size)
    outward = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])[i % 2] * (1.0 if i < 2 else -1.0)
    up = np.array([0.0, 0.0, 1.0])
    return outward * half, np.cross(outward, up) * half, up * half


def _corner(
    rng: np.random.Generator,
    count: int,
    i: int,
    size: tuple[float, float, float],
    width: float,
) -> tuple[Floats, Floats]:
    """Landmarks near the edge between walls i and i + 1, half of them on each."""
    parts = []
    for wall, other, n in ((i, i + 1, count - count // 2), (i + 1, i, count // 2)):
        points, normals = _rectangle(rng, n, *_wall(wall % 4, size))
        outward = -_rectangle(rng, 1, *_wall(other % 4, size))[1][0]
        edge = float(np.abs(outward) @ np.array(size)) / 2.0 - rng.uniform(0.0, width, n)
        parts.append((points + (edge - points @ outward)[:, None] * outward, normals))
    points = np.concatenate([points for points, _ in parts])
    return points, np.concatenate([normals for _, normals in parts])


def _house(
    rng: np.random.Generator, count: int, extent: tuple[float, float]
) -> tuple[Floats, Floats]:
    """Four façades and a flat roof, somewhere inside `extent`."""
    size = np.append(rng.uniform(6.0, 10.0, 2), rng.uniform(3.0, 5.0))
    foot = (rng.random(2) - 0.5) * np.maximum(np.array(extent) - size[:2], 0.0)
    centre = np.append(foot, size[2] / 2.0)
    half, up = size / 2.0, np.array([0.0, 0.0, 1.0])
    x, y = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    faces = [(o, np.cross(up, o), up) for o in (x, y, -x, -y)] + [(up, x, y)]
    shares = [len(share) for share in np.array_split(np.arange(count), len(faces))]
    parts = [
        _rectangle(rng, n, centre + o * half, u * half, v * half)
        for n, (o, u, v) in zip(shares, faces, strict=True)
    ]
    points = np.concatenate([points for points, _ in parts])
    return points, np.concatenate([normals for _, normals in parts])
