# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
The cost of all sub-maps together, stacked: what `Element` says of one, for all at once.

`Element` is the plain form of the same; docs/algorithm.md derives both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapmerge_ros.arrays import Floats, Ints, Mask
from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.fusion.element import Element, coordinates
from mapmerge_ros.geometry import Gauge, Segments, Similarities, align_segments
from mapmerge_ros.submap import SubMap, alignment_weights, triangulate


@dataclass(frozen=True, slots=True, eq=False)
class Root:
    """R and c of one sub-map; the squared residuals count `weight` times."""

    r: Floats
    """(k, 3s) float32 where it came so: it is exact, and half as large"""
    c: Floats
    """(k,)"""
    weight: float

    def dense(self) -> Floats:
        """R in float64, not weighted."""
        return np.asarray(self.r, np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Landmarks, the frames that follow from them, and what they cost."""

    points: Floats
    """(tracks, 3) global frame"""
    S_map_globals: Similarities
    """T_k from the hard gauge constraint"""
    moved: Floats
    """(rows, 3) y = T q of every member, frame of its map"""
    stretches: Floats
    """(maps,) factor that brings y to the size of q°; 1 where the gauge has scale"""
    centres: Floats
    """(maps, 3) fixed point of the stretch"""
    slopes: Floats
    """(rows, 3) R'(R y' + c): derivative of half the cost by the displacement"""
    cost: float
    """Σ |R y' + c|², px²"""


