# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Catalogues of one site whose landmarks have no common ids, and what is true about them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from submaps import real_model

from mapmerge_ros.association import Correspondences
from mapmerge_ros.bundle import MapName, compress
from mapmerge_ros.geometry import Similarity
from mapmerge_ros.io import load_colmap
from mapmerge_ros.simulation import announcement
from mapmerge_ros.submap import SubMap

BYTES = 32
NOISE = 0.02
"""Of a landmark in a map [m]."""
REACH = 15.0
"""Width of what one map sees; the next begins 10 m further on [m]."""


def site(maps: int = 4, seed: int = 0, density: float = 0.2) -> tuple[list[SubMap], list]:
    """Maps in a row, each overlapping the next two or three; per map the true rows it sees."""
    rng = np.random.default_rng(seed)
    count = int(density * (5 * maps + REACH) * 10 * 6)
    scene = rng.uniform([0, 0, 0], [5 * maps + REACH, 10, 6], (count, 3))
    looks = rng.integers(0, 256, (count, BYTES), dtype=np.uint8)
    submaps, seen = [], []
    for k in range(maps):
        inside = (scene[:, 0] > 5 * k) & (scene[:, 0] < 5 * k + REACH)
        rows = rng.permutation(np.flatnonzero(inside & (rng.random(count) < 0.9)))
        flips = np.packbits(rng.random((len(rows), BYTES, 8)) < 0.08, axis=-1)[..., 0]
        frame = Similarity.exp(rng.normal(size=7))
        points = scene[rows] + NOISE * rng.normal(size=(len(rows), 3))
        submaps.append(
            announcement(f'm{k}', frame.apply(points), looks[rows] ^ flips, NOISE * frame.scale)
        )
        seen.append(rows)
    return submaps, seen


def permuted(submap: SubMap, rows) -> SubMap:
    """The same bare announcement with its landmarks in another order."""
    return replace(
        submap,
        landmark_ids=submap.landmark_ids[rows],
        points=submap.points[rows],
        covariances=None if submap.covariances is None else submap.covariances[rows],
        descriptors=submap.descriptors[rows],
    )


def partition(submaps: Sequence[SubMap], found: Correspondences) -> set[frozenset]:
    """Tracks of at least two landmarks as sets of (map_id, landmark_id)."""
    members: dict[int, set] = {}
    for submap, tracks in zip(submaps, found.tracks, strict=True):
        for landmark_id, track in zip(submap.landmark_ids.tolist(), tracks.tolist(), strict=True):
            members.setdefault(track, set()).add((submap.map_id, landmark_id))
    return {frozenset(own) for own in members.values() if len(own) > 1}


def right_and_true(seen, found: Correspondences) -> tuple[int, int, int]:
    """Number of links, of right ones among them, and of true ones."""
    links = right = true = 0
    for a in range(len(seen)):
        for b in range(a + 1, len(seen)):
            _, rows_a, rows_b = np.intersect1d(
                found.tracks[a], found.tracks[b], return_indices=True
            )
            links += len(rows_a)
            right += int((seen[a][rows_a] == seen[b][rows_b]).sum())
            true += len(np.intersect1d(seen[a], seen[b]))
    return links, right, true


def real_maps(name) -> list[SubMap]:
    """Bare announcements of the sessions of a set."""
    pytest.importorskip('pycolmap', reason='COLMAP models are read by pycolmap')
    bundles = [load_colmap(path) for path in sorted(real_model(name).glob('session_*'))]
    return [
        compress(bundle, MapName(f'{name}/{k}', f'{k}'), bundle.point_ids[:0])
        for k, bundle in enumerate(bundles)
    ]
