# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""From the global map back to a robot: its cameras and landmarks, corrected."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapmerge_ros.arrays import Floats, Ids, Ints
from mapmerge_ros.bundle import Bundle
from mapmerge_ros.bundle.relinearise import relinearise
from mapmerge_ros.fusion.names import private_names
from mapmerge_ros.geometry import Similarity, align
from mapmerge_ros.submap import SubMap, symmetric_from_upper

STEP_RATIO = 1e-3
"""
A round whose landmarks all move by less, in standard deviations, is not worth a message.

Convergence is quadratic: what is left after it is a millionth.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Corrected:
    """A bundle that agrees with the global map."""

    map_id: str
    global_frame: str
    bundle: Bundle
    """In the robot's own frame; shared points where the fusion found them, the rest at its best"""
    S_global_map: Similarity
    shared: int
    """Landmarks that it has from the global map"""
    step_ratio: float
    """Largest move of one of them, in standard deviations of the robot's own triangulation"""

    @property
    def positions_global(self) -> Floats:
        """Camera centres (m, 3)."""
        R, t = self.bundle.rotations_camera_map, self.bundle.translations_camera_map
        return self.S_global_map.apply(-np.einsum('mji,mj->mi', R, t))

    @property
    def rotations_global_camera(self) -> Floats:
        """Rotations (m, 3, 3) of the optical frames."""
        turned: Floats = self.S_global_map.rotation @ np.swapaxes(
            self.bundle.rotations_camera_map, 1, 2
        )
        return turned

    @property
    def points_global(self) -> Floats:
        """(n, 3) in the order of the bundle's points."""
        return self.S_global_map.apply(self.bundle.points)


def correct(bundle: Bundle, announced: SubMap, global_map: SubMap) -> Corrected | None:
    """
    Let a bundle follow the landmarks that it shares with the global map; None if too few.

    Only landmarks that the global map is compressed to count: the others are not estimates of
    the merge. Of private ids a robot knows those that are named after its own landmarks.

    Raises
    ------
    DegenerateGeometry
        The landmarks do not hold the cameras.

    """
    ids, rows = shared_landmarks(announced, global_map)
    if 3 * len(ids) <= int(bundle.gauge) + 3:
        return None
    points_global = global_map.points[rows]
    found = relinearise(bundle, ids, points_global).bundle
    own = found.rows_of(ids)
    # The shared points are the global ones in the robot's frame, exactly.
    S_global_map = align(points_global, found.points[own], gauge=bundle.gauge).S_target_source
    moves = np.linalg.norm(found.points[own] - bundle.points[own], axis=1)
    return Corrected(
        map_id=announced.map_id,
        global_frame=global_map.frame_id,
        bundle=found,
        S_global_map=S_global_map,
        shared=len(ids),
        step_ratio=float(np.max(moves / _deviations(announced, ids))),
    )


def shared_landmarks(announced: SubMap, global_map: SubMap) -> tuple[Ids, Ints]:
    """Ids (k,) of a map's landmarks in the global map, and their rows (k,) there."""
    is_common = global_map.id_space == announced.id_space and (
        announced.id_space or len(global_map.sources) == 1
    )
    own = announced.landmark_ids
    names = own if is_common else private_names(announced.map_id, own)
    _, at_own, rows = np.intersect1d(names, global_map.compressed_ids, return_indices=True)
    return own[at_own], rows


def _deviations(announced: SubMap, ids: Ids) -> Floats:
    """Standard deviations (k,) of landmarks by the robot's own account, map units."""
    if announced.covariances is None:
        return np.full(len(ids), np.finfo(float).tiny)
    order = np.argsort(announced.landmark_ids)
    rows = order[np.searchsorted(announced.landmark_ids[order], ids)]
    traces = np.trace(symmetric_from_upper(announced.covariances[rows]), axis1=1, axis2=2)
    deviations: Floats = np.sqrt(np.maximum(traces, np.finfo(float).tiny))
    return deviations
