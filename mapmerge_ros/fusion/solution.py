# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Every landmark and frame of a component, found by one merge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapmerge_ros.arrays import Ints, Mask
from mapmerge_ros.fusion.associate import Association
from mapmerge_ros.fusion.config import FusionConfig
from mapmerge_ros.fusion.joint.cost import JointCost, State
from mapmerge_ros.fusion.joint.factor import Carried, Factor
from mapmerge_ros.fusion.joint.resume import Members, Resumable, resume
from mapmerge_ros.fusion.merge import Estimate
from mapmerge_ros.fusion.noise import Noise
from mapmerge_ros.fusion.overlap import Link
from mapmerge_ros.fusion.search import search
from mapmerge_ros.fusion.verify import degrees_of_freedom, verify
from mapmerge_ros.fusion.warm import Warm
from mapmerge_ros.geometry import Similarity
from mapmerge_ros.submap import SubMap


@dataclass(frozen=True, slots=True)
class Anchor:
    """The sub-map that holds a global frame still, and where it is in there."""

    map_id: str
    S_global_map: Similarity


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Every landmark and frame: `state`; the shared ones as merged: `estimate` of `reduced`."""

    cost: JointCost
    reduced: JointCost
    state: State
    estimate: Estimate
    dof: int
    rows: tuple[Ints, ...]
    """Per sub-map, rows of its shared landmarks among the compressed ones"""
    members: Members
    """Of `reduced`"""

    def resumable(self, factor: Factor) -> Resumable:
        """
        What the next merge may begin with, given a factor at the optimum.

        It is that of all landmarks: its inverse restricted to the shared ones is theirs. Made at
        the optimum it saves half of the steps that the factor of the merge's start would need.
        """
        shared = np.unique(self.cost.tracks[self.cost.is_shared])
        carried = Carried(factor, shared)
        return Resumable(self.members, self.state.points[shared], carried, self.reduced)


def solve(
    submaps: Sequence[SubMap],
    association: Association,
    links: Sequence[Link],
    noise: Noise,
    anchor: Anchor,
    config: FusionConfig,
    warm: Warm,
) -> Solution:
    """
    Merge sub-maps that hang together, from where `warm` knows them to have been.

    Raises
    ------
    DegenerateGeometry
        A landmark or a frame is not determined.

    """
    gauge = min(submap.gauge for submap in submaps)
    views = association.views
    is_shared: Mask = views > 1 if len(submaps) > 1 else np.ones(association.count, bool)
    dof = degrees_of_freedom(views, [submap.gauge for submap in submaps], gauge)
    informations = warm.informations(submaps)
    cost = JointCost.of(submaps, association.tracks, is_shared, noise.weights, informations)
    reduced = cost.reduced()
    members = _members(submaps, cost, reduced)
    last = warm.last_merge(members.map_ids)
    estimate = search(
        reduced,
        links,
        gauge,
        lambda price: verify(price, dof, noise, config).accepted,
        config,
        resume(reduced, members, last) if last else None,
    )
    warm.learn_merge(Resumable(members, estimate.points, estimate.matrix))
    state = estimate.state if reduced is cost else None
    if state is None:
        state = cost.evaluate(cost.recover_private(estimate.points, association.count))
    held = [submap.map_id for submap in submaps].index(anchor.map_id)
    S_global_estimate = anchor.S_global_map @ state.S_map_globals[held]
    return Solution(
        cost,
        reduced,
        state.after(S_global_estimate),
        replace(
            estimate,
            points=S_global_estimate.apply(estimate.points),
            matrix=None,
            state=None,
        ),
        dof,
        tuple(np.flatnonzero(is_shared[own]) for own in association.tracks),
        members,
    )


def _members(submaps: Sequence[SubMap], cost: JointCost, reduced: JointCost) -> Members:
    ids = np.concatenate([submap.compressed_ids for submap in submaps])
    shared = ids if reduced is cost else ids[cost.is_shared]
    return Members.of(reduced, [submap.map_id for submap in submaps], shared)
