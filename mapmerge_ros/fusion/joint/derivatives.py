# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Derivatives of the joint cost: how frames and stretches answer to moved landmarks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapmerge_ros.arrays import Floats
from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.fusion.joint.cost import JointCost, State
from mapmerge_ros.geometry import Gauge, generators


@dataclass(frozen=True, slots=True, eq=False)
class LowRank:
    """Per map U, V (3s, m): y' moves by (stretch I + U V') B dq, B the linear part of T."""

    left: Floats
    """(rows, 3, m)"""
    right: Floats
    """(rows, 3, m)"""


def gradient(cost: JointCost, state: State) -> Floats:
    """Half the derivative (tracks, 3) of the cost by the global landmarks."""
    answer, owners = low_rank(cost, state), cost.segments.owners
    pulled = cost.segments.products(answer.left, state.slopes[:, :, None])
    slopes = state.stretches[owners, None] * state.slopes
    slopes += (answer.right @ pulled[owners])[:, :, 0]
    turned = np.einsum('mi,mij->mj', slopes, state.S_map_globals.linear()[owners])
    size = len(state.points)
    return np.column_stack(
        [np.bincount(cost.tracks, weights=axis, minlength=size) for axis in turned.T]
    )


def jacobian(cost: JointCost, k: int, state: State, answer: LowRank) -> Floats:
    """Derivative (rows of R, 3s) of a map's weighted residuals by its global landmarks."""
    root, rows = cost.roots[k], cost.segments.rows(k)
    linear = state.S_map_globals.scales[k] * state.S_map_globals.rotations[k]
    left = answer.left[rows].reshape(root.r.shape[1], -1)
    right = (answer.right[rows].transpose(0, 2, 1) @ linear).transpose(0, 2, 1)
    r, weight = root.dense(), np.sqrt(root.weight)
    turned = r.reshape(-1, 3) @ (weight * state.stretches[k] * linear)
    matrix: Floats = turned.reshape(r.shape)
    matrix += weight * (r @ left) @ right.reshape(root.r.shape[1], -1).T
    return matrix


def low_rank(cost: JointCost, state: State) -> LowRank:
    """How T and the stretch answer to moved landmarks, for all maps."""
    tangents, responses = gauge_response(cost, state)
    if (cost.gauges == Gauge.SIMILARITY).all():
        return LowRank(-tangents, responses)
    owners, growth = cost.segments.owners, cost.growth()
    stretches = state.stretches[owners, None]
    weighted = growth * cost.weights[:, None]
    metric = 1.0 * (cost.gauges != Gauge.SIMILARITY)[owners, None]
    size = cost.segments.sums(np.sum(weighted * growth, axis=1))[owners, None]
    left, right = np.zeros((len(growth), 3, 4)), np.zeros((len(growth), 3, 4))
    left[:, :, :3] = (1.0 - stretches)[:, :, None] * np.eye(3)
    left[:, :, 3] = metric * (state.moved - state.centres[owners] - growth / stretches)
    right[:, :, :3] = cost.shares()[:, None, None] * np.eye(3)
    right[:, :, 3] = -metric * stretches**2 / size * weighted
    inner = cost.segments.products(right, tangents)[owners]
    through = -stretches[:, :, None] * tangents - left @ inner
    return LowRank(
        np.concatenate([left, through], axis=2), np.concatenate([right, responses], axis=2)
    )


def gauge_response(cost: JointCost, state: State) -> tuple[Floats, Floats]:
    """G and the transposed response (N'W G)^-1 N'W, (rows, 3, 7); zero where T is not free."""
    owners, growth = cost.segments.owners, cost.growth()
    centres = cost.centres_map()[owners]
    is_free = np.arange(7) < cost.gauges[:, None]
    free = is_free[owners][:, None, :]
    tangents = _generators(state.moved - centres) * free
    constraints = _generators(growth) * cost.weights[:, None, None] * free
    inner = cost.segments.products(constraints, tangents)
    inner[:, range(7), range(7)] += ~is_free
    try:
        inverse = np.linalg.inv(inner)
    except np.linalg.LinAlgError:
        raise DegenerateGeometry('the frame of a sub-map is not determined') from None
    return tangents, constraints @ inverse.transpose(0, 2, 1)[owners]


def _generators(points: Floats) -> Floats:
    return generators(points, Gauge.SIMILARITY)
