# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
How good a merge of chosen landmarks is: the landmarks, the frames, and everything else.

Each after one similarity of its own. The merged landmarks are what goes out, so those that are
better determined look better whatever they do for the maps, and those that lie together better
than those that are spread over all that is common, as a bend is seen from end to end only. The
frames are free of that, and of what each robot has done wrong by itself: only the choice can
change them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from choice_robots import Robots

from mapmerge_ros.arrays import Floats, Ids
from mapmerge_ros.bundle import compress
from mapmerge_ros.fusion import FusionConfig, fuse
from mapmerge_ros.fusion.outcome import Landmarks
from mapmerge_ros.geometry import Gauge, Similarity, align, align_robustly

NEAREST = 0.9
"""Share of points that a root mean square is about: a few at the horizon would decide it."""

COLUMNS = (
    'landmarks, median',
    'landmarks, RMS',
    'frames, RMS',
    'points, median',
    'points, RMS of 90 %',
    'cameras, RMS',
    'spread of landmarks',
)
"""What `errors` returns."""

SPREAD = COLUMNS.index('spread of landmarks')
"""No error: the median distance of the merged landmarks from their middle, in the truth."""


@dataclass(frozen=True, eq=False)
class Placed:
    """Everything that the robots have, in the frame of a merge or in that of the truth."""

    landmarks: Floats
    """Merged, of two robots at least"""
    frames: tuple[Similarity, ...]
    """S_common_map of each robot"""
    points: Floats
    centres: Floats


def merge(robots: Robots, chosen: Sequence[Ids]) -> tuple[Placed, Placed] | None:
    """
    Merge, and bring every robot's map into agreement; what was found and what would be right.

    None if the robots do not all come together.
    """
    submaps = [
        compress(*own, catalogue=False)
        for own in zip(robots.bundles, robots.names, chosen, strict=True)
    ]
    # Taking out what does not fit would judge the test, not the choice.
    fusion = fuse(submaps, FusionConfig(unlock=False, ask=False))
    component = fusion.components[0]
    if len(component.map_ids) < len(submaps):
        return None
    landmarks = component.landmarks
    members = np.array(landmarks.member_maps)
    frames, points, centres = [], [], []
    for bundle, name in zip(robots.bundles, robots.names, strict=True):
        own = members == name.map_id
        updated = bundle.update(
            landmarks.member_ids[own], landmarks.points_global[landmarks.member_rows[own]]
        )
        frames.append(updated.S_map_global.inverse())
        points.append(frames[-1].apply(updated.bundle.points))
        centres.append(frames[-1].apply(updated.bundle.centres_map()))
    right = _right_landmarks(robots, landmarks)
    shared = np.bincount(landmarks.member_rows, minlength=len(right)) > 1
    return (
        Placed(
            landmarks.points_global[shared],
            tuple(frames),
            np.concatenate(points),
            np.concatenate(centres),
        ),
        Placed(
            right[shared],
            _right_frames(robots),
            np.concatenate(robots.points),
            np.concatenate(robots.centres),
        ),
    )


def errors(robots: Robots, found: Placed, right: Placed) -> Floats:
    """Distances of what was found from where it should be, and of landmarks, as COLUMNS says."""
    landmarks = np.sort(_distances(right.landmarks, found.landmarks))
    points = np.sort(_distances(right.points, found.points))
    S_right_found = align(right.centres, found.centres).S_target_source
    cameras = S_right_found.apply(found.centres) - right.centres
    return np.array(
        [
            np.median(landmarks),
            _root_mean_square(landmarks[: int(NEAREST * len(landmarks))]),
            frame_error(robots, found.frames, right.frames),
            np.median(points),
            _root_mean_square(points[: int(NEAREST * len(points))]),
            _root_mean_square(np.linalg.norm(cameras, axis=1)),
            np.median(_from_middle(right.landmarks)),
        ]
    )


def frame_error(robots: Robots, found: Sequence[Similarity], right: Sequence[Similarity]) -> float:
    """By how much wrong frames displace the robots' own points, each robot counting the same."""
    places = [_nearest(bundle.points) for bundle in robots.bundles]
    ours = [S.apply(own) for S, own in zip(found, places, strict=True)]
    theirs = [S.apply(own) for S, own in zip(right, places, strict=True)]
    weights = np.concatenate([np.full(len(own), 1.0 / len(own)) for own in places])
    return align(np.concatenate(theirs), np.concatenate(ours), weights=weights).rms


def _right_frames(robots: Robots) -> tuple[Similarity, ...]:
    """S_truth_map of each robot: its own map laid over the truth."""
    return tuple(
        align_robustly(
            right, bundle.points, gauge=Gauge.SIMILARITY, weights=np.ones(len(right)), steps=30
        ).S_target_source
        for right, bundle in zip(robots.points, robots.bundles, strict=True)
    )


def _right_landmarks(robots: Robots, landmarks: Landmarks) -> Floats:
    """(n, 3) where the truth has merged landmarks: the mean of their members there."""
    total = np.zeros_like(landmarks.points_global)
    members = np.array(landmarks.member_maps)
    for bundle, right, name in zip(robots.bundles, robots.points, robots.names, strict=True):
        own = members == name.map_id
        rows = bundle.rows_of(landmarks.member_ids[own])
        np.add.at(total, landmarks.member_rows[own], right[rows])
    return np.asarray(total / np.bincount(landmarks.member_rows, minlength=len(total))[:, None])


def _from_middle(points: Floats) -> Floats:
    return np.asarray(np.linalg.norm(points - np.median(points, axis=0), axis=1))


def _nearest(points: Floats) -> Floats:
    distances = _from_middle(points)
    return points[distances <= np.quantile(distances, NEAREST)]


def _distances(right: Floats, found: Floats) -> Floats:
    """After the similarity that lays most of it over the truth."""
    S_right_found = align_robustly(
        right, found, gauge=Gauge.SIMILARITY, weights=np.ones(len(right)), steps=30
    ).S_target_source
    return np.asarray(np.linalg.norm(S_right_found.apply(found) - right, axis=1))


def _root_mean_square(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))
