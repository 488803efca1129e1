# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The joint merge: few matrices or none, many cheap steps with the exact gradient."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from mapmerge_ros.arrays import Floats, Ints, Mask
from mapmerge_ros.blas import add_square
from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.fusion.config import FusionConfig
from mapmerge_ros.fusion.joint import derivatives
from mapmerge_ros.fusion.joint.acceleration import Acceleration
from mapmerge_ros.fusion.joint.balancing import balanced, pays
from mapmerge_ros.fusion.joint.cost import JointCost, State
from mapmerge_ros.fusion.joint.coupling import middle
from mapmerge_ros.fusion.joint.dissection import dissect
from mapmerge_ros.fusion.joint.factor import Carried, Factor
from mapmerge_ros.fusion.joint.factorise import Elements, factorise
from mapmerge_ros.fusion.joint.fronts import Fronts, plan_fronts
from mapmerge_ros.fusion.joint.trust import Trust
from mapmerge_ros.fusion.merge import (
    DAMPING_STEP,
    FIRST_DAMPING,
    MAX_DAMPING,
    Estimate,
    negligible,
)
from mapmerge_ros.geometry import Gauge, gauge_basis

STALLED = 0.5
"""
Share of a new matrix' promise from which its second step counts as slow: then it is outdated at
once, as in a bent valley, where only Gauss-Newton with a matrix for each step gets on.
"""

ROUNDING = 1e-12
"""Share of the cost below which a step that does not lower it is rounding."""


FIRST_RATE = 6.0
"""
Rate of the second step at most, over the square root of that of the first.

The first gets rid of what was far off: gains fall by 1e-4 to 1e-7 there, and by 1e-2 to 1e-4 next,
as a factor is in float32 and that of another place. Of fleets of all gauges it was up to 5.6.
"""

LEAST_PROMISED = 0.55
"""Share of what is still to be had that a step promises at least: balanced ones 0.57."""


class Solver(Protocol):
    """Stands for the inverse of a matrix."""

    @property
    def trust(self) -> Trust:
        """Say how long to go on with it."""

    def solve(self, right: Floats) -> Floats:
        """Solve for a right-hand side (size,)."""


