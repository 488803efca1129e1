# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Many alignments at once: `align` for every segment of stacked points."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mapmerge_ros.arrays import Floats, Ints, Mask
from mapmerge_ros.geometry.alignment import COLLINEAR_RATIO, Scale
from mapmerge_ros.geometry.gauge import Gauge
from mapmerge_ros.geometry.similarity import Similarity


@dataclass(frozen=True, slots=True, eq=False)
class Segments:
    """Rows that belong together: segment k is the rows from ends[k] to ends[k + 1]."""

    ends: Ints
    """(n + 1,) ascending from 0; no segment is empty"""
    owners: Ints = field(init=False)
    """(rows,) segment of each row"""

    def __post_init__(self) -> None:
        owners = np.repeat(np.arange(len(self)), self.lengths)
        object.__setattr__(self, 'owners', owners)

    @classmethod
    def of_lengths(cls, lengths: Ints | list[int]) -> Segments:
        """Segments (n,) of given lengths."""
        return cls(np.concatenate([[0], np.cumsum(lengths, dtype=np.int64)]))

    def __len__(self) -> int:
        return len(self.ends) - 1

    @property
    def lengths(self) -> Ints:
        """Rows of each segment (n,)."""
        return np.diff(self.ends)

    def rows(self, k: int) -> slice:
        """Rows of one segment."""
        return slice(int(self.ends[k]), int(self.ends[k + 1]))

    def only(self, chosen: Mask) -> Segments:
        """Some of them (n,), their rows without those of the others."""
        return Segments.of_lengths(self.lengths[chosen])

    def sums(self, values: Floats) -> Floats:
        """Sum over each segment, (rows, ...) to (n, ...)."""
        return np.asarray(np.add.reduceat(values, self.ends[:-1], axis=0))

    def counts(self, chosen: Mask) -> Ints:
        """How many rows of each segment are chosen, (n,)."""
        return np.asarray(np.add.reduceat(chosen.astype(np.int64), self.ends[:-1]))

    def products(self, left: Floats, right: Floats) -> Floats:
        """A'B of each segment, from its rows of (rows, 3, a) and (rows, 3, b): (n, a, b)."""
        a, b = left.shape[2], right.shape[2]
        products = np.empty((len(self), a, b))
        for k in range(len(self)):
            rows = self.rows(k)
            products[k] = left[rows].reshape(-1, a).T @ right[rows].reshape(-1, b)
        return products

    def medians(self, values: Floats) -> Floats:
        """Median (n,) of the values (rows,) of each segment."""
        ordered = self._ordered(values)
        low = self.ends[:-1] + (self.lengths - 1) // 2
        high = self.ends[:-1] + self.lengths // 2
        medians: Floats = 0.5 * (ordered[low] + ordered[high])
        return medians

    def lower_quartiles(self, values: Floats) -> Floats:
        """Value (n,) that a quarter of the values (rows,) of each segment do not exceed."""
        return np.asarray(self._ordered(values)[self.ends[:-1] + (self.lengths - 1) // 4])

    def _ordered(self, values: Floats) -> Floats:
        """Values (rows,), ascending within each segment."""
        ascending = np.argsort(values)
        # A stable sort of few bits is by radix, and takes no comparisons.
        few = np.min_scalar_type(len(self))
        by_segment = np.argsort(self.owners[ascending].astype(few), kind='stable')
        ordered: Floats = values[ascending[by_segment]]
        return ordered


@dataclass(frozen=True, slots=True, eq=False)
class Similarities:
    """Transforms S_target_source, one per segment."""

    scales: Floats
    """(n,)"""
    rotations: Floats
    """(n, 3, 3)"""
    translations: Floats
    """(n, 3)"""

    @classmethod
    def of(cls, each: list[Similarity]) -> Similarities:
        """Stack transforms."""
        return cls(
            np.array([S.scale for S in each]),
            np.array([S.rotation for S in each]).reshape(-1, 3, 3),
            np.array([S.translation for S in each]).reshape(-1, 3),
        )

    def __getitem__(self, k: int) -> Similarity:
        return Similarity(float(self.scales[k]), self.rotations[k], self.translations[k])

    def linear(self) -> Floats:
        """Scaled rotations (n, 3, 3)."""
        linear: Floats = self.scales[:, None, None] * self.rotations
        return linear

    def inverse(self) -> Similarities:
        """S_source_target of each."""
        backwards = self.rotations.transpose(0, 2, 1)
        scales = 1.0 / self.scales
        moved = (backwards @ self.translations[:, :, None])[:, :, 0]
        return Similarities(scales, backwards, -scales[:, None] * moved)

    def apply(self, segments: Segments, points: Floats) -> Floats:
        """Points (rows, 3) of each source frame into its target frame."""
        owners = segments.owners
        moved: Floats = np.einsum('mij,mj->mi', self.linear()[owners], points)
        moved += self.translations[owners]
        return moved

    def at(self, places: Ints, others: Similarities) -> Similarities:
        """Return these with the others (m,) at some places (m,)."""
        scales, rotations, translations = (
            each.copy() for each in (self.scales, self.rotations, self.translations)
        )
        scales[places], rotations[places] = others.scales, others.rotations
        translations[places] = others.translations
        return Similarities(scales, rotations, translations)

    def before(self, S_source_new: Similarity) -> Similarities:
        """S_target_source @ S_source_new for each."""
        return Similarities(
            S_source_new.scale * self.scales,
            self.rotations @ S_source_new.rotation,
            self.linear() @ S_source_new.translation + self.translations,
        )

    def after(self, S_new_target: Similarity) -> Similarities:
        """S_new_target @ S_target_source for each."""
        return Similarities(
            S_new_target.scale * self.scales,
            S_new_target.rotation @ self.rotations,
            S_new_target.apply(self.translations),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Alignments:
    """What `align_segments` finds."""

    S_target_source: Similarities
    determined: Mask
    """(n,) whether `align` would have found this transform; others are the identity"""


@dataclass(frozen=True, slots=True, eq=False)
class Moments:
    """Of corresponding points, per segment, with weights that sum to one."""

    correlations: Floats
    """(n, 3, 3) mean of target times source', both from their means"""
    target_means: Floats
    """(n, 3)"""
    source_means: Floats
    """(n, 3)"""
    target_extents: Floats
    """(n,) mean squared distance from the mean"""
    source_extents: Floats
    """(n,) only looked at for least squares and for a yaw"""
    counts: Ints
    """(n,) points of positive weight"""


_MINIMAL_POINTS = np.zeros(8, np.int64)
for _gauge in Gauge:
    _MINIMAL_POINTS[int(_gauge)] = _gauge.minimal_points


def align_segments(
    target: Floats,
    source: Floats,
    segments: Segments,
    gauges: Ints,
    weights: Floats,
    scale: Scale = 'least_squares',
) -> Alignments:
    """
    `align` of source (rows, 3) to target (rows, 3) within every segment; `gauges` (n,).

    Rows of weight zero do not count. Nothing is raised: see `Alignments.determined`.
    """
    with np.errstate(all='ignore'):
        shares = weights / segments.sums(weights)[segments.owners]
        target_means = segments.sums(shares[:, None] * target)
        source_means = segments.sums(shares[:, None] * source)
        owners = segments.owners
        targets, sources = target - target_means[owners], source - source_means[owners]
        products = (shares[:, None] * targets)[:, :, None] * sources[:, None, :]
        moments = Moments(
            segments.sums(products.reshape(-1, 9)).reshape(-1, 3, 3),
            target_means,
            source_means,
            segments.sums(shares * np.sum(targets**2, axis=1)),
            segments.sums(shares * np.sum(sources**2, axis=1)),
            segments.counts(weights > 0.0),
        )
    return align_moments(moments, gauges, scale)


def align_moments(moments: Moments, gauges: Ints, scale: Scale) -> Alignments:
    """`align_segments` from what it needs to know of each segment."""
    with np.errstate(all='ignore'):
        spread = np.sqrt(moments.target_extents * moments.source_extents)
        rotations, determined = _rotations(moments.correlations, gauges, spread)
        overlaps = (rotations * moments.correlations).sum(axis=(1, 2))
        is_tangent = scale == 'tangent'
        factors = (
            moments.target_extents / overlaps if is_tangent else overlaps / moments.source_extents
        )
        factors = np.where(gauges == Gauge.SIMILARITY, factors, 1.0)
        turned = (rotations @ moments.source_means[:, :, None])[:, :, 0]
        translations = moments.target_means - factors[:, None] * turned
        translations[gauges == Gauge.NONE] = 0.0
        determined &= moments.counts >= _MINIMAL_POINTS[gauges]
        determined &= (
            (factors > 0.0) & np.isfinite(factors) & np.isfinite(translations).all(axis=1)
        )
    found = Similarities(factors, rotations, translations)
    return Alignments(found if determined.all() else _or_identity(determined, found), determined)


def align_segments_robustly(
    target: Floats,
    source: Floats,
    segments: Segments,
    gauges: Ints,
    weights: Floats,
    steps: int = 15,
) -> Alignments:
    """`align_robustly` within every segment; parameters as in `align_segments`."""
    found = align_segments(target, source, segments, gauges, weights)
    determined = found.determined
    for _ in range(steps):
        moved = found.S_target_source.apply(segments, source)
        distances = np.linalg.norm(moved - target, axis=1)
        floor = np.maximum(0.1 * segments.medians(distances), np.finfo(float).tiny)
        with np.errstate(all='ignore'):
            robust = weights / np.maximum(distances, floor[segments.owners])
        found = align_segments(target, source, segments, gauges, robust)
        determined = determined & found.determined
    return Alignments(found.S_target_source, determined)


def _rotations(correlations: Floats, gauges: Ints, extents: Floats) -> tuple[Floats, Mask]:
    """Rotations (n, 3, 3) that maximise tr(R' correlation), and which of them are determined."""
    finite = np.asarray(np.isfinite(correlations).all(axis=(1, 2)))
    safe = correlations
    if not finite.all():
        safe = np.where(finite[:, None, None], correlations, np.eye(3))
    left, spreads, right = np.linalg.svd(safe)
    left[:, :, 2] *= (np.linalg.det(left) * np.linalg.det(right))[:, None]
    rotations = left @ right
    determined = (spreads[:, 0] > 0.0) & (spreads[:, 1] >= COLLINEAR_RATIO * spreads[:, 0])
    yaw = gauges == Gauge.YAW_TRANSLATION
    if yaw.any():
        sine, cosine = safe[:, 1, 0] - safe[:, 0, 1], safe[:, 0, 0] + safe[:, 1, 1]
        length = np.hypot(sine, cosine)
        turned = np.zeros((len(safe), 3, 3))
        turned[:, 0, 0] = turned[:, 1, 1] = cosine / length
        turned[:, 1, 0], turned[:, 0, 1] = sine / length, -sine / length
        turned[:, 2, 2] = 1.0
        rotations = np.where(yaw[:, None, None], turned, rotations)
        determined = np.where(
            yaw, (length >= COLLINEAR_RATIO * extents) & (length > 0), determined
        )
    fixed = gauges == Gauge.NONE
    if fixed.any():
        rotations = np.where(fixed[:, None, None], np.eye(3), rotations)
    return rotations, finite & (determined | fixed)


def _or_identity(determined: Mask, found: Similarities) -> Similarities:
    return Similarities(
        np.where(determined, found.scales, 1.0),
        np.where(determined[:, None, None], found.rotations, np.eye(3)),
        np.where(determined[:, None], found.translations, 0.0),
    )
