# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Many alignments at once, each from as few candidates as its group needs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from math import comb

import numpy as np

from mapmerge_ros.arrays import Floats, Ints, Mask
from mapmerge_ros.association.config import AssociationConfig
from mapmerge_ros.geometry import Gauge, Similarity, scene_radius


@dataclass(frozen=True, slots=True, eq=False)
class Models:
    """m similarities S_a_b."""

    scales: Floats
    """(m,)"""
    rotations: Floats
    """(m, 3, 3)"""
    translations: Floats
    """(m, 3)"""

    def __len__(self) -> int:
        return len(self.scales)

    def __getitem__(self, rows: Ints) -> Models:
        return Models(self.scales[rows], self.rotations[rows], self.translations[rows])

    def one(self, row: int) -> Similarity:
        """Return one of them as a value."""
        return Similarity(float(self.scales[row]), self.rotations[row], self.translations[row])

    def distances(self, points_a: Floats, points_b: Floats) -> Floats:
        """(m, n) distance of every a from its transformed b, units of a."""
        linear = (self.scales[:, None, None] * self.rotations).reshape(-1, 3)
        moved = (linear @ points_b.T).reshape(len(self), 3, -1) + self.translations[:, :, None]
        moved -= points_a.T
        squared: Floats = np.einsum('mdn,mdn->mn', moved, moved)
        return np.sqrt(squared, out=squared)


