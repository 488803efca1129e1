# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
The cost of all sub-maps together, stacked: what `Element` says of one, for all at once.

`Element` is the plain form of the same; docs/algorithm.md derives both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from mapmerge_ros.arrays import Floats, Ints, Mask
from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.fusion.element import Element
from mapmerge_ros.fusion.joint.root import Root, scratch_size
from mapmerge_ros.geometry import (
    Gauge,
    Moments,
    Segments,
    Similarities,
    Similarity,
    align_moments,
)
from mapmerge_ros.submap import LandmarkInformation, SubMap


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Landmarks, the frames that follow from them, and what they cost."""

    points: Floats
    """(tracks, 3) global frame"""
    S_map_globals: Similarities
    """T_k from the hard gauge constraint"""
    moved: Floats
    """(rows, 3) y = T q of every member, frame of its map"""
    moments: Floats
    """(maps, 3, 3) weighted mean of growth times y"""
    stretches: Floats
    """(maps,) factor that brings y to the size of q°; 1 where the gauge has scale"""
    centres: Floats
    """(maps, 3) fixed point of the stretch"""
    slopes: Floats
    """(rows, 3) R'(R y' + c): derivative of half the cost by the displacement"""
    cost: float
    """Σ |R y' + c|², px²"""

    def after(self, S_new_global: Similarity) -> State:
        """Return the same in another global frame; what is said in the maps' frames stays."""
        return replace(
            self,
            points=S_new_global.apply(self.points),
            S_map_globals=self.S_map_globals.before(S_new_global.inverse()),
        )


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
    information: Floats
    """(rows, 3, 3) of each landmark in its map, all others held fixed, weighted as the map is"""
    is_shared: Mask
    """(rows,)"""
    roots: tuple[Root, ...]
    shares: Floats = field(init=False)
    """(rows,) weights that sum to one in each map"""
    centres_map: Floats = field(init=False)
    """(maps, 3) weighted means of the working points"""
    growth: Floats = field(init=False)
    """(rows, 3) displacement of the working points per unit of log scale"""
    sizes: Floats = field(init=False)
    """(maps,) weighted mean squared growth"""

    def __post_init__(self) -> None:
        set_, owners = object.__setattr__, self.segments.owners
        set_(self, 'shares', self.weights / self.segments.sums(self.weights)[owners])
        set_(self, 'centres_map', self.means(self.points_map))
        set_(self, 'growth', self.points_map - self.centres_map[owners])
        squares = np.einsum('mi,mi->m', self.growth, self.growth)
        set_(self, 'sizes', self.segments.sums(self.shares * squares))

    @classmethod
    def of(
        cls,
        submaps: Sequence[SubMap],
        tracks: Sequence[Ints],
        is_shared: Mask,
        weights: Floats,
        informations: Sequence[LandmarkInformation],
    ) -> JointCost:
        """
        Cost of whole sub-maps; `is_shared` is by track, `weights` (maps,) by map.

        `informations` are those of the compressed landmarks of each.
        """
        rows = np.concatenate(list(tracks))
        segments = Segments.of_lengths([len(own) for own in tracks])
        alignment = np.where(
            is_shared[rows], np.concatenate([one.weights for one in informations]), 0.0
        )
        largest = np.maximum.reduceat(alignment, segments.ends[:-1])
        return cls(
            gauges=np.array([int(submap.gauge) for submap in submaps]),
            segments=segments,
            tracks=rows,
            points_map=np.concatenate([submap.compressed_points for submap in submaps]),
            weights=alignment / largest[segments.owners],
            information=np.concatenate(
                [weight * one.blocks for weight, one in zip(weights, informations, strict=True)]
            ),
            is_shared=is_shared[rows],
            roots=tuple(
                Root(submap.packed_r, submap.c, float(weight), 3 * submap.compressed_count)
                for submap, weight in zip(submaps, weights, strict=True)
            ),
        )

    def __len__(self) -> int:
        return len(self.roots)

    @property
    def count(self) -> int:
        """Tracks that the maps are about."""
        return int(self.tracks.max()) + 1

    @property
    def residual_count(self) -> int:
        """Of all maps; private landmarks that are at their best have none."""
        return sum(len(root.c) for root in self.roots)

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
            information=self.information[shared],
            is_shared=shared[shared],
            roots=tuple(
                root.without(shared[self.segments.rows(k)]) for k, root in enumerate(self.roots)
            ),
        )

    def only(self, k: int) -> JointCost:
        """Return the cost of one sub-map, its landmarks numbered as it has them."""
        rows = self.segments.rows(k)
        return JointCost(
            gauges=self.gauges[[k]],
            segments=Segments.of_lengths([rows.stop - rows.start]),
            tracks=np.arange(rows.stop - rows.start),
            points_map=self.points_map[rows],
            weights=self.weights[rows],
            information=self.information[rows],
            is_shared=self.is_shared[rows],
            roots=(self.roots[k],),
        )

    def evaluate(self, points: Floats) -> State:
        """
        Place every map on the global landmarks (tracks, 3).

        Raises
        ------
        DegenerateGeometry
            The landmarks do not determine the frame of some map.

        """
        owners, source = self.segments.owners, points[self.tracks]
        placed = self._moments(source)
        frames = self._frames(placed)
        moved = frames.apply(self.segments, source)
        turned = placed.correlations @ frames.linear().transpose(0, 2, 1)
        centres = (frames.linear() @ placed.source_means[:, :, None])[:, :, 0]
        centres += frames.translations
        displacement, stretches = moved - self.points_map, np.ones(len(self))
        if not self.is_plain:
            overlaps = np.einsum('nii->n', turned)
            stretches = np.where(self.gauges == Gauge.SIMILARITY, 1.0, self.sizes / overlaps)
            with np.errstate(invalid='ignore'):  # a wild step may turn a map inside out: nan
                logarithms = np.log(stretches)[owners, None]
            displacement += (stretches[owners, None] - 1.0) * (moved - centres[owners])
            displacement -= logarithms * self.growth
        cost, slopes = self._responses(displacement)
        return State(points, frames, moved, turned, stretches, centres, slopes, cost)

    def frames(self, points: Floats) -> Similarities:
        """S_map_global of every map on the global landmarks (tracks, 3); see `evaluate`."""
        return self._frames(self._moments(points[self.tracks]))

    @property
    def rounding(self) -> float:
        """Cost that is left by rounding where everything fits exactly."""
        reaches = np.maximum.reduceat(np.abs(self.points_map), self.segments.ends[:-1]).max(axis=1)
        sizes = np.array([root.size for root in self.roots])
        return float(sizes @ (np.finfo(float).eps * reaches) ** 2)

    @property
    def is_plain(self) -> bool:
        """Whether no sub-map knows its scale: then there are no stretches."""
        return bool((self.gauges == Gauge.SIMILARITY).all())

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
        """Every map in its plain form, which takes eight times the memory."""
        return tuple(self.element(k) for k in range(len(self)))

    def by_track(self, values: Floats) -> Floats:
        """Sum over the members of each track, (rows, ...) to (tracks, ...)."""
        flat, count = values.reshape(len(values), -1), self.count
        by_track = np.empty((count, flat.shape[1]))
        for column, of_rows in enumerate(flat.T):
            by_track[:, column] = np.bincount(self.tracks, weights=of_rows, minlength=count)
        return by_track.reshape(count, *values.shape[1:])

    def means(self, points: Floats) -> Floats:
        """Weighted mean (maps, 3) of points (rows, 3)."""
        return self.segments.sums(self.shares[:, None] * points)

    def _moments(self, source: Floats) -> Moments:
        """What the hard gauge needs to know of the global landmarks (rows, 3)."""
        weighted = self.shares[:, None] * self.growth
        products = (weighted[:, :, None] * source[:, None, :]).reshape(-1, 9)
        means = self.means(source)
        return Moments(
            self.segments.sums(products).reshape(-1, 3, 3),
            self.centres_map,
            means,
            self.sizes,
            self._extents(source, means),
            self.segments.counts(self.weights > 0.0),
        )

    def _frames(self, moments: Moments) -> Similarities:
        found = align_moments(moments, self.gauges, 'tangent')
        if not found.determined.all():
            raise DegenerateGeometry(
                'the shared landmarks of a sub-map do not determine its frame'
            )
        return found.S_target_source

    def _responses(self, displacement: Floats) -> tuple[float, Floats]:
        slopes, cost = np.empty_like(displacement), 0.0
        scratch = np.empty(scratch_size(3 * int(self.segments.lengths.max())))
        for k, root in enumerate(self.roots):
            rows = self.segments.rows(k)
            own, slope = root.responses(displacement[rows].ravel(), scratch)
            slopes[rows] = slope.reshape(-1, 3)
            cost += own
        return cost, slopes

    def _extents(self, source: Floats, means: Floats) -> Floats:
        """Mean squared distances (maps,), where somebody looks at them: see `Moments`."""
        if not (self.gauges == Gauge.YAW_TRANSLATION).any():
            return np.ones(len(self))
        distances = source - means[self.segments.owners]
        return self.segments.sums(self.shares * np.sum(distances**2, axis=1))
