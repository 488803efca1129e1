# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What a merge knows, from the factor alone: no inverse of the whole is ever formed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mapmerge_ros.arrays import Floats, Ints, Mask
from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.fusion.compress import Normal
from mapmerge_ros.fusion.element import coordinates
from mapmerge_ros.fusion.joint import derivatives
from mapmerge_ros.fusion.joint.cost import JointCost, State
from mapmerge_ros.fusion.joint.factor import Factor
from mapmerge_ros.fusion.joint.factorise import factorise
from mapmerge_ros.fusion.joint.fronts import Front
from mapmerge_ros.fusion.joint.minimise import gauss_newton, plan
from mapmerge_ros.geometry import Gauge, Similarity, gauge_basis
from mapmerge_ros.submap import pack


@dataclass(frozen=True, slots=True, eq=False)
class Uncertainty:
    """Covariances in the gauge that prefers no landmark, for the given σ."""

    landmarks: Floats
    """(tracks, 3, 3)"""
    frames: Floats
    """(maps, 7, 7) left tangent of S_global_map, order of `Similarity.exp`"""
    factor: Factor | None
    """Of the Gauss-Newton matrix here, for the next merge; None where it would be too large"""


def uncertainty(cost: JointCost, state: State, gauge: Gauge, sigma: float) -> Uncertainty:
    """
    Covariances of landmarks and frames at the optimum.

    The factor holds the frame by one map; the projection Π = I - N N' off the gauge N takes that
    out again: Π Σ Π needs Σ N besides the blocks of Σ, and that is one solve.

    Raises
    ------
    DegenerateGeometry
        A landmark is not determined.

    """
    try:
        factor = factorise(plan(cost, state.points), gauss_newton(cost, state, gauge))
    except np.linalg.LinAlgError:
        raise DegenerateGeometry('a merged landmark is not determined') from None
    gathering = Gathering(cost, state, gauge, factor)
    for front, block in factor.inverse_blocks():
        gathering.take(front, block)
    found = gathering.uncertainty()
    return replace(found, landmarks=sigma**2 * found.landmarks, frames=sigma**2 * found.frames)


class Gathering:
    """What is known of landmarks and frames, from one block of the inverse after the other."""

    def __init__(
        self, cost: JointCost, state: State, gauge: Gauge, factor: Factor, scale: float = 1.0
    ) -> None:
        """
        Nothing has been taken yet.

        The matrix of `factor`, times the square of `scale`, is the Gauss-Newton matrix.
        """
        self._factor, self._scale, self._cost = factor, scale, cost
        self._null = gauge_basis(state.points, gauge)
        self._pulled = factor.solve(self._null) if self._null.shape[1] else self._null
        self._inner = self._null.T @ self._pulled
        self._landmarks = np.empty((len(state.points), 3, 3))
        self._frames = np.empty((len(cost), 7, 7))
        self._by_points = _FramesByPoints(cost, state)
        self._is_kept, self._leaves = factor.fits, dict[int, Floats]()

    def take(self, front: Front, block: Floats) -> None:
        """Take note of the inverse (k + b, k + b) on a front."""
        if not front.eliminated and front.leaf < 0:
            return
        own = front.rows if front.leaf >= 0 else front.rows[: front.eliminated]
        n, z = self._null[own], self._pulled[own]
        free = block[: len(own), : len(own)] + n @ (self._inner @ n.T - z.T) - z @ n.T
        _take_landmarks(front, free, self._landmarks)
        if front.leaf >= 0:
            if self._is_kept:
                shared = self._cost.is_shared[self._cost.segments.rows(front.leaf)]
                at = coordinates(np.flatnonzero(shared[front.leaf_order]))
                own_block = block if shared.all() else block[np.ix_(at, at)]
                # Without noise the quotient is what float32 can hold, the block is not.
                with np.errstate(over='ignore'):
                    rounded = pack((own_block / self._scale**2).astype(np.float32))
                if np.isfinite(rounded).all():
                    self._leaves[front.leaf] = rounded
            derivative = self._by_points(front.leaf, front.leaf_order)
            self._frames[front.leaf] = derivative @ free @ derivative.T

    def uncertainty(self) -> Uncertainty:
        """All of it, when every front has been taken; the factor is of the Gauss-Newton matrix."""
        kept = self._factor.rounded(self._scale, self._leaves) if self._is_kept else None
        return Uncertainty(self._landmarks, self._frames, kept)


def schur_complement(cost: JointCost, state: State, keep: Mask, gauge: Gauge) -> Normal:
    """
    Eliminate all landmarks but some: the normal equations of the kept ones.

    They come last in the elimination, so that what is left for them at the root is the answer.

    Raises
    ------
    DegenerateGeometry
        A landmark that is left out is not determined by the others.

    """
    fronts = plan(cost, state.points, keep)
    try:
        factor = factorise(fronts, gauss_newton(cost, state), keep_root=True)
    except np.linalg.LinAlgError:
        raise DegenerateGeometry('a merged landmark is not determined') from None
    assert factor.root is not None
    rows = fronts.fronts[-1].rows
    order = np.argsort(rows)
    gradient = factor.forward(derivatives.gradient(cost, state).ravel())[rows[order]]
    return Normal(state.points[keep], factor.root[np.ix_(order, order)], gradient, gauge)


def _take_landmarks(front: Front, free: Floats, landmarks: Floats) -> None:
    """Diagonal blocks of the landmarks that are eliminated here."""
    count = front.eliminated // 3
    every = np.arange(count)
    blocks = free[: 3 * count, : 3 * count].reshape(count, 3, count, 3)
    landmarks[front.rows[: 3 * count : 3] // 3] = blocks[every, :, every, :]


class _FramesByPoints:
    """`Element.frame_by_points`: derivative (7, 3s) of a frame by landmarks in a given order."""

    def __init__(self, cost: JointCost, state: State) -> None:
        self._cost, self._state = cost, state
        self._responses = derivatives.gauge_response(cost, state)[1]
        self._centres = cost.centres_map

    def __call__(self, k: int, order: Ints) -> Floats:
        rows, size = self._cost.segments.rows(k), int(self._cost.gauges[k])
        S_map_global = self._state.S_map_globals[k]
        linear = S_map_global.scale * S_map_global.rotation
        turned = self._responses[rows][order].transpose(2, 0, 1) @ linear
        tangent = np.zeros((7, turned.shape[1] * 3))
        # generators are ordered translation, rotation z x y, scale; exp rotation, translation
        tangent[[3, 4, 5, 2, 0, 1, 6][:size]] = turned[:size].reshape(size, tangent.shape[1])
        centred = Similarity(1.0, np.eye(3), self._centres[k])
        derivative: Floats = S_map_global.inverse().adjoint() @ centred.adjoint() @ tangent
        return derivative
