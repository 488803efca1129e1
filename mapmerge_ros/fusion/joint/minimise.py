# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The joint merge: few factorisations, many cheap steps with the exact gradient."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mapmerge_ros.arrays import Floats, Mask
from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.fusion.config import FusionConfig
from mapmerge_ros.fusion.joint import derivatives
from mapmerge_ros.fusion.joint.acceleration import Acceleration
from mapmerge_ros.fusion.joint.cost import JointCost, State
from mapmerge_ros.fusion.joint.dissection import dissect
from mapmerge_ros.fusion.joint.factor import Elements, Factor, factorise
from mapmerge_ros.fusion.joint.fronts import Fronts, plan_fronts
from mapmerge_ros.fusion.merge import DAMPING_STEP, FIRST_DAMPING, MAX_DAMPING, Estimate
from mapmerge_ros.geometry import Gauge, gauge_basis

STALLED = 0.5
"""
Share of the last step's promise from which a step counts as slow, and the matrix as too old.

The promise falls with the square of the error; a tenth is a third of the error, and costs seven
cheap steps for what one factorisation buys.
"""

ROUNDING = 1e-12
"""Share of the cost below which a step that does not lower it is rounding."""


@dataclass(slots=True)
class _Matrix:
    """The factor in use of the Gauss-Newton matrix, and how steps with it have gone."""

    acceleration: Acceleration = field(default_factory=Acceleration)
    damping: float = 0.0
    factor: Factor | None = None
    fresh: bool = False
    """Made for the current landmarks"""

    def renew(self, damping: float = 0.0) -> None:
        """Ask for a factor of the current landmarks."""
        self.factor, self.damping = None, damping
        self.acceleration.forget()


def minimise(cost: JointCost, points: Floats, gauge: Gauge, config: FusionConfig) -> Estimate:
    """
    Minimise the cost over the landmarks, from `points` (tracks, 3).

    `gauge` is that of the result: the smallest among the sub-maps.

    Raises
    ------
    DegenerateGeometry
        The landmarks are not determined by the sub-maps together.

    """
    fronts = plan(cost, points)
    state = cost.evaluate(points)
    matrix = _Matrix()
    history, before = [state.cost], np.inf
    for iteration in range(1, config.max_iterations + 1):
        matrix.fresh = matrix.factor is None
        state, promised = _step(cost, fronts, state, matrix, gauge)
        history.append(state.cost)
        if promised <= config.relative_decrease * max(state.cost, np.finfo(float).tiny):
            return Estimate(state.points, state.cost, iteration, True, tuple(history))
        if promised > STALLED * before or matrix.damping:
            matrix.renew()
            promised = np.inf
        before = promised
    return Estimate(state.points, state.cost, config.max_iterations, False, tuple(history))


def _step(
    cost: JointCost, fronts: Fronts, state: State, matrix: _Matrix, gauge: Gauge
) -> tuple[State, float]:
    """Return the next state and the decrease that the step promised; the same state if none."""
    gradient = derivatives.gradient(cost, state)
    while True:
        if matrix.factor is None:
            matrix.fresh = True
            matrix.factor = _factorised(cost, fronts, state, matrix.damping, gauge)
        if matrix.factor is not None:
            step = -matrix.factor.solve(gradient.ravel()).reshape(-1, 3)
            promised = -float(np.sum(gradient * step))
            better = matrix.acceleration.improved(state.points, gradient, step)
            trial = cost.evaluate(state.points + better)
            # An old matrix may overshoot; what that shows is worth more than the rise.
            if trial.cost <= state.cost + (0.0 if matrix.fresh else promised):
                return trial, promised
            if promised <= ROUNDING * state.cost:
                return state, 0.0
        harder = max(FIRST_DAMPING, matrix.damping * DAMPING_STEP) if matrix.fresh else 0.0
        if harder > MAX_DAMPING:
            _check_determined(gradient, state)
            return state, 0.0
        matrix.renew(harder)


def _check_determined(gradient: Floats, state: State) -> None:
    if not (np.isfinite(gradient).all() and np.isfinite(state.cost)):
        raise DegenerateGeometry('a shared landmark is not determined by the sub-maps together')


def _factorised(
    cost: JointCost, fronts: Fronts, state: State, damping: float, gauge: Gauge
) -> Factor | None:
    try:
        return factorise(fronts, gauss_newton(cost, state, gauge, damping))
    except np.linalg.LinAlgError:
        return None


def plan(cost: JointCost, points: Floats, last: Mask | None = None) -> Fronts:
    """Fronts for maps that lie where their landmarks (tracks, 3) are."""
    segments = cost.segments
    places = segments.sums(points[cost.tracks]) / segments.lengths[:, None]
    tree = dissect(places, segments.owners, cost.tracks)
    tracks = np.split(cost.tracks, segments.ends[1:-1])
    return plan_fronts(tree, tracks, len(points), last)


def gauss_newton(
    cost: JointCost,
    state: State,
    gauge: Gauge | None = None,
    damping: float = 0.0,
) -> Elements:
    """
    J'J of each map at a state.

    With a `gauge`, the frame of the result is held by the landmarks of one map in the middle.
    """
    low_rank = derivatives.low_rank(cost, state)
    holder = _middle(cost, state.points) if gauge else -1

    def element(k: int) -> Floats:
        jacobian = derivatives.jacobian(cost, k, state, low_rank)
        matrix: Floats = jacobian.T @ jacobian
        diagonal = np.einsum('ii->i', matrix)
        typical = diagonal.mean()
        if damping:
            diagonal *= 1.0 + damping
        if gauge and k == holder:
            rows = cost.segments.rows(k)
            used = cost.weights[rows] > 0.0
            held = gauge_basis(state.points[cost.tracks[rows][used]], gauge)
            at = np.flatnonzero(np.repeat(used, 3))
            matrix[np.ix_(at, at)] += typical * held @ held.T
        return matrix

    return element


def _middle(cost: JointCost, points: Floats) -> int:
    """Map nearest to the middle of all, among those with many landmarks."""
    segments = cost.segments
    shared = segments.counts(cost.weights > 0.0)
    places = segments.sums(points[cost.tracks]) / segments.lengths[:, None]
    distances = np.linalg.norm(places - np.median(places, axis=0), axis=1)
    distances[shared < np.median(shared)] = np.inf
    return int(np.argmin(distances))