@dataclass(slots=True)
class _Matrix:
    """What stands for the inverse of the Gauss-Newton matrix, and how steps with it have gone."""

    solver: Solver | None = None
    """What stands for its inverse: balanced steps, a factor, or that of an earlier merge"""
    factor: Factor | None = None
    """Last factor that was made here"""
    may_balance: bool = True
    """Whether balanced steps have not been tried"""
    acceleration: Acceleration = field(default_factory=Acceleration)
    damping: float = 0.0
    fresh: bool = False
    """A factor of the matrix at the current landmarks"""
    fronts: Fronts | None = None

    @property
    def is_own(self) -> bool:
        """Whether it is a factor that was made here."""
        return self.solver is not None and self.solver is self.factor

    def renew(self, damping: float = 0.0) -> None:
        """Ask for a factor of the current landmarks."""
        self.solver, self.damping = None, damping
        self.acceleration.forget()

    def kept(self, carried: Carried | None) -> Carried | None:
        """Return what the next merge may begin with."""
        if self.factor is None:
            return carried if self.solver is carried else None  # outdated, else
        if not self.factor.fits:
            return None
        return Carried(self.factor, np.arange(self.factor.fronts.size // 3))

    def make(self, cost: JointCost, state: State, gauge: Gauge) -> None:
        """
        Prepare steps at the current landmarks.

        In a fleet they are balanced ones first. Where these do not get on, a factor is made, in
        the memory of the last one.
        """
        if self.may_balance and pays(cost):
            self.may_balance = False
            with suppress(np.linalg.LinAlgError):
                self.solver = balanced(cost, state)
            if self.solver is not None:
                return
        self.fresh = True
        self.fronts = self.fronts or plan(cost, state.points)
        storage = self.factor.storage if self.factor else None
        self.factor = None
        try:
            elements = gauss_newton(cost, state, gauge, self.damping)
            # Rounded after it is made, a factor is still one of a positive definite matrix.
            self.solver = self.factor = factorise(
                self.fronts, elements, dtype=np.float32, storage=storage
            )
        except np.linalg.LinAlgError:
            self.solver = None


def minimise(
    cost: JointCost,
    points: Floats,
    gauge: Gauge,
    config: FusionConfig,
    carried: Carried | None = None,
) -> Estimate:
    """
    Minimise the cost over the landmarks, from `points` (tracks, 3).

    `gauge` is that of the result: the smallest among the sub-maps. The matrix of an earlier
    merge (`carried`) serves as long as its steps get on.

    Raises
    ------
    DegenerateGeometry
        The landmarks are not determined by the sub-maps together.

    """
    state, rounding = cost.evaluate(points), cost.rounding
    dof = cost.residual_count - points.size + int(gauge)
    matrix = _Matrix(solver=carried)
    history, promises = [state.cost], list[float]()
    for iteration in range(1, config.max_iterations + 1):
        matrix.fresh, before = False, matrix.solver
        state, promised = _step(cost, state, matrix, gauge)
        history.append(state.cost)
        enough = max(negligible(state.cost, dof, config), rounding)
        promises = [promised] if matrix.solver is not before else [*promises, promised]
        if _left(promises) <= enough:
            kept = matrix.kept(carried)
            return Estimate(
                state.points, state.cost, iteration, True, tuple(history), matrix=kept, state=state
            )
        if matrix.damping or _is_outdated(
            promises, enough, matrix, config.max_iterations - iteration
        ):
            matrix.renew()
    return Estimate(
        state.points, state.cost, config.max_iterations, False, tuple(history), state=state
    )


def _left(promises: list[float]) -> float:
    """Decrease that is still to be had, at the slower rate of the last two steps."""
    last = promises[-1]
    if last <= 0.0:
        return 0.0  # rounding
    rates = np.array(promises[1:]) / np.array(promises[:-1])
    rates[:1] = FIRST_RATE * np.sqrt(rates[:1])
    return last / LEAST_PROMISED * min(1.0, float(rates[-2:].max())) if len(rates) else last


def _is_outdated(promises: list[float], enough: float, matrix: _Matrix, allowed: int) -> bool:
    """
    Whether a factorisation costs less than the steps that are left with this matrix.

    Or whether these are more than are `allowed`.
    """
    if len(promises) == 2 and matrix.is_own:
        return promises[1] > STALLED * promises[0]
    if matrix.solver is None or len(promises) < matrix.solver.trust.patience:
        return False
    decades = np.log(promises[-3] / promises[-1]) / 2.0  # two steps, as one may well overshoot
    return bool(np.log(promises[-1] / enough) > min(matrix.solver.trust.worth, allowed) * decades)


def _step(cost: JointCost, state: State, matrix: _Matrix, gauge: Gauge) -> tuple[State, float]:
    """Return the next state and the decrease that the step promised; the same state if none."""
    gradient = derivatives.gradient(cost, state)
    while True:
        if matrix.solver is None:
            matrix.make(cost, state, gauge)
        if matrix.solver is not None:
            step = -matrix.solver.solve(gradient.ravel()).reshape(-1, 3)
            promised = -float(np.sum(gradient * step))
            rounding = ROUNDING * state.cost
            # A changed factor may be indefinite, and then promises to raise the cost.
            if matrix.fresh or -rounding <= promised < np.inf:
                better = matrix.acceleration.improved(state.points, gradient, step)
                trial = _evaluated(cost, state.points + better, matrix)
                overshoot = 0.0 if matrix.fresh else matrix.solver.trust.overshoot
                allowed = state.cost + overshoot * promised
                if trial is not None and trial.cost <= allowed:
                    return trial, promised
                if promised <= rounding:
                    return state, 0.0
        harder = max(FIRST_DAMPING, matrix.damping * DAMPING_STEP) if matrix.fresh else 0.0
        if harder > MAX_DAMPING:
            _check_determined(gradient, state)
            return state, 0.0
        matrix.renew(harder)


def _evaluated(cost: JointCost, points: Floats, matrix: _Matrix) -> State | None:
    """Return the state at landmarks; none where a step of an outdated matrix led nowhere."""
    try:
        return cost.evaluate(points)
    except DegenerateGeometry:
        if matrix.fresh:
            raise
        return None


def _check_determined(gradient: Floats, state: State) -> None:
    if not (np.isfinite(gradient).all() and np.isfinite(state.cost)):
        raise DegenerateGeometry('a shared landmark is not determined by the sub-maps together')


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
    jacobians = derivatives.Jacobians(cost, state)
    holder = middle(cost, state.points) if gauge else -1

    def element(k: int, order: Ints, out: Floats) -> None:
        add_square(out, jacobians.of(k, order).T, beta=0.0)
        if damping:
            diagonal = np.einsum('ii->i', out)
            diagonal *= 1.0 + damping
        if gauge and k == holder:
            held_by(cost, state, gauge, k, order, out)

    return element


def held_by(cost: JointCost, state: State, gauge: Gauge, k: int, order: Ints, out: Floats) -> None:
    """
    Add to the element of map k, its landmarks in this order, what holds the whole frame.

    Like the element itself it is right on and below the diagonal.
    """
    rows = np.arange(cost.segments.ends[k], cost.segments.ends[k + 1])[order]
    used = cost.weights[rows] > 0.0
    if not gauge:
        return
    basis = gauge_basis(state.points[cost.tracks[rows][used]], gauge)
    held = np.zeros((len(rows), 3, basis.shape[1]))
    held[used] = basis.reshape(-1, 3, basis.shape[1])
    size = np.einsum('ii->i', out).reshape(-1, 3)[used].mean()
    add_square(out, np.asfortranarray(held.reshape(len(out), -1)), size)
