# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Closed-form alignment of corresponding points (Procrustes) in the group of a gauge."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from mapmerge_ros.arrays import Floats
from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.geometry.gauge import Gauge
from mapmerge_ros.geometry.similarity import Similarity

COLLINEAR_RATIO = 1e-6
"""Second over first singular spread below which a rotation is undetermined: float noise."""

Scale = Literal['least_squares', 'tangent']


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """A transform with its evidence."""

    S_target_source: Similarity
    rms: float
    """Weighted root mean square distance after the alignment, target units."""
    spread_ratio: float
    """How far the points are from a line: 0 = collinear, 1 = spread alike in two directions."""


def align(
    target: Floats,
    source: Floats,
    *,
    gauge: Gauge = Gauge.SIMILARITY,
    weights: Floats | None = None,
    scale: Scale = 'least_squares',
) -> Alignment:
    """
    Transform of the group of `gauge` that takes `source` (n, 3) to `target` (n, 3).

    Minimises the weighted squared distances (Umeyama 1991). With `scale='tangent'` the scale
    is the one for which the remaining displacement has no component along the growth of
    `target`: the hard gauge constraint N'W(S x - y) = 0, which for translation and rotation
    is the same equation as least squares.

    Raises
    ------
    DegenerateGeometry
        Fewer points than the group needs, or all on a line (on a point for yaw).

    """
    if len(target) < gauge.minimal_points:
        raise DegenerateGeometry(
            f'{len(target)} points do not determine a transform with {int(gauge)} parameters'
        )
    if weights is None:
        weights = np.ones(len(target))
    weights = weights / weights.sum() if len(weights) else weights
    if gauge is Gauge.NONE:
        return _evaluate(Similarity.identity(), target, source, weights, 1.0)
    target_mean, source_mean = weights @ target, weights @ source
    centred_target, centred_source = target - target_mean, source - source_mean
    correlation = (weights[:, None] * centred_target).T @ centred_source
    if gauge is Gauge.YAW_TRANSLATION:
        rotation, spread = _best_yaw(correlation, centred_target, centred_source, weights)
    else:
        rotation, spread = _best_rotation(correlation)
    factor = 1.0
    if gauge is Gauge.SIMILARITY:
        overlap = float(np.sum(rotation * correlation))
        if scale == 'tangent':
            factor = float(weights @ np.sum(centred_target**2, axis=1)) / overlap
        else:
            factor = overlap / float(weights @ np.sum(centred_source**2, axis=1))
    S_target_source = Similarity(factor, rotation, target_mean - factor * rotation @ source_mean)
    return _evaluate(S_target_source, target, source, weights, spread)


def align_robustly(
    target: Floats, source: Floats, *, gauge: Gauge, weights: Floats, steps: int = 15
) -> Alignment:
    """
    Alignment that minimises weighted distances, not their squares (iterated reweighting).

    A minority of wrong correspondences does not move it. Parameters and errors as in `align`.
    """
    found = align(target, source, gauge=gauge, weights=weights)
    for _ in range(steps):
        distances = np.linalg.norm(found.S_target_source.apply(source) - target, axis=1)
        floor = np.maximum(0.1 * np.median(distances), np.finfo(float).tiny)
        robust = weights / np.maximum(distances, floor)
        found = align(target, source, gauge=gauge, weights=robust)
    return found


def _evaluate(
    S_target_source: Similarity,
    target: Floats,
    source: Floats,
    weights: Floats,
    spread: float,
) -> Alignment:
    distances = S_target_source.apply(source) - target
    rms = float(np.sqrt(weights @ np.sum(distances**2, axis=1))) if len(target) else 0.0
    return Alignment(S_target_source, rms, spread)


def _best_rotation(correlation: Floats) -> tuple[Floats, float]:
    """Rotation R maximising tr(R' correlation), and how well it is determined."""
    left, spreads, right = np.linalg.svd(correlation)
    spread = float(spreads[1] / spreads[0]) if spreads[0] > 0.0 else 0.0
    if spread < COLLINEAR_RATIO:
        raise DegenerateGeometry('the common points lie on a line: rotation undetermined')
    handed = np.diag([1.0, 1.0, np.linalg.det(left) * np.linalg.det(right)])
    return left @ handed @ right, spread


def _best_yaw(
    correlation: Floats, target: Floats, source: Floats, weights: Floats
) -> tuple[Floats, float]:
    """Rotation about z maximising tr(R' correlation), and how well it is determined."""
    sine = correlation[1, 0] - correlation[0, 1]
    cosine = correlation[0, 0] + correlation[1, 1]
    extent = np.sqrt((weights @ np.sum(target**2, axis=1)) * (weights @ np.sum(source**2, axis=1)))
    spread = float(np.hypot(sine, cosine) / extent) if extent > 0.0 else 0.0
    if spread < COLLINEAR_RATIO:
        raise DegenerateGeometry('the common points lie on a vertical line: yaw undetermined')
    c, s = np.array([cosine, sine]) / np.hypot(sine, cosine)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), spread
