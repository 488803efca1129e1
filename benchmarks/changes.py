# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
What is found of what moved: in simulation, and in real maps of which a part has been moved.

    python benchmarks/changes.py ../shared/data --markdown docs/changes.md

Semi-real: every session is compressed by itself to a random draw of good tracks that it shares
with another one, lenses exact. In one session a landmark and its eleven neighbours are moved
together; their images are made anew from the session's own cameras, with residuals drawn from
those that the session has. The ids of the data are the matches.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from mapmerge_ros.bundle import Bundle, MapName, compress
from mapmerge_ros.bundle.linearise import linearise
from mapmerge_ros.bundle.quality import TrackQuality
from mapmerge_ros.bundle.selection import matched
from mapmerge_ros.errors import MapMergeError
from mapmerge_ros.fusion import Component, Fusion, fuse
from mapmerge_ros.fusion.element import Element
from mapmerge_ros.fusion.local import local_tests
from mapmerge_ros.fusion.quadratic import Members, Quadratic, quadratic
from mapmerge_ros.fusion.verify import pool_noise
from mapmerge_ros.io import load_colmap
from mapmerge_ros.submap import SubMap

LANDMARKS, CLUSTER = 220, 12
LARGEST_SHARE = 0.8
"""Of the common landmarks in one draw, or all draws are the same."""

FIRST_PRIVATE_ID = 100_000_000
"""Ids from here on are private: equal ones are different points."""

CHECKED = ('boruszyn_kite', 'bal_ladybug49')
"""Sets on which nothing was chosen."""

MEMBERSHIP = 0.5
"""Share of the moved landmarks that one group must have for the object to count as found."""


@dataclass(frozen=True, slots=True, eq=False)
class Draw:
    """Sessions of one place, compressed to some of their common landmarks."""

    bundles: Sequence[Bundle]
    ids: Sequence[np.ndarray]
    submaps: Sequence[SubMap]
    unchanged: Fusion
    members: Members
    stds_global: np.ndarray
    """
    (s,) of each landmark of each session, by its local test, all maps believed to the letter:
    how far it may be from where the others see it
    """

    def typical_std(self, k: int) -> float:
        """Median standard deviation of a landmark of session k [its map units]."""
        own = self.stds_global[self.members.of_map(k)]
        return float(np.nanmedian(own)) / self.unchanged.alignments[k].S_global_map.scale


@dataclass(frozen=True, slots=True)
class Score:
    """One trial."""

    is_found: bool
    right: int
    """Landmarks in objects that have moved"""
    false: int
    moved: int
    objects: int
    seconds: float
    off_sigmas: float
    """Motion of the moved landmarks off the truth, root mean square over its own claim"""


def load(folder: Path) -> tuple[list[Bundle], list[np.ndarray]]:
    """Sessions of one place and the ids that each may share: good tracks."""
    bundles = [load_colmap(path) for path in sorted(folder.glob('session_*'))]
    return bundles, list(matched(bundles, None, TrackQuality()))


def draw(bundles: Sequence[Bundle], shared: Sequence[np.ndarray], seed: int) -> Draw:
    """Compress each session to what it has of a random draw of common landmarks."""
    ids, counts = np.unique(np.concatenate(shared), return_counts=True)
    ids = ids[(counts > 1) & (ids < FIRST_PRIVATE_ID)]
    count = min(LANDMARKS, int(LARGEST_SHARE * len(ids)))
    chosen = np.random.default_rng(seed).choice(ids, count, replace=False)
    own = [np.intersect1d(each, chosen) for each in shared]
    submaps = [_compressed(bundle, k, own[k]) for k, bundle in enumerate(bundles)]
    unchanged = fuse(submaps)
    merge = as_merged(submaps, unchanged.components[0])
    stds = np.sqrt(np.trace(local_tests(merge).covariance, axis1=1, axis2=2) / 3.0)
    return Draw(bundles, own, submaps, unchanged, merge.members, stds)


