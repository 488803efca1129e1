# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A merged component as it goes out: compressed again, with its landmarks and frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from mapmerge_ros.arrays import Floats, Ids, Ints
from mapmerge_ros.fusion.associate import Association
from mapmerge_ros.fusion.compress import Normal, most_useful
from mapmerge_ros.fusion.config import FusionConfig
from mapmerge_ros.fusion.joint.covariance import Uncertainty
from mapmerge_ros.fusion.joint.factor import Factor
from mapmerge_ros.fusion.joint.knowledge import Knowledge, knowledge
from mapmerge_ros.fusion.names import Names, name_landmarks
from mapmerge_ros.fusion.noise import Noise
from mapmerge_ros.fusion.outcome import Component, ErrorModel, Landmarks, Verdict
from mapmerge_ros.fusion.solution import Anchor, Solution
from mapmerge_ros.fusion.tracks import Catalogue, build_catalogue
from mapmerge_ros.geometry import Similarity, scene_radius
from mapmerge_ros.submap import Source, SubMap, most_within, pack
from mapmerge_ros.submap.size import head_bytes, landmark_bytes

LEAST = 3
"""Landmarks that any map keeps: fewer cannot be merged with anything."""


@dataclass(frozen=True, slots=True, eq=False)
class Merged:
    """A component with the frames of its sub-maps."""

    component: Component
    S_global_maps: tuple[Similarity, ...]
    covariances: tuple[Floats, ...]
    """(7, 7) each, see `MapAlignment`"""
    cost_ratios: Floats = field(default_factory=lambda: np.zeros(0))
    """(maps,) cost of each by coordinate, px², where the merge is not believed"""
    factor: Factor | None = None
    """Of the Gauss-Newton matrix at the optimum, for the next merge: see `Uncertainty`"""


def compress_component(
    submaps: Sequence[SubMap],
    association: Association,
    solution: Solution,
    noise: Noise,
    verdict: Verdict,
    anchor: Anchor,
    config: FusionConfig,
    revision: int,
    uncertainty: Uncertainty | None = None,
) -> Merged:
    """
    Compress a merged component again, all frames eliminated.

    `uncertainty` is that of the solution, where it is known already.
    """
    gauge = min(submap.gauge for submap in submaps)
    names = name_landmarks(submaps, association)
    ids = names.of_tracks(association)
    maps_global = solution.state.S_map_globals
    S_global_maps = tuple(maps_global[k].inverse() for k in range(len(submaps)))
    catalogue = build_catalogue(submaps, S_global_maps, association, names)
    # What the merge knows is not left to the mean of where the sub-maps by themselves have it.
    named = ~names.nameless
    catalogue = catalogue.solved(ids[named], solution.state.points[named])
    limit, has_catalogue = _room(submaps, catalogue, names.id_space, config)
    keep = most_useful(np.where(names.nameless, 0, association.views), ids, limit)
    keep &= ~names.nameless
    known = knowledge(solution.cost, solution.state, gauge, noise.sigma, keep, uncertainty)
    component = Component(
        map_ids=tuple(submap.map_id for submap in submaps),
        gauge=gauge,
        anchor=anchor.map_id,
        submap=_global_submap(
            submaps,
            known.normal,
            ids[keep],
            catalogue,
            has_catalogue,
            names.id_space,
            noise,
            verdict,
            config,
            revision,
        ),
        landmarks=_landmarks(
            submaps, association, names, solution.state.points, known, verdict.errors
        ),
        verdict=verdict,
        iterations=solution.estimate.iterations,
        converged=solution.estimate.converged,
        starts=solution.estimate.starts,
        cost_history=solution.estimate.history,
        association=association,
        names=names,
    )
    return Merged(component, S_global_maps, tuple(known.frames), factor=known.factor)


