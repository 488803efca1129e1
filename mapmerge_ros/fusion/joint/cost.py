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
from mapmerge_ros.geometry import Gauge, Segments, Similarities, align_segments, generators
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
class LowRank:
    """Per map U, V (3s, m): y' moves by (stretch I + U V') B dq, B the linear part of T."""

    left: Floats
    """(rows, 3, m)"""
    right: Floats
    """(rows, 3, m)"""


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
        centres, growth = self._means(moved), self.growth()
        stretches = np.where(self.gauges == Gauge.SIMILARITY, 1.0, self._stretches(moved, growth))
        owners = self.segments.owners
        stretched = centres[owners] + stretches[owners, None] * (moved - centres[owners])
        displacement = stretched - self.points_map - np.log(stretches)[owners, None] * growth
        slopes, cost = np.empty_like(displacement), 0.0
        for k, root in enumerate(self.roots):
            rows = self.segments.rows(k)
            dense = root.dense()
            residuals = dense @ displacement[rows].ravel() + root.c
            cost += root.weight * float(residuals @ residuals)
            slopes[rows] = root.weight * (residuals @ dense).reshape(-1, 3)
        return State(points, found.S_target_source, moved, stretches, centres, slopes, cost)

    def gradient(self, state: State) -> Floats:
        """Half the derivative (tracks, 3) of the cost by the global landmarks."""
        low_rank, owners = self.low_rank(state), self.segments.owners
        pulled = self.segments.products(low_rank.left, state.slopes[:, :, None])
        slopes = state.stretches[owners, None] * state.slopes
        slopes += (low_rank.right @ pulled[owners])[:, :, 0]
        turned = np.einsum('mi,mij->mj', slopes, state.S_map_globals.linear()[owners])
        size = len(state.points)
        return np.column_stack(
            [np.bincount(self.tracks, weights=axis, minlength=size) for axis in turned.T]
        )

    def jacobian(self, k: int, state: State, low_rank: LowRank) -> Floats:
        """Derivative (rows of R, 3s) of a map's weighted residuals by its global landmarks."""
        root, rows = self.roots[k], self.segments.rows(k)
        linear = state.S_map_globals.scales[k] * state.S_map_globals.rotations[k]
        left = low_rank.left[rows].reshape(root.r.shape[1], -1)
        right = (low_rank.right[rows].transpose(0, 2, 1) @ linear).transpose(0, 2, 1)
        r, weight = root.dense(), np.sqrt(root.weight)
        turned = r.reshape(-1, 3) @ (weight * state.stretches[k] * linear)
        jacobian: Floats = turned.reshape(r.shape)
        jacobian += weight * (r @ left) @ right.reshape(root.r.shape[1], -1).T
        return jacobian

    def low_rank(self, state: State) -> LowRank:
        """How T and the stretch answer to moved landmarks, for all maps."""
        tangents, responses = self.gauge_response(state)
        if (self.gauges == Gauge.SIMILARITY).all():
            return LowRank(-tangents, responses)
        owners, growth = self.segments.owners, self.growth()
        stretches = state.stretches[owners, None]
        weighted = growth * self.weights[:, None]
        metric = 1.0 * (self.gauges != Gauge.SIMILARITY)[owners, None]
        size = self.segments.sums(np.sum(weighted * growth, axis=1))[owners, None]
        left, right = np.zeros((len(growth), 3, 4)), np.zeros((len(growth), 3, 4))
        left[:, :, :3] = (1.0 - stretches)[:, :, None] * np.eye(3)
        left[:, :, 3] = metric * (state.moved - state.centres[owners] - growth / stretches)
        right[:, :, :3] = self._shares()[:, None, None] * np.eye(3)
        right[:, :, 3] = -metric * stretches**2 / size * weighted
        inner = self.segments.products(right, tangents)[owners]
        through = -stretches[:, :, None] * tangents - left @ inner
        return LowRank(
            np.concatenate([left, through], axis=2), np.concatenate([right, responses], axis=2)
        )

    def gauge_response(self, state: State) -> tuple[Floats, Floats]:
        """G and the transposed response (N'W G)^-1 N'W, (rows, 3, 7); zero where T is not free."""
        owners, growth = self.segments.owners, self.growth()
        centres = self.centres_map()[owners]
        is_free = np.arange(7) < self.gauges[:, None]
        free = is_free[owners][:, None, :]
        tangents = _generators(state.moved - centres) * free
        constraints = _generators(growth) * self.weights[:, None, None] * free
        inner = self.segments.products(constraints, tangents)
        inner[:, range(7), range(7)] += ~is_free
        try:
            inverse = np.linalg.inv(inner)
        except np.linalg.LinAlgError:
            raise DegenerateGeometry('the frame of a sub-map is not determined') from None
        return tangents, constraints @ inverse.transpose(0, 2, 1)[owners]

    def centres_map(self) -> Floats:
        """Weighted means (maps, 3) of the working points."""
        return self._means(self.points_map)

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

    def _shares(self) -> Floats:
        shares: Floats = self.weights / self.segments.sums(self.weights)[self.segments.owners]
        return shares

    def _means(self, points: Floats) -> Floats:
        return self.segments.sums(self._shares()[:, None] * points)

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


def _generators(points: Floats) -> Floats:
    return generators(points, Gauge.SIMILARITY)
