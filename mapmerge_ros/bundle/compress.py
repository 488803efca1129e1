# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""From a robot's bundle to its compressed sub-map, and back from merged landmarks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from mapmerge_ros.arrays import Floats, Ids, Ints
from mapmerge_ros.bundle.bundle import Bundle
from mapmerge_ros.bundle.dense import eliminate_densely
from mapmerge_ros.bundle.elimination import (
    Elimination,
    held,
    is_determined,
    point_information,
)
from mapmerge_ros.bundle.follow import behind, follow
from mapmerge_ros.bundle.linearise import Linearisation, linearise
from mapmerge_ros.bundle.quality import claimed_variances
from mapmerge_ros.bundle.schur import eliminate_by_schur
from mapmerge_ros.bundle.square_root import eliminate_by_qr
from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.geometry import Similarity, align
from mapmerge_ros.submap import Source, SubMap, alignment_weights, pack, upper_from_symmetric

Method = Literal['auto', 'schur', 'qr', 'dense']

_ELIMINATE: dict[str, Callable[[Linearisation, Ints], Elimination]] = {
    'schur': eliminate_by_schur,
    'qr': eliminate_by_qr,
    'dense': eliminate_densely,
}


@dataclass(frozen=True, slots=True)
class MapName:
    """Who made a map, when, and in which frame."""

    map_id: str
    robot_id: str
    revision: int = 1
    stamp_ns: int = 0
    frame_id: str = ''
    """Empty: the map_id"""
    id_space: str = ''


def eliminate(lin: Linearisation, shared_rows: Ints, method: Method = 'auto') -> Elimination:
    """
    Eliminate all but the shared landmarks: (a, R, c) and ds/dq.

    `auto` takes Schur complements, and QR in blocks where those lose too many digits.

    Raises
    ------
    DegenerateGeometry
        Too few shared landmarks for the cameras, or some that are not determined.

    """
    if method != 'auto':
        return _ELIMINATE[method](lin, shared_rows)
    if is_determined(point_information(lin)).all():
        try:
            return eliminate_by_schur(lin, shared_rows)
        except DegenerateGeometry:
            pass
    return eliminate_by_qr(lin, shared_rows)


def compress(
    bundle: Bundle,
    name: MapName,
    landmark_ids: Ids,
    *,
    catalogue: bool = True,
    method: Method = 'auto',
    dtype: type[np.floating[Any]] = np.float32,
) -> SubMap:
    """
    Compress a bundle to the given landmarks; the other points travel as catalogue.

    `landmark_ids` (m,) are the bundle's points that R is to be about; none makes a bare
    announcement. `catalogue` says whether position and descriptor of the others go along.
    R is float32 as on the wire, unless `dtype` says float64. A point without parallax has a huge
    covariance.

    Raises
    ------
    InvalidValue
        An id that the bundle does not have.
    DegenerateGeometry
        Too few landmarks to hold the cameras, or some that are not determined.

    """
    lin = linearise(bundle)
    shared_rows = bundle.rows_of(np.asarray(landmark_ids, np.uint64))
    private_rows = np.setdiff1d(np.arange(len(bundle.point_ids)), shared_rows)
    rows = np.concatenate([shared_rows, private_rows if catalogue else private_rows[:0]])
    found = eliminate(lin, shared_rows, method) if len(shared_rows) else _announced(lin)
    residual_count, dof = bundle.residual_count, bundle.dof
    # An announcement eliminates nothing: its residuals are taken as those of an optimum.
    cost_px2 = found.a**2 if len(shared_rows) else lin.cost_px2
    variance = bundle.sigma_px**2 or cost_px2 / max(residual_count - dof, 1)
    variances = claimed_variances(lin, variance)[rows]
    covariances = variances[:, None, None] * np.linalg.inv(held(point_information(lin)[rows]))
    return SubMap(
        map_id=name.map_id,
        robot_id=name.robot_id,
        revision=name.revision,
        stamp_ns=name.stamp_ns,
        frame_id=name.frame_id or name.map_id,
        sources=(Source(name.map_id, name.revision),),
        gauge=bundle.gauge,
        id_space=name.id_space,
        landmark_ids=bundle.point_ids[rows],
        points=bundle.points[rows],
        covariances=upper_from_symmetric(covariances),
        compressed_count=len(shared_rows),
        a=found.a,
        packed_r=pack(found.r).astype(dtype),
        c=found.c,
        residual_count=residual_count,
        dof=dof,
        sigma=bundle.sigma_px,
        descriptors=bundle.descriptors[rows],
    )


def _announced(lin: Linearisation) -> Elimination:
    """No landmark is left; the cost is that of the working point, whoever estimates σ from it."""
    nothing, no_rows = np.zeros(0), np.zeros((0, 0))
    return Elimination(
        lin.cost_px2**0.5, no_rows, nothing, no_rows, nothing, np.zeros(0, np.int64)
    )


def into_map(bundle: Bundle, rows: Ints, found: Elimination, points_global: Floats) -> Similarity:
    """S_map_global as the fusion places this map: hard gauge, weighted by information."""
    return align(
        bundle.points[rows],
        points_global,
        gauge=bundle.gauge,
        weights=alignment_weights(found.r),
        scale='tangent',
    ).S_target_source


@dataclass(frozen=True, slots=True, eq=False)
class Update:
    """A robot's map after the fusion side has moved its landmarks."""

    bundle: Bundle
    """in the robot's own frame"""
    S_map_global: Similarity
    """from the frame of the landmarks that came in"""
    left_out_ids: Ids
    """(l,) landmarks that would be behind a camera, which had no say"""


def update(
    bundle: Bundle, landmark_ids: Ids, points_global: Floats, method: Method = 'auto'
) -> Update:
    """
    Cameras and points of a bundle that follow from merged landmarks, by ds/dq (eq. 4).

    `points_global` (k, 3) is first taken into the robot's frame, in the group of its gauge. A
    landmark that would come to lie behind a camera of this robot is left out: its merged place is
    no better than a guess.

    Raises
    ------
    InvalidValue
        An id that the bundle does not have.
    DegenerateGeometry
        Too few landmarks to hold the cameras or to align the frames.

    """
    lin, ids = linearise(bundle), np.asarray(landmark_ids, np.uint64)
    rows, left_out = bundle.rows_of(ids), np.zeros(len(ids), bool)
    while True:
        known = rows[~left_out]
        found = eliminate(lin, known, method)
        S_map_global = into_map(bundle, known, found, points_global[~left_out])
        shared_steps = S_map_global.apply(points_global[~left_out]) - bundle.points[known]
        steps = found.steps(lin, shared_steps)
        lost = np.isin(rows, behind(bundle, *steps[:2])) & ~left_out
        if not lost.any():
            return Update(follow(lin, known, steps), S_map_global, ids[left_out])
        left_out |= lost
