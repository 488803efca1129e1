# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What goes out beside the optimum: standard deviations, frames, and R̄ of the kept landmarks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapmerge_ros.arrays import Floats, Mask
from mapmerge_ros.fusion.compress import Normal, frame_covariance, normal_equations
from mapmerge_ros.fusion.joint.cost import JointCost, State
from mapmerge_ros.fusion.joint.covariance import Uncertainty, schur_complement, uncertainty
from mapmerge_ros.fusion.joint.factor import Factor
from mapmerge_ros.fusion.valley import LOOSE_TURN_RAD, as_wide_as_it_is
from mapmerge_ros.geometry import Gauge

LARGEST_BENT = 700
"""
Landmarks up to which a bent region is followed: a hundred dense inverses, a minute at that size.

Beyond, the ellipsoid has to do.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Knowledge:
    """How sure a merge is."""

    std: Floats
    """(tracks, 3) in the gauge without preferred landmark"""
    frames: Floats
    """(maps, 7, 7) covariance of each frame, left tangent of S_global_map"""
    normal: Normal
    """Of the kept landmarks, all others eliminated"""
    factor: Factor | None
    """Of the Gauss-Newton matrix at the optimum: see `Uncertainty`"""


def knowledge(
    cost: JointCost,
    state: State,
    gauge: Gauge,
    sigma: float,
    keep: Mask,
    found: Uncertainty | None = None,
) -> Knowledge:
    """
    Collect what is known at the optimum; wider than an ellipsoid where the region bends.

    `found` is the uncertainty there, if it is known already.

    Raises
    ------
    DegenerateGeometry
        A landmark is not determined.

    """
    found = found or uncertainty(cost, state, gauge, sigma)
    turns = np.linalg.eigvalsh(found.frames[:, :3, :3])[:, -1]
    if len(cost) > 1 and len(keep) <= LARGEST_BENT and not turns.max() < LOOSE_TURN_RAD**2:
        return _bent(cost, state, gauge, sigma, keep, found.factor)
    variances = np.diagonal(found.landmarks, axis1=1, axis2=2)
    normal = schur_complement(cost, state, keep, gauge)
    return Knowledge(np.sqrt(np.maximum(variances, 0.0)), found.frames, normal, found.factor)


def _bent(
    cost: JointCost, state: State, gauge: Gauge, sigma: float, keep: Mask, factor: Factor | None
) -> Knowledge:
    elements = cost.elements()
    placements = [element.place(state.points) for element in elements]
    straight = normal_equations(elements, state.points, placements, gauge)
    normal, covariance = as_wide_as_it_is(elements, placements, straight, sigma)
    frames = [
        frame_covariance(element, placement, covariance)
        for element, placement in zip(elements, placements, strict=True)
    ]
    variances = np.maximum(np.diag(covariance), 0.0).reshape(-1, 3)
    return Knowledge(np.sqrt(variances), np.array(frames), normal.without(~keep), factor)