@dataclass(frozen=True, slots=True, eq=False)
class JointCost:
    """All sub-maps, their compressed landmarks stacked row by row."""

    gauges: Ints
    """(maps,)"""
    segments: Segments
    """Rows of each map"""
    tracks: Ints
    """(rows,) row of each landmark in the global q"""
    points_map: Floats
    """(rows, 3) working points q°"""
    weights: Floats
    """(rows,) of the alignment, at most 1 in each map; zero for a private landmark"""
    is_shared: Mask
    """(rows,)"""
    roots: tuple[Root, ...]

    @classmethod
    def of(
        cls, submaps: Sequence[SubMap], tracks: Sequence[Ints], is_shared: Mask, weights: Floats
    ) -> JointCost:
        """Cost of whole sub-maps; `is_shared` is by track, `weights` (maps,) by map."""
        roots, alignment = [], []
        for submap, own, weight in zip(submaps, tracks, weights, strict=True):
            r = submap.triangle(np.float32 if submap.packed_r.dtype == np.float32 else np.float64)
            roots.append(Root(r, submap.c, float(weight)))
            information = np.where(is_shared[own], alignment_weights(r), 0.0)
            alignment.append(information / information.max())
        rows = np.concatenate(list(tracks))
        return cls(
            gauges=np.array([int(submap.gauge) for submap in submaps]),
            segments=Segments.of_lengths([len(own) for own in tracks]),
            tracks=rows,
            points_map=np.concatenate([submap.compressed_points for submap in submaps]),
            weights=np.concatenate(alignment),
            is_shared=is_shared[rows],
            roots=tuple(roots),
        )

    def __len__(self) -> int:
        return len(self.roots)

    @property
    def count(self) -> int:
        """Tracks that the maps are about."""
        return int(self.tracks.max()) + 1

    def reduced(self) -> JointCost:
        """Return the cost of the shared landmarks, renumbered; private ones are at their best."""
        if self.is_shared.all():
            return self
        slots = np.cumsum(np.bincount(self.tracks[self.is_shared], minlength=self.count) > 0) - 1
        shared = self.is_shared
        return JointCost(
            gauges=self.gauges,
            segments=Segments.of_lengths(self.segments.counts(shared)),
            tracks=slots[self.tracks[shared]],
            points_map=self.points_map[shared],
            weights=self.weights[shared],
            is_shared=shared[shared],
            roots=tuple(
                _without_private(root, shared[self.segments.rows(k)])
                for k, root in enumerate(self.roots)
            ),
        )

    def evaluate(self, points: Floats) -> State:
        """
        Place every map on the global landmarks (tracks, 3).

        Raises
        ------
        DegenerateGeometry
            The landmarks do not determine the frame of some map.

        """
        found = align_segments(
            self.points_map,
            points[self.tracks],
            self.segments,
            self.gauges,
            self.weights,
            'tangent',
        )
        if not found.determined.all():
            k = int(np.argmin(found.determined))
            raise DegenerateGeometry(
                f'the shared landmarks of sub-map {k} of the merge do not determine its frame'
            )
        moved = found.S_target_source.apply(self.segments, points[self.tracks])
        centres, growth = self.means(moved), self.growth()
        stretches = np.where(self.gauges == Gauge.SIMILARITY, 1.0, self._stretches(moved, growth))
        owners = self.segments.owners
        stretched = centres[owners] + stretches[owners, None] * (moved - centres[owners])
        with np.errstate(invalid='ignore'):  # a wild step may turn a map inside out: it costs nan
            logarithms = np.log(stretches)[owners, None]
        displacement = stretched - self.points_map - logarithms * growth
        slopes, cost = np.empty_like(displacement), 0.0
        for k, root in enumerate(self.roots):
            rows = self.segments.rows(k)
            dense = root.dense()
            residuals = dense @ displacement[rows].ravel() + root.c
            cost += root.weight * float(residuals @ residuals)
            slopes[rows] = root.weight * (residuals @ dense).reshape(-1, 3)
        return State(points, found.S_target_source, moved, stretches, centres, slopes, cost)

    def centres_map(self) -> Floats:
        """Weighted means (maps, 3) of the working points."""
        return self.means(self.points_map)

    def growth(self) -> Floats:
        """Displacement (rows, 3) of the working points per unit of log scale."""
        growth: Floats = self.points_map - self.centres_map()[self.segments.owners]
        return growth

    def recover_private(self, shared_points: Floats, count: int) -> Floats:
        """All landmarks (count, 3), the private ones where they are best for given shared ones."""
        points = np.full((count, 3), np.nan)
        points[np.unique(self.tracks[self.is_shared])] = shared_points
        for k in np.flatnonzero(self.segments.counts(~self.is_shared) > 0):
            element = self.element(int(k))
            points[element.tracks[~element.is_shared]] = element.recover_private(points)
        return points

    def element(self, k: int) -> Element:
        """Return one map in its plain form."""
        root, rows = self.roots[k], self.segments.rows(k)
        r = np.sqrt(root.weight) * root.dense()
        return Element(
            gauge=Gauge(int(self.gauges[k])),
            tracks=self.tracks[rows],
            r=r,
            c=np.sqrt(root.weight) * root.c,
            points_map=self.points_map[rows],
            weights=self.weights[rows],
            is_shared=self.is_shared[rows],
            information=r.T @ r,
        )

    def elements(self) -> tuple[Element, ...]:
        """Every map in its plain form, which takes four times the memory."""
        return tuple(self.element(k) for k in range(len(self)))

    def shares(self) -> Floats:
        """Weights (rows,) that sum to one in each map."""
        shares: Floats = self.weights / self.segments.sums(self.weights)[self.segments.owners]
        return shares

    def means(self, points: Floats) -> Floats:
        """Weighted mean (maps, 3) of points (rows, 3)."""
        return self.segments.sums(self.shares()[:, None] * points)

    def _stretches(self, moved: Floats, growth: Floats) -> Floats:
        weighted = growth * self.weights[:, None]
        size = self.segments.sums(np.sum(weighted * growth, axis=1))
        stretches: Floats = size / self.segments.sums(np.sum(weighted * moved, axis=1))
        return stretches


def _without_private(root: Root, is_shared: Mask) -> Root:
    """Private columns first in a QR: the rows below them hold for every T (exact)."""
    if is_shared.all():
        return root
    private, shared = np.flatnonzero(~is_shared), np.flatnonzero(is_shared)
    r, c = triangulate(root.dense()[:, coordinates(np.concatenate([private, shared]))], root.c)
    return Root(r[3 * len(private) :, 3 * len(private) :], c[3 * len(private) :], root.weight)