def _room(
    submaps: Sequence[SubMap], catalogue: Catalogue, id_space: str, config: FusionConfig
) -> tuple[int, bool]:
    """Most landmarks that stay compressed, and whether the others go along as catalogue."""
    if not config.max_bytes:
        return config.max_landmarks, config.catalogue
    leaves = {source for submap in submaps for source in submap.sources}
    names = (config.map_id, config.map_id, config.global_frame, id_space)
    room = config.max_bytes - head_bytes(names, leaves)
    has_covariances = catalogue.covariances is not None
    each = landmark_bytes(has_covariances, catalogue.descriptors.size)
    listed = each * len(catalogue.ids)
    has_catalogue = config.catalogue and listed <= room // 2
    most = most_within(room - listed) if has_catalogue else most_within(room, each)
    return min(config.max_landmarks, max(most, LEAST)), has_catalogue


def _landmarks(
    submaps: Sequence[SubMap],
    association: Association,
    names: Names,
    points: Floats,
    known: Knowledge,
    errors: ErrorModel | None,
) -> Landmarks:
    rows = np.concatenate(association.tracks)
    order = np.argsort(rows, kind='stable')
    is_named = ~names.nameless
    order = order[is_named[rows[order]]]
    slots = np.cumsum(is_named) - 1
    maps = [submap.map_id for submap in submaps for _ in range(submap.compressed_count)]
    member_ids = np.concatenate([submap.compressed_ids for submap in submaps])
    return Landmarks(
        ids=names.of_tracks(association)[is_named],
        points_global=points[is_named],
        std=_honest(known.std, points, association.views, errors)[is_named],
        member_rows=slots[rows[order]],
        member_maps=tuple(maps[int(k)] for k in order),
        member_ids=member_ids[order],
    )


def _honest(std: Floats, points: Floats, views: Ints, errors: ErrorModel | None) -> Floats:
    """
    Standard deviations (n, 3) with the errors that the maps have besides noise.

    Each sub-map of a landmark is off by a floor and a warp of its own; what its frame takes of the
    warp is not given back. Noise below what is claimed is not believed, for tracks are not alike.
    """
    if errors is None:
        return std
    radius = scene_radius(points[views > 1])
    other = radius**2 * (errors.tau_ratio**2 + errors.omega_ratio**2) / np.maximum(views, 1)
    honest: Floats = np.sqrt(max(errors.phi, 1.0) * std**2 + other[:, None])
    return honest


def _global_submap(
    submaps: Sequence[SubMap],
    normal: Normal,
    ids: Ids,
    catalogue: Catalogue,
    has_catalogue: bool,
    id_space: str,
    noise: Noise,
    verdict: Verdict,
    config: FusionConfig,
    revision: int,
) -> SubMap:
    r, c = normal.triangle()
    in_r = catalogue.rows(ids)
    others = np.setdiff1d(np.arange(len(catalogue.ids)), in_r)
    rows = np.concatenate([in_r, others if has_catalogue else others[:0]])
    price = verdict.a_tilde - float(c @ c)
    a2 = float(noise.weights @ [submap.a**2 for submap in submaps]) + max(price, 0.0)
    sources: set[Source] = {source for submap in submaps for source in submap.sources}
    return SubMap(
        map_id=config.map_id,
        robot_id=config.map_id.partition('/')[0],
        revision=revision,
        stamp_ns=max(submap.stamp_ns for submap in submaps),
        frame_id=config.global_frame,
        sources=tuple(sorted(sources)),
        gauge=normal.gauge,
        id_space=id_space,
        landmark_ids=catalogue.ids[rows],
        points=np.concatenate([normal.points, catalogue.points_global[rows[len(ids) :]]]),
        covariances=None if catalogue.covariances is None else catalogue.covariances[rows],
        compressed_count=len(ids),
        a=float(np.sqrt(a2)),
        packed_r=pack(r),
        c=c,
        residual_count=sum(submap.residual_count for submap in submaps),
        dof=sum(submap.dof for submap in submaps) - verdict.dof,
        sigma=0.0 if noise.estimated_from else noise.sigma,
        descriptors=catalogue.descriptors[rows],
    )
