# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
The joint merge: all landmarks and all frames at once (eq. 9, with c and weights).

With the gauge as a hard constraint every T_k is a closed-form function of the landmarks, so
that only the shared landmarks are iterated. This is the plain, dense form, against which
`joint.minimise` is tested; its `assemble` serves regions that bend.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from mapmerge_ros.arrays import Floats
from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.fusion.config import FusionConfig
from mapmerge_ros.fusion.element import Element, Placement, coordinates
from mapmerge_ros.fusion.joint.cost import State
from mapmerge_ros.fusion.joint.factor import Carried
from mapmerge_ros.geometry import Gauge, gauge_basis

FIRST_DAMPING, DAMPING_STEP, MAX_DAMPING = 1e-6, 10.0, 1e6


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """Shared landmarks at the optimum, with the evidence of how they were reached."""

    points: Floats
    """(tracks, 3) global frame"""
    cost: float
    """ã: price of merging, px²"""
    iterations: int
    converged: bool
    history: tuple[float, ...]
    """Cost before each step"""
    starts: int = 1
    """Starts that were tried to find it"""
    matrix: Carried | None = None
    """Factor of the last Gauss-Newton matrix, where it is small enough to be kept"""
    state: State | None = None
    """Frames and costs at the optimum, where `joint.minimise` found it"""


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    points: Floats
    placements: tuple[Placement, ...]
    cost: float


def merge(
    elements: Sequence[Element], points: Floats, gauge: Gauge, config: FusionConfig
) -> Estimate:
    """
    Minimise the sum of the elements over the global landmarks, from `points` (tracks, 3).

    Gauss-Newton with the exact element; damped (Levenberg-Marquardt) only where a step does
    not lower the cost. `gauge` is that of the result: the smallest among the elements.

    Raises
    ------
    DegenerateGeometry
        The landmarks are not determined by the elements together.

    """
    state = _evaluate(elements, points)
    history = [state.cost]
    dof = sum(len(element.c) for element in elements) - points.size + int(gauge)
    for iteration in range(1, config.max_iterations + 1):
        matrix, gradient = assemble(elements, state.placements, state.points.size)
        state, promised = _step(elements, state, matrix, gradient, gauge)
        history.append(state.cost)
        if promised <= max(negligible(state.cost, dof, config), np.finfo(float).tiny):
            return _finish(state, iteration, True, history)
    return _finish(state, config.max_iterations, False, history)


def negligible(cost: float, dof: int, config: FusionConfig) -> float:
    """
    Decrease [px²] of a step that hardly matters beside the noise.

    What a step to the optimum would gain is the squared distance to it, in units of the covariance
    over σ²; σ² is what the cost itself says.
    """
    return config.convergence**2 * cost / max(dof, 1)


def assemble(
    elements: Sequence[Element], placements: Sequence[Placement], size: int
) -> tuple[Floats, Floats]:
    """Gauss-Newton matrix (size, size) and gradient (size,) of all elements."""
    matrix, gradient = np.zeros((size, size)), np.zeros(size)
    for element, placement in zip(elements, placements, strict=True):
        own_matrix, own_gradient = element.derivatives(placement)
        at = coordinates(element.tracks)
        matrix[np.ix_(at, at)] += own_matrix
        gradient[at] += own_gradient
    return matrix, gradient


def _evaluate(elements: Sequence[Element], points: Floats) -> _State:
    placements = tuple(element.place(points) for element in elements)
    residuals = [
        element.residuals(placement)
        for element, placement in zip(elements, placements, strict=True)
    ]
    return _State(points, placements, float(sum(e @ e for e in residuals)))


def _step(
    elements: Sequence[Element],
    state: _State,
    matrix: Floats,
    gradient: Floats,
    gauge: Gauge,
) -> tuple[_State, float]:
    """Return the next state and the decrease that the step promised; the same state if none."""
    null = gauge_basis(state.points, gauge)
    diagonal = np.diag(matrix).copy()
    fixed = matrix + diagonal.mean() * null @ null.T
    damping = 0.0
    while damping <= MAX_DAMPING:
        try:
            factor = scipy.linalg.cho_factor(
                fixed + np.diag(damping * diagonal), check_finite=False
            )
        except np.linalg.LinAlgError:
            damping = max(FIRST_DAMPING, damping * DAMPING_STEP)
            continue
        step = -scipy.linalg.cho_solve(factor, gradient, check_finite=False)
        promised = -float(gradient @ step)
        trial = _evaluate(elements, state.points + step.reshape(-1, 3))
        if trial.cost <= state.cost:
            return trial, promised
        if promised <= 1e-12 * state.cost:
            return state, 0.0  # what is left is rounding
        damping = max(FIRST_DAMPING, damping * DAMPING_STEP)
    if not np.isfinite(diagonal).all() or (diagonal <= 0.0).any():
        raise DegenerateGeometry('a shared landmark is not determined by the sub-maps together')
    return state, 0.0


def _finish(state: _State, iterations: int, converged: bool, history: list[float]) -> Estimate:
    return Estimate(state.points, state.cost, iterations, converged, tuple(history))