def as_merged(submaps: Sequence[SubMap], component: Component) -> Quadratic:
    """Quadratic of a merge by ids, in the global frame."""
    association, noise = component.association, pool_noise(submaps)
    is_shared = association.views > 1
    slots = np.cumsum(is_shared) - 1
    elements = [
        Element.from_submap(submap, tracks, is_shared[tracks], float(weight)).reduced()
        for submap, tracks, weight in zip(submaps, association.tracks, noise.weights, strict=True)
    ]
    elements = [replace(element, tracks=slots[element.tracks]) for element in elements]
    points = component.landmarks.points_global[is_shared]
    return quadratic(elements, points, component.gauge, noise.sigma)


def _compressed(bundle: Bundle, k: int, ids: np.ndarray) -> SubMap:
    name = MapName(f'session_{k}', 'robot', stamp_ns=k, id_space='truth')
    return compress(bundle, name, ids, catalogue=False)


def with_moved(
    bundle: Bundle, ids: np.ndarray, moved_points: np.ndarray, rng: np.random.Generator
) -> Bundle:
    """
    The bundle with some points elsewhere, imaged anew with residuals of this very session.

    Points that would come to lie behind a camera are refused by the bundle.
    """
    rows = bundle.rows_of(ids)
    points = bundle.points.copy()
    points[rows] = moved_points
    of_moved = np.isin(bundle.observation_points, rows)
    lin = linearise(bundle)
    elsewhere = replace(bundle, points=points)
    exact = linearise(elsewhere).residuals_px + bundle.observations_px  # their projections
    drawn = lin.residuals_px[rng.integers(len(lin.residuals_px), size=int(of_moved.sum()))]
    observations = bundle.observations_px.copy()
    observations[of_moved] = exact[of_moved] - drawn
    return replace(elsewhere, observations_px=observations)


def trial(source: Draw, sigmas: float, turn_rad: float, rng: np.random.Generator) -> Score:
    """Move a cluster of one session, compress it again, merge, and score what is named."""
    k = int(rng.choice([k for k, ids in enumerate(source.ids) if len(ids) >= 3 * CLUSTER]))
    submap, bundle = source.submaps[k], source.bundles[k]
    points = submap.compressed_points
    near = cKDTree(points).query(points[rng.integers(len(points))], CLUSTER)[1]
    ids, before = submap.compressed_ids[near], points[near]
    direction = rng.normal(size=3)
    shift = sigmas * source.typical_std(k) * direction / np.linalg.norm(direction)
    axis = rng.normal(size=3)
    turn = Rotation.from_rotvec(turn_rad * axis / np.linalg.norm(axis))
    centre = before.mean(axis=0)
    after = centre + turn.apply(before - centre) + shift
    submaps = list(source.submaps)
    submaps[k] = _compressed(with_moved(bundle, ids, after, rng), k, source.ids[k])
    return scored(submaps, k, ids, after - before)


def scored(
    submaps: Sequence[SubMap], k: int, ids: np.ndarray, displacement: np.ndarray
) -> Score:
    """Merge, and compare what is named with what was moved: `ids` of sub-map k."""
    begin = time.process_time()
    fusion = fuse(submaps)
    seconds = time.process_time() - begin
    component = fusion.components[0]
    found, named = component.examination, set()
    tracks = component.association.tracks
    shared = np.flatnonzero(component.association.views > 1)
    id_of = {
        int(track): int(own)
        for own_ids, rows in zip([s.compressed_ids for s in submaps], tracks, strict=True)
        for own, track in zip(own_ids, rows, strict=True)
    }
    best = 0
    for each in found.objects if found else ():
        of_object = {id_of[int(shared[t])] for t in found.tests.members.tracks[each.members]}
        best = max(best, len(of_object & set(map(int, ids))))
        named |= of_object
    right = len(named & set(map(int, ids)))
    return Score(
        best >= MEMBERSHIP * len(ids) if len(ids) else False,
        right,
        len(named) - right,
        len(ids),
        len(found.objects) if found else 0,
        seconds * fusion.timing.test_s / fusion.timing.total_s,
        float('nan'),
    )
