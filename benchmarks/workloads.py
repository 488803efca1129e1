# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
Workloads S1 to S5: 4 to 1024 drones over one yard, each with a map of its own, and the truth.

About 60 key frames and 1000 points a drone, about 98 of them matched with neighbours, σ = 0.5 px
at f = 500. Robots bundle by Gauss-Newton from the truth, so that the optimum is theirs and a
thousand sessions take minutes.
"""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mapmerge_ros.arrays import Floats, Ids, Mask
from mapmerge_ros.bundle import Bundle, MapName, compress, linearise
from mapmerge_ros.bundle.compress import eliminate
from mapmerge_ros.bundle.selection import best_tracks
from mapmerge_ros.geometry import Similarity
from mapmerge_ros.io import decode_submap, encode_submap
from mapmerge_ros.simulation import Scene, Sensing, lawn_mower, observe, random_frame, yard_scene
from mapmerge_ros.submap import SubMap

DRONES = {'S1': 4, 'S2': 16, 'S3': 64, 'S4': 256, 'S5': 1024}

CELL, PATH, ALTITUDE = (42.0, 30.0), (28.0, 14.0), 15.0
"""Cell of a drone, extent of its two lanes, height above ground [m]."""

DENSITY, KEYFRAMES = 850, 60
"""Landmarks in a cell, key frames of a drone."""

SHARED_PER_DRONE = 46.6
"""
Landmarks that are matched between drones, over drones: half of a drone's own 98 or so.

A seventh of what several drones see; the others are points of their own to each of them.
"""

COMMON_IN_S1 = 24
"""Landmarks that all four drones of S1 share, over one and the same place."""

GAUSS_NEWTON_STEPS = 3
"""From the truth to the optimum of half a pixel of noise: the third is below 1e-9 px²."""

SHARED_IN_SESSION = 100
"""Landmarks of a session whose compression is measured."""

MATCHED_VIEWS = 5
"""Key frames that see a landmark which is likely to be matched."""

PRIVATE = np.uint64(2**40)
"""Ids from here on are a drone's own."""


@dataclass(frozen=True, slots=True, eq=False)
class Workload:
    """Messages, what they were made of, and the truth."""

    name: str
    submaps: tuple[SubMap, ...]
    bundles: tuple[Bundle, ...]
    """At their optimum, each in its own frame; empty where they are not wanted or not kept"""
    S_world_maps: tuple[Similarity, ...]
    scene_points: Floats
    """(n, 3) [m]; landmark id i is row i - 1"""
    revised: SubMap
    """Second revision of the sub-map in the middle: the same flight, measured again"""

    def points_world(self, ids: Ids) -> Floats:
        """True positions (k, 3) of shared landmarks."""
        points: Floats = self.scene_points[ids.astype(np.int64) - 1]
        return points


def workload(
    name: str, seed: int = 0, *, drones: int | None = None, mirrored: bool = False
) -> Workload:
    """
    S1 to S5, or the same kind of fleet with another number of drones.

    `mirrored` has the same noise with the opposite sign.
    """
    sign = -1.0 if mirrored else 1.0
    rng, noise = np.random.default_rng([seed, len(name)]).spawn(2)
    count = drones or DRONES[name]
    scene, truths = _flights(rng, count, together=name == 'S1')
    is_common = _common(rng, scene, truths, together=name == 'S1')
    keep = count <= DRONES['S4']
    submaps, bundles, frames = [], [], []
    for k, (truth, own) in enumerate(zip(truths, noise.spawn(count), strict=True)):
        S_map_world = random_frame(own, truth.gauge)
        bundle = _session(truth, own, is_common, k, S_map_world, sign)
        submaps.append(_message(bundle, k, 1))
        if k == count // 2:
            again = _session(truth, own, is_common, k, S_map_world, sign)
            revised = _message(again, k, 2)
        bundles += [bundle] if keep else []
        frames.append(S_map_world.inverse())
    return Workload(name, tuple(submaps), tuple(bundles), tuple(frames), scene.points, revised)


def cached(name: str, folder: Path, seed: int = 0, *, bundles: bool = False) -> Workload:
    """Like `workload`, kept in files: S5 takes minutes to make. With or without the bundles."""
    messages, own = (folder / f'{name}-{seed}-{part}.pickle' for part in ('messages', 'bundles'))
    if not messages.exists():
        folder.mkdir(parents=True, exist_ok=True)
        made = workload(name, seed)
        own.write_bytes(pickle.dumps(made.bundles))
        light = {key: getattr(made, key) for key in Workload.__slots__} | {'bundles': ()}
        messages.write_bytes(pickle.dumps(light))
    load = Workload(**pickle.loads(messages.read_bytes()))
    return replace(load, bundles=pickle.loads(own.read_bytes())) if bundles else load


