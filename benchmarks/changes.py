# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
What is found of what moved, in real maps of which a part has been moved.

    python benchmarks/changes.py ../shared/data --markdown docs/changes.md

Semi-real: every session is compressed by itself to a random draw of good tracks that it shares
with another one, lenses exact. In one session a landmark and its eleven neighbours are moved
together; their images are made anew from the session's own cameras, with residuals drawn from
those that the session has. The ids of the data are the matches.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from data_sets import data_sets
from documents import published
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mapmerge_ros.bundle import Bundle, MapName, compress
from mapmerge_ros.bundle.linearise import linearise
from mapmerge_ros.bundle.quality import TrackQuality
from mapmerge_ros.bundle.selection import matched
from mapmerge_ros.fusion import Component, Fusion, Kind, fuse
from mapmerge_ros.fusion.informations import informations
from mapmerge_ros.fusion.joint.cost import JointCost
from mapmerge_ros.fusion.local import local_tests
from mapmerge_ros.fusion.noise import pool_noise
from mapmerge_ros.fusion.quadratic import Members, Quadratic, quadratic
from mapmerge_ros.io import load_colmap
from mapmerge_ros.submap import SubMap

LANDMARKS, CLUSTER = 220, 12
LARGEST_SHARE = 0.8
"""Of the common landmarks in one draw, or all draws are the same."""

FIRST_PRIVATE_ID = 100_000_000
"""Ids from here on are private: equal ones are different points."""

SEEDS, MOTIONS = (0, 1, 2), ((10.0, 0.0), (5.0, 0.0), (10.0, 0.1))
"""Draws, and motions: shift in standard deviations of a landmark, turn [rad]."""

HEAD = '| set | moved by | trials | found | recall where found | precision | tests, CPU s |'

CHECKED = ('boruszyn_kite', 'bal_ladybug49', 'brighton_drone')
"""Sets on which no threshold was chosen; Boruszyn and Brighton showed that extent has to count."""

HALF = 0.4
"""
Share of an overlap from which an object is as much of it as the rest: which of the two moved
cannot be told, so either may be named. Such trials count like all others; they are listed.
"""

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
    overlap_share: float
    """Of what the session has in common with the one that sees most of the object, moved"""
    right: int
    """Landmarks in objects that have moved"""
    false: int
    moved: int
    objects: int
    quarantined: int
    seconds: float
    """CPU time of the tests, the share of the merge's by the clock"""


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
    cost = JointCost.of(
        submaps, association.tracks, is_shared, noise.weights, informations(submaps)
    ).reduced()
    points = component.landmarks.points_global[is_shared]
    return quadratic(cost.elements(), points, component.gauge, noise.sigma)


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
    return scored(submaps, ids, _overlap_share(source.ids, k, ids))


def _overlap_share(sessions: Sequence[np.ndarray], k: int, ids: np.ndarray) -> float:
    """Moved landmarks of what session k has in common with the session that sees most of them."""
    others = [np.intersect1d(sessions[k], own) for m, own in enumerate(sessions) if m != k]
    common = max(others, key=lambda own: int(np.isin(ids, own).sum()))
    return float(np.isin(ids, common).sum() / len(common))


def scored(submaps: Sequence[SubMap], ids: np.ndarray, overlap_share: float = 0.0) -> Score:
    """Merge, and compare what is named with what was moved."""
    begin = time.process_time()
    fusion = fuse(submaps)
    seconds = time.process_time() - begin
    moved = [change for change in fusion.changes if change.kind is Kind.MOVED]
    groups = [
        np.array([each.landmark_id for each in moved if each.object_id == number], np.uint64)
        for number in sorted({change.object_id for change in moved})
    ]
    named = np.unique(np.concatenate([ids[:0], *groups]))
    best = max((np.isin(group, ids).sum() for group in groups), default=0)
    right = int(np.isin(named, ids).sum())
    return Score(
        is_found=bool(best and best >= MEMBERSHIP * len(ids)),
        overlap_share=overlap_share,
        right=right,
        false=len(named) - right,
        moved=len(ids),
        objects=len(groups),
        quarantined=len(fusion.quarantined),
        seconds=seconds * fusion.timing.test_s / fusion.timing.total_s,
    )


def unchanged_row(name: str, draws: Sequence[Draw]) -> str:
    """Nothing moved."""
    scores = [scored(each.submaps, np.zeros(0, np.uint64)) for each in draws]
    objects = sum(score.objects for score in scores)
    seconds = np.mean([score.seconds for score in scores])
    wrong = sum(score.quarantined for score in scores)
    found = f'{objects} objects' + (f', {wrong} maps in quarantine' if wrong else '')
    return f'| {name} | nothing | {len(draws)} | {found} | | | {seconds:.2f} |'


def moved_row(
    name: str, draws: Sequence[Draw], sigmas: float, turn_rad: float, trials: int
) -> str:
    """A cluster of one session moved by some standard deviations and turned."""
    scores = [
        trial(draws[i % len(draws)], sigmas, turn_rad, np.random.default_rng([1, i]))
        for i in range(trials)
    ]
    found = [score for score in scores if score.is_found]
    right, false = sum(s.right for s in scores), sum(s.false for s in scores)
    recall = sum(s.right for s in found) / max(1, sum(s.moved for s in found))
    seconds = np.mean([score.seconds for score in scores])
    wrong = sum(score.quarantined for score in scores)
    halves = sum(score.overlap_share >= HALF for score in scores)
    name += f' ({wrong} maps in quarantine)' if wrong else ''
    name += f' ({halves} × half of an overlap)' if halves else ''
    turned = f', {turn_rad} rad' if turn_rad else ''
    return (
        f'| {name} | {sigmas:g} σ{turned} | {trials} | {len(found) / trials:.0%} | {recall:.3f} | '
        f'{right / max(1, right + false):.3f} | {seconds:.2f} |'
    )


def rows(folders: Sequence[Path], trials: int) -> Iterator[str]:
    """Every row of the table."""
    for folder in folders:
        name = folder.name + (' (check)' if folder.name in CHECKED else '')
        bundles, shared = load(folder)
        draws = [draw(bundles, shared, seed) for seed in SEEDS]
        yield unchanged_row(name, draws)
        for sigmas, turn_rad in MOTIONS:
            yield moved_row(name, draws, sigmas, turn_rad, trials)


def main(argv: list[str] | None = None) -> int:
    """Print the table, and write it into a document when asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('data', type=Path, help='folder with one folder per data set')
    parser.add_argument('--trials', type=int, default=20, help='per set and motion')
    parser.add_argument('--markdown', type=Path, help='document whose table is replaced')
    args = parser.parse_args(argv)
    head = [HEAD, '|---' * (HEAD.count(' |')) + '|']
    return published(
        lambda: itertools.chain(head, rows(data_sets(args.data), args.trials)),
        args.markdown,
        'semi-real',
    )


if __name__ == '__main__':
    sys.exit(main())
