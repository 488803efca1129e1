# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A joint merge near its optimum, for the statistics: `Quadratic` with its inverse by fronts."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.blas import add_square, mirror
from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.fusion.element import coordinates
from mapmerge_ros.fusion.joint import derivatives
from mapmerge_ros.fusion.joint.cost import JointCost, State
from mapmerge_ros.fusion.joint.coupling import middle
from mapmerge_ros.fusion.joint.covariance import Gathering, Uncertainty
from mapmerge_ros.fusion.joint.factorise import factorise
from mapmerge_ros.fusion.joint.minimise import held_by, plan
from mapmerge_ros.fusion.quadratic import Members, Quadratic
from mapmerge_ros.geometry import Gauge, gauge_basis


def near_optimum(
    cost: JointCost,
    state: State,
    gauge: Gauge,
    sigma: float,
    learn: Callable[[Uncertainty], None] | None = None,
) -> Quadratic:
    """
    Quadratic of a merge at its optimum, every landmark shared; `gauge` is that of the result.

    `quadratic` of the same elements is its plain form. `sigma` [px] is the noise of a residual of
    unit weight. When somebody has asked for the blocks of the inverse, `learn` is told what they
    say of landmarks and frames: it comes by on the way.
    """
    lengths = cost.segments.lengths
    members = Members(
        maps=cost.segments.owners,
        rows=np.arange(len(cost.tracks)) - np.repeat(cost.segments.ends[:-1], lengths),
        tracks=cost.tracks,
    )
    information = _informations(cost, state, sigma)
    return Quadratic(
        members,
        information,
        derivatives.by_members(cost, state) / sigma**2,
        state.points,
        tuple(Gauge(int(own)) for own in cost.gauges),
        gauge,
        state.cost / sigma**2,
        lambda: FrontInverse(cost, state, gauge, sigma, information, learn),
    )


class FrontInverse:
    """
    `Inverse` from the factor of a multifrontal elimination.

    Blocks of sub-maps come by as the inverse of the leaves (`Factor.inverse_blocks`), so that all
    of them cost twice the factorisation.
    """

    def __init__(
        self,
        cost: JointCost,
        state: State,
        gauge: Gauge,
        sigma: float,
        information: tuple[Floats, ...],
        learn: Callable[[Uncertainty], None] | None,
    ) -> None:
        """
        Factorise H, its frame held by the sub-map in the middle.

        Raises
        ------
        DegenerateGeometry
            The landmarks are not determined by the sub-maps together.

        """
        holder = middle(cost, state.points)

        def element(k: int, order: Ints, out: Floats) -> None:
            at = coordinates(order)
            np.take(np.take(information[k], at, axis=0), at, axis=1, out=out.T, mode='clip')
            if k == holder:
                held_by(cost, state, gauge, k, order, out)

        try:
            self._factor = factorise(plan(cost, state.points), element)
        except np.linalg.LinAlgError:
            raise DegenerateGeometry('a merged landmark is not determined') from None
        self._null = gauge_basis(state.points, gauge)
        self._learn = learn
        self._gathering = Gathering(cost, state, gauge, self._factor, sigma) if learn else None

    def solve(self, right: Floats) -> Floats:
        """Solve for right-hand sides (3n, m); the map as a whole does not move."""
        moved = self._factor.solve(right)
        moved -= self._null @ (self._null.T @ moved)
        return moved

    def blocks(self) -> Iterator[tuple[int, Floats]]:
        """Each sub-map with its own block (3s_k, 3s_k)."""
        for front, block in self._factor.inverse_blocks():
            if self._gathering:
                self._gathering.take(front, block)
            if front.leaf >= 0:
                at = coordinates(np.argsort(front.leaf_order))
                yield front.leaf, block[np.ix_(at, at)]
        if self._learn and self._gathering:
            self._learn(self._gathering.uncertainty())


def _informations(cost: JointCost, state: State, sigma: float) -> tuple[Floats, ...]:
    """L_k (3s_k, 3s_k) of every sub-map."""
    jacobians, lengths = derivatives.Jacobians(cost, state), cost.segments.lengths
    found = []
    for k, length in enumerate(lengths):
        information = np.empty((3 * length, 3 * length), order='F')
        add_square(information, jacobians.of(k, np.arange(length)).T, 1.0 / sigma**2, beta=0.0)
        mirror(information)
        found.append(information)
    return tuple(found)