def sessions() -> dict[str, tuple[Bundle, Ids]]:
    """
    Three drones' maps of 60 key frames and about 1000 points, and 100 landmarks of each.

    Chosen by lot as landmarks are that are matched, by what is seen most often, and at one end of
    the flight, where they hold the other end badly.
    """
    bundles = workload('S2', drones=9).bundles
    matched, longest, far = sorted(bundles, key=lambda one: -len(one.point_ids))[:3]
    views = np.bincount(matched.observation_points, minlength=len(matched.point_ids))
    eligible = matched.point_ids[views >= MATCHED_VIEWS]
    lot = np.random.default_rng(0).choice(eligible, SHARED_IN_SESSION, replace=False)
    centred = far.points - far.points.mean(axis=0)
    along = centred @ np.linalg.svd(centred, full_matrices=False)[2][0]
    return {
        'seen 5 times or more, by lot': (matched, np.sort(lot)),
        'longest tracks': (longest, best_tracks(longest, SHARED_IN_SESSION)),
        'one end of the map': (far, np.sort(far.point_ids[np.argsort(along)[:SHARED_IN_SESSION]])),
    }


def _message(bundle: Bundle, drone: int, revision: int) -> SubMap:
    """The sub-map as it is received: sent and decoded."""
    shared = bundle.point_ids[bundle.point_ids < PRIVATE]
    robot = f'drone{drone:04d}'
    name = MapName(
        f'{robot}/0001', robot, revision, drone + 1 + 10**6 * revision, id_space='fleet'
    )
    return decode_submap(encode_submap(compress(bundle, name, shared, catalogue=False)))


def _flights(
    rng: np.random.Generator, count: int, *, together: bool
) -> tuple[Scene, list[Bundle]]:
    columns = int(np.ceil(np.sqrt(count)))
    cells = np.ones(2) if together else np.array([columns, np.ceil(count / columns)])
    margin = cells + 1
    scene = yard_scene(
        rng,
        int(DENSITY * margin.prod()),
        (float(margin[0] * CELL[0]), float(margin[1] * CELL[1])),
        houses=2 * int(margin.prod()),
    )
    row, column = np.divmod(np.arange(count), columns)
    places = np.zeros((count, 2)) if together else np.column_stack([column, row])
    centres = (places - (cells - 1) / 2.0) * CELL
    seeds = rng.spawn(count)
    return scene, [_flight(*pair, scene) for pair in zip(seeds, centres, strict=True)]


def _flight(rng: np.random.Generator, centre: Floats, scene: Scene) -> Bundle:
    path = lawn_mower(rng, np.append(centre, ALTITUDE), PATH, KEYFRAMES)
    near = np.abs(scene.points[:, :2] - centre).max(axis=1) < max(CELL)
    part = replace(
        scene,
        ids=scene.ids[near],
        points=scene.points[near],
        normals=scene.normals[near],
        surfaces=scene.surfaces[near],
        descriptors=scene.descriptors[near],
    )
    return observe(rng, part, path, Sensing())


def _common(
    rng: np.random.Generator, scene: Scene, truths: Sequence[Bundle], *, together: bool
) -> Mask:
    """(landmarks + 1,) by id: found to be the same by all drones that see it, at least two."""
    views = np.zeros(len(scene.ids) + 1, np.int64)
    for truth in truths:
        views[truth.point_ids.astype(np.int64)] += 1
    seen = np.flatnonzero(views == len(truths) if together else views > 1)
    wanted = COMMON_IN_S1 if together else round(SHARED_PER_DRONE * len(truths))
    is_common = np.zeros(len(views), bool)
    is_common[rng.choice(seen, wanted, replace=False)] = True
    return is_common


def _session(
    truth: Bundle,
    rng: np.random.Generator,
    is_common: Mask,
    drone: int,
    S_map_world: Similarity,
    sign: float,
) -> Bundle:
    """Map at its optimum in the given frame; what is not matched has an id of the drone's own."""
    common = is_common[truth.point_ids.astype(np.int64)]
    own = PRIVATE + np.uint64(2**24 * (drone + 1)) + truth.point_ids
    noise_px = 0.5 * sign * rng.normal(size=truth.observations_px.shape)
    bundle = replace(
        truth,
        point_ids=np.where(common, truth.point_ids, own),
        observations_px=truth.observations_px + noise_px,
        sigma_px=0.5,
    ).transformed(S_map_world)
    rows = np.flatnonzero(common)
    for _ in range(GAUSS_NEWTON_STEPS):
        lin = linearise(bundle)
        found = eliminate(lin, rows)
        shared_steps = -np.linalg.lstsq(found.r, found.c, rcond=None)[0].reshape(-1, 3)
        bundle = lin.moved(*found.steps(lin, shared_steps))
    return bundle
