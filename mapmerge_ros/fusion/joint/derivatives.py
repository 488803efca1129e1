# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Derivatives of the joint cost: how frames and stretches answer to moved landmarks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg.blas import dgemm

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.fusion.joint.cost import JointCost, State
from mapmerge_ros.fusion.joint.root import Unpacked
from mapmerge_ros.geometry import Gauge, generators

UNDETERMINED = 'the frame of a sub-map is not determined'


@dataclass(frozen=True, slots=True, eq=False)
class LowRank:
    """Per map U, V (3s, m): y' moves by (stretch I + U V') B dq, B the linear part of T."""

    left: Floats
    """(rows, 3, m)"""
    right: Floats
    """(rows, 3, m)"""


def gradient(cost: JointCost, state: State) -> Floats:
    """Half the derivative (tracks, 3) of the cost by the global landmarks."""
    return cost.by_track(by_members(cost, state))


def by_members(cost: JointCost, state: State) -> Floats:
    """Half the derivative (rows, 3) by where each sub-map by itself has its landmarks, global."""
    linear = state.S_map_globals.linear()[cost.segments.owners]
    forces: Floats = np.einsum('mi,mij->mj', _pulled_back(cost, state), linear)
    return forces


def _pulled_back(cost: JointCost, state: State) -> Floats:
    """(stretch I + V U') slopes, (rows, 3): derivative by y with the frames following."""
    owners = cost.segments.owners
    if not cost.is_plain:
        answer = low_rank(cost, state)
        pulled = cost.segments.products(answer.left, state.slopes[:, :, None])
        slopes = state.stretches[owners, None] * state.slopes
        slopes += (answer.right @ pulled[owners])[:, :, 0]
        return slopes
    # All scales are free: N'WG falls apart into translation, rotation and scale.
    lever = state.moved - cost.centres_map[owners]
    products = (lever[:, :, None] * state.slopes[:, None, :]).reshape(-1, 9)
    sums = cost.segments.sums(np.concatenate([state.slopes, products], axis=1))
    pull, inner = sums[:, 3:].reshape(-1, 3, 3), state.moments
    traces = np.einsum('nii->n', inner)[:, None]
    torques = np.column_stack([pull[:, i, j] - pull[:, j, i] for i, j in ((1, 2), (2, 0), (0, 1))])
    try:
        turns = np.linalg.solve(traces[:, :, None] * np.eye(3) - inner, torques[:, :, None])
    except np.linalg.LinAlgError:
        raise DegenerateGeometry(UNDETERMINED) from None
    pushed = np.cross(turns[owners, :, 0], cost.growth)
    pushed += (np.einsum('nii->n', pull)[:, None] / traces)[owners] * cost.growth
    pushed += sums[owners, :3]
    free: Floats = state.slopes - cost.shares[:, None] * pushed
    return free


class Jacobians:
    """Derivatives of the maps' weighted residuals, one map after the other in the same memory."""

    def __init__(self, cost: JointCost, state: State) -> None:
        self._cost, self._state, self._answer = cost, state, low_rank(cost, state)
        columns = 3 * int(cost.segments.lengths.max())
        self._unpacked, self._sorted = Unpacked(columns), np.empty(columns**2)

    def of(self, k: int, order: Ints) -> Floats:
        """
        Derivative (rows of R, 3s) by the global landmarks of a map, these in the given order.

        Valid until the next one is asked for.
        """
        root, rows, frames = (
            self._cost.roots[k],
            self._cost.segments.rows(k),
            self._state.S_map_globals,
        )
        shape = len(root.c), root.columns
        linear = frames.scales[k] * frames.rotations[k]
        left = self._answer.left[rows].reshape(root.columns, -1)
        right = self._answer.right[rows][order].transpose(0, 2, 1) @ linear
        weight = np.sqrt(root.weight)
        r = self._unpacked.trapezoid(root.packed, *shape)
        inner = weight * (r @ left)
        sorted_ = self._sorted[: r.size].reshape(len(r), -1, 3)
        np.take(r.reshape(sorted_.shape), order, axis=1, out=sorted_, mode='clip')
        stretched = weight * self._state.stretches[k] * linear
        np.matmul(sorted_.reshape(-1, 3), stretched, out=r.reshape(-1, 3))
        moved = right.transpose(0, 2, 1).reshape(root.columns, -1)
        dgemm(1.0, moved, inner.T, beta=1.0, c=r.T, overwrite_c=1)
        return r


def low_rank(cost: JointCost, state: State) -> LowRank:
    """How T and the stretch answer to moved landmarks, for all maps."""
    tangents, responses = gauge_response(cost, state)
    if cost.is_plain:
        return LowRank(-tangents, responses)
    owners, growth = cost.segments.owners, cost.growth
    stretches = state.stretches[owners, None]
    weighted = growth * cost.weights[:, None]
    metric = 1.0 * (cost.gauges != Gauge.SIMILARITY)[owners, None]
    size = cost.segments.sums(np.sum(weighted * growth, axis=1))[owners, None]
    left, right = np.zeros((len(growth), 3, 4)), np.zeros((len(growth), 3, 4))
    left[:, :, :3] = (1.0 - stretches)[:, :, None] * np.eye(3)
    left[:, :, 3] = metric * (state.moved - state.centres[owners] - growth / stretches)
    right[:, :, :3] = cost.shares[:, None, None] * np.eye(3)
    right[:, :, 3] = -metric * stretches**2 / size * weighted
    inner = cost.segments.products(right, tangents)[owners]
    through = -stretches[:, :, None] * tangents - left @ inner
    return LowRank(
        np.concatenate([left, through], axis=2), np.concatenate([right, responses], axis=2)
    )


def gauge_response(cost: JointCost, state: State) -> tuple[Floats, Floats]:
    """G and the transposed response (N'W G)^-1 N'W, (rows, 3, 7); zero where T is not free."""
    owners, growth = cost.segments.owners, cost.growth
    centres = cost.centres_map[owners]
    is_free = np.arange(7) < cost.gauges[:, None]
    free = is_free[owners][:, None, :]
    tangents = _generators(state.moved - centres) * free
    constraints = _generators(growth) * cost.weights[:, None, None] * free
    inner = cost.segments.products(constraints, tangents)
    inner[:, range(7), range(7)] += ~is_free
    try:
        inverse = np.linalg.inv(inner)
    except np.linalg.LinAlgError:
        raise DegenerateGeometry(UNDETERMINED) from None
    return tangents, constraints @ inverse.transpose(0, 2, 1)[owners]


def _generators(points: Floats) -> Floats:
    return generators(points, Gauge.SIMILARITY)
