# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Many alignments at once, each from as few candidates as its group needs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapmerge_ros.arrays import Floats, Ints, Mask
from mapmerge_ros.association.config import AssociationConfig
from mapmerge_ros.geometry import Gauge, Similarity


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
    Alignments of random minimal samples of the candidates (n, 3), best candidates first.

    Samples whose sides differ by more than a similarity (rigid motion, yaw) allows, or that are
    nearly on a line, are dropped before anything is computed from them: most of the wrong ones.
    """
    if gauge is Gauge.NONE:
        return Models(np.ones(1), np.eye(3)[None], np.zeros((1, 3)))
    rows = _draw(len(points_a), gauge.minimal_points, config)
    corners_a, corners_b = points_a[rows], points_b[rows]
    kept = np.flatnonzero(_plausible(corners_a, corners_b, gauge, points_a, points_b, config))
    kept = kept[: max(config.max_judged // len(points_a), config.min_models)]
    return _fit(corners_a[kept], corners_b[kept], gauge)


def _draw(count: int, size: int, config: AssociationConfig) -> Ints:
    """(samples, size) different rows, half of the samples from the more distinctive ones."""
    rng = np.random.default_rng(config.seed)
    uniform = rng.random((config.samples, size))
    uniform[::2] **= 2
    rows: Ints = np.minimum((uniform * count).astype(np.int64), count - 1)
    ordered = np.sort(rows, axis=1)
    drawn: Ints = rows[(ordered[:, 1:] != ordered[:, :-1]).all(axis=1)]
    return drawn


def _plausible(
    a: Floats,
    b: Floats,
    gauge: Gauge,
    points_a: Floats,
    points_b: Floats,
    config: AssociationConfig,
) -> Mask:
    """Which samples (k, size, 3) may be the same figure in both maps, and a stable one."""
    if gauge is Gauge.YAW_TRANSLATION:
        return _plausible_yaw(a, b, points_a, points_b, config)
    sides_a, sides_b = _sides(a), _sides(b)
    shortest = config.min_side_ratio
    kept = (sides_a.min(axis=1) > shortest * _extent(points_a)) & (
        sides_b.min(axis=1) > shortest * _extent(points_b)
    )
    growth = np.log(np.maximum(sides_a, 1e-300)) - np.log(np.maximum(sides_b, 1e-300))
    if gauge is Gauge.SIMILARITY:
        kept &= np.ptp(growth, axis=1) < config.max_side_disagreement
    else:
        kept &= np.abs(growth).max(axis=1) < config.max_side_disagreement
    stable: Mask = kept & (_slimness(sides_a) > config.min_triangle_height)
    return stable


def _plausible_yaw(
    a: Floats, b: Floats, points_a: Floats, points_b: Floats, config: AssociationConfig
) -> Mask:
    step_a, step_b = a[:, 1] - a[:, 0], b[:, 1] - b[:, 0]
    level_a, level_b = np.hypot(*step_a.T[:2]), np.hypot(*step_b.T[:2])
    allowed = config.max_side_disagreement * np.maximum(level_a, level_b)
    kept = level_a > config.min_side_ratio * _extent(points_a)
    kept &= level_b > config.min_side_ratio * _extent(points_b)
    kept &= np.abs(level_a - level_b) < allowed
    stable: Mask = kept & (np.abs(step_a[:, 2] - step_b[:, 2]) < allowed)
    return stable


def _sides(corners: Floats) -> Floats:
    lengths: Floats = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    return lengths


def _slimness(sides: Floats) -> Floats:
    """Height of each triangle over its longest side, from its sides (Heron)."""
    half = 0.5 * sides.sum(axis=1)
    squared = half * np.prod(half[:, None] - sides, axis=1)
    height: Floats = (
        2.0 * np.sqrt(np.maximum(squared, 0.0)) / sides.max(axis=1, initial=1e-300) ** 2
    )
    return height


def _extent(points: Floats) -> float:
    """Typical distance of the points from their middle."""
    return float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)))


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