def sampled_models(
    points_a: Floats, points_b: Floats, gauge: Gauge, config: AssociationConfig
) -> Models:
    """
    Alignments of minimal samples of the candidates (n, 3): all samples of few, else random ones.

    Samples whose sides differ by more than a similarity (rigid motion, yaw) allows, or that are
    nearly on a line, are dropped before anything is computed from them: most of the wrong ones.
    """
    if gauge is Gauge.NONE:
        return Models(np.ones(1), np.eye(3)[None], np.zeros((1, 3)))
    rows = _draw(len(points_a), gauge.minimal_points, config)
    if gauge is Gauge.YAW_TRANSLATION:
        kept = _plausible_pairs(points_a, points_b, rows, config)
    else:
        kept = _plausible_triangles(points_a, points_b, rows, gauge, config)
    chosen = rows[kept][: max(config.max_judged // len(points_a), config.min_models)]
    return _fit(points_a[chosen], points_b[chosen], gauge)


def _draw(count: int, size: int, config: AssociationConfig) -> Ints:
    """(samples, size) different rows; the more distinctive candidates first, or more often."""
    if comb(count, size) <= config.samples:
        return _all_samples(count, size)
    uniform = np.random.default_rng(config.seed).random((size, config.samples))
    uniform[:, ::2] **= 2
    rows: Ints = np.minimum((uniform * count).astype(np.int64), count - 1)
    different = np.ones(config.samples, bool)
    for i, j in combinations(range(size), 2):
        different &= rows[i] != rows[j]
    drawn: Ints = rows[:, different].T
    return drawn


@lru_cache(maxsize=256)
def _all_samples(count: int, size: int) -> Ints:
    """Every set of `size` of `count` rows, those of small numbers first."""
    rows = np.array(list(combinations(range(count), size)), np.int64).reshape(-1, size)
    ordered: Ints = rows[np.argsort(rows.sum(axis=1), kind='stable')]
    ordered.flags.writeable = False
    return ordered


def _plausible_triangles(
    points_a: Floats, points_b: Floats, rows: Ints, gauge: Gauge, config: AssociationConfig
) -> Mask:
    """Which triangles may be the same figure in both maps, and a stable one."""
    sides_a, sides_b = _sides(points_a, rows), _sides(points_b, rows)
    growth = sides_a - sides_b
    most, least = _extremes(growth)
    if gauge is Gauge.SIMILARITY:
        alike = most - least < config.max_side_disagreement
    else:
        alike = (most < config.max_side_disagreement) & (-least < config.max_side_disagreement)
    chosen = np.flatnonzero(alike)
    longest, shortest = _extremes(sides_a[:, chosen])
    shortest_b = _extremes(sides_b[:, chosen])[1]
    stable = shortest > np.log(config.min_side_ratio * _extent(points_a))
    stable &= shortest_b > np.log(config.min_side_ratio * _extent(points_b))
    stable &= _height_ratio(np.exp(sides_a[:, chosen] - longest)) > config.min_triangle_height
    kept = np.zeros(len(rows), bool)
    kept[chosen[stable]] = True
    return kept


def _sides(points: Floats, rows: Ints) -> Floats:
    """(3, k) logarithms of the sides of triangles."""
    apart = points[:, None] - points
    logs = 0.5 * np.log(np.einsum('ijk,ijk->ij', apart, apart) + np.finfo(float).tiny).ravel()
    first, second, third = rows.T
    count = len(points)
    at = np.stack([first * count + second, second * count + third, third * count + first])
    sides: Floats = logs[at]
    return sides


def _extremes(sides: Floats) -> tuple[Floats, Floats]:
    """Largest and smallest of three rows."""
    first, second, third = sides
    most: Floats = np.maximum(np.maximum(first, second), third)
    least: Floats = np.minimum(np.minimum(first, second), third)
    return most, least


def _height_ratio(sides: Floats) -> Floats:
    """Height (k,) of triangles whose longest side is 1, from their sides (3, k) by Heron."""
    half = 0.5 * (sides[0] + sides[1] + sides[2])
    squared = half * (half - sides[0]) * (half - sides[1]) * (half - sides[2])
    height: Floats = 2.0 * np.sqrt(np.maximum(squared, 0.0))
    return height


def _plausible_pairs(
    points_a: Floats, points_b: Floats, rows: Ints, config: AssociationConfig
) -> Mask:
    """Which pairs have the same horizontal and vertical distance in both maps."""
    step_a, step_b = (p[rows[:, 1]] - p[rows[:, 0]] for p in (points_a, points_b))
    level_a, level_b = np.hypot(*step_a.T[:2]), np.hypot(*step_b.T[:2])
    allowed = config.max_side_disagreement * np.maximum(level_a, level_b)
    kept = level_a > config.min_side_ratio * _extent(points_a)
    kept &= level_b > config.min_side_ratio * _extent(points_b)
    kept &= np.abs(level_a - level_b) < allowed
    stable: Mask = kept & (np.abs(step_a[:, 2] - step_b[:, 2]) < allowed)
    return stable


def _extent(points: Floats) -> float:
    """Typical distance of the points from their middle."""
    return max(scene_radius(points), np.finfo(float).tiny)


def _fit(a: Floats, b: Floats, gauge: Gauge) -> Models:
    """Least-squares alignment of every sample (k, size, 3)."""
    mean_a, mean_b = a.mean(axis=1), b.mean(axis=1)
    centred_a, centred_b = a - mean_a[:, None], b - mean_b[:, None]
    correlation = np.einsum('kpi,kpj->kij', centred_a, centred_b)
    if gauge is Gauge.YAW_TRANSLATION:
        rotations = _yaws(correlation)
    else:
        left, _, right = np.linalg.svd(correlation)
        left[:, :, 2] *= (np.linalg.det(left) * np.linalg.det(right))[:, None]
        rotations = left @ right
    scales = np.ones(len(a))
    if gauge is Gauge.SIMILARITY:
        scales = np.sqrt(np.sum(centred_a**2, axis=(1, 2)) / np.sum(centred_b**2, axis=(1, 2)))
    moved = np.einsum('kij,kj->ki', rotations, mean_b)
    return Models(scales, rotations, mean_a - scales[:, None] * moved)


def _yaws(correlation: Floats) -> Floats:
    angle = np.arctan2(
        correlation[:, 1, 0] - correlation[:, 0, 1], correlation[:, 0, 0] + correlation[:, 1, 1]
    )
    rotations = np.zeros((len(angle), 3, 3))
    rotations[:, 0, 0] = rotations[:, 1, 1] = np.cos(angle)
    rotations[:, 1, 0] = np.sin(angle)
    rotations[:, 0, 1] = -rotations[:, 1, 0]
    rotations[:, 2, 2] = 1.0
    return rotations
