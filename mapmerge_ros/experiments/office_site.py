# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The office of the paper's table: four drones with exactly its points and image points."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mapmerge_ros.arrays import Ids, Ints, Mask
from mapmerge_ros.bundle import Bundle
from mapmerge_ros.simulation import (
    Camera,
    Scene,
    Sensing,
    SimulationError,
    Trajectory,
    look_at,
    observe,
    room_scene,
)
from mapmerge_ros.submap import Descriptors


@dataclass(frozen=True, slots=True)
class Recording:
    """Size of one drone's bundle: a row of the paper's table."""

    keyframes: int
    """Columns of the Jacobian are 6 keyframes + 3 points"""
    points: int
    residuals: int


RECORDINGS = (
    Recording(104, 999, 18918),
    Recording(57, 603, 11972),
    Recording(57, 549, 11114),
    Recording(49, 386, 7596),
)
COMMON = 24
"""Landmarks that all four drones have; all others belong to one."""

ROOM = (5.0, 4.0, 2.5)
"""[m]"""
MIN_VIEWS = 5
"""A shorter track has no parallax where the drone hovers."""

SENSING = Sensing(
    camera=Camera(350.0, 640, 480),
    sigma_px=1.0,
    range_m=(0.5, 8.0),
    detection_ratio=1.0,
    min_views=MIN_VIEWS,
)
"""The paper's drone: 480 x 640 global shutter camera, ORB features."""


def office(rng: np.random.Generator) -> tuple[Scene, tuple[Bundle, ...]]:
    """
    Room, and what is true of each recording in the world frame; point ids are the scene's.

    Raises
    ------
    SimulationError
        A drone does not see as much as its row of the table says.

    """
    scene = room_scene(rng, 1200, ROOM, per_corner=0)
    seen = [observe(rng, scene, _flight(rng, r.keyframes), SENSING) for r in RECORDINGS]
    common, owned = _owners(rng, seen)
    return scene, tuple(
        _tracked(rng, bundle, np.union1d(common, own), recording)
        for bundle, own, recording in zip(seen, owned, RECORDINGS, strict=True)
    )


def _flight(rng: np.random.Generator, keyframes: int) -> Trajectory:
    """A minute in the middle of the room, looking round about a third of it, back and forth."""
    time = np.linspace(0.0, 1.0, keyframes)
    ends = rng.uniform(-1.0, 1.0, (2, 3)) * [0.9, 0.7, 0.4]
    sway = np.sin(2.0 * np.pi * (np.outer(time, [2, 3, 2]) + rng.random(3)))
    centres = ends[0] + time[:, None] * (ends[1] - ends[0]) + 0.25 * sway
    yaw = 0.6 + 1.2 * np.sin(2.0 * np.pi * (time + rng.random())) + 0.2 * rng.normal()
    tilt = 0.1 * rng.normal(size=keyframes)
    view = np.column_stack([np.cos(yaw), np.sin(yaw), tilt])
    return look_at(centres, centres + view, np.array([0.0, 0.0, 1.0]))


def _owners(rng: np.random.Generator, seen: list[Bundle]) -> tuple[Ids, list[Ids]]:
    """Landmarks of all drones, and of each one alone."""
    known = seen[0].point_ids
    for bundle in seen[1:]:
        known = np.intersect1d(known, bundle.point_ids)
    if len(known) < COMMON:
        raise SimulationError(f'office: only {len(known)} landmarks are seen by all drones')
    common = rng.choice(known, COMMON, replace=False)
    owned: list[Ids] = []
    free = np.setdiff1d(np.unique(np.concatenate([b.point_ids for b in seen])), common)
    for bundle, recording in zip(seen, RECORDINGS, strict=True):
        eligible, wanted = np.intersect1d(bundle.point_ids, free), recording.points - COMMON
        if len(eligible) < wanted:
            raise SimulationError(f'office: {len(eligible)} landmarks for a drone with {wanted}')
        owned.append(rng.choice(eligible, wanted, replace=False))
        free = np.setdiff1d(free, owned[-1])
    return common, owned


def _tracked(
    rng: np.random.Generator, seen: Bundle, point_ids: Ids, recording: Recording
) -> Bundle:
    """Some points only, each tracked for a while only; residuals as many as in the table."""
    rows = seen.rows_of(point_ids)
    visible = np.zeros((len(seen.keyframe_ids), len(seen.point_ids)), bool)
    visible[seen.observation_keyframes, seen.observation_points] = True
    pixels = np.zeros((*visible.shape, 2))
    pixels[seen.observation_keyframes, seen.observation_points] = seen.observations_px
    lengths = _track_lengths(rng, visible[:, rows].sum(axis=0), recording.residuals // 2)
    kept = _windows(rng, visible[:, rows], lengths)
    keyframes, points = np.nonzero(kept)
    return replace(
        seen,
        point_ids=point_ids,
        points=seen.points[rows],
        observation_keyframes=keyframes,
        observation_points=points,
        observations_px=pixels[:, rows][kept],
        descriptors=Descriptors.none(len(rows)),
    )


def _track_lengths(rng: np.random.Generator, visible: Ints, total: int) -> Ints:
    """Random lengths (n,) between `MIN_VIEWS` and what is visible, `total` together."""
    lengths = np.full(len(visible), MIN_VIEWS)
    if visible.sum() < total or lengths.sum() > total:
        raise SimulationError(f'office: {total} image points cannot be shared out')
    while missing := total - int(lengths.sum()):
        open_rows = np.flatnonzero(lengths < visible)
        longer = rng.choice(open_rows, min(missing, len(open_rows)))
        np.add.at(lengths, longer, 1)
        np.minimum(lengths, visible, out=lengths)
    return lengths


def _windows(rng: np.random.Generator, visible: Mask, lengths: Ints) -> Mask:
    """Of each column the given number of successive visible rows, from a random one on."""
    order = np.cumsum(visible, axis=0) - 1
    first = rng.integers(0, visible.sum(axis=0) - lengths + 1)
    return np.asarray(visible & (order >= first) & (order < first + lengths))
