# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""One robot's session: from what is true to the map that its own SLAM would make of it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mapmerge_ros.arrays import Bytes, Floats, Ids
from mapmerge_ros.bundle import Bundle, FramePrior
from mapmerge_ros.errors import MapMergeError
from mapmerge_ros.geometry import Gauge, Similarity
from mapmerge_ros.simulation.adjust import MAX_ITERATIONS, solve
from mapmerge_ros.simulation.frames import anchored, frame_error, random_frame
from mapmerge_ros.submap import Descriptors, DescriptorType

START_ERROR_RATIO = 0.005
"""
Error of the values that adjustment starts from, over the viewing distance.

Small enough that the right optimum is found, large enough that finding it takes iterations.
"""


class SimulationError(MapMergeError):
    """What was asked for cannot be simulated; the message says which parameter to change."""


@dataclass(frozen=True, slots=True, eq=False)
class Session:
    """A robot's map and the truth behind it, row for row."""

    bundle: Bundle
    """adjusted, in the robot's own frame and scale"""
    truth: Bundle
    """the same key frames and points without noise, in the world frame [m]"""
    S_world_map: Similarity
    """takes points of `bundle` to those of `truth`, up to their noise"""
    landmark_ids: Ids
    """(n,) id in the scene of each point of `bundle`"""


def measure(
    truth: Bundle,
    rng: np.random.Generator,
    *,
    sigma_px: float,
    gauge: Gauge = Gauge.SIMILARITY,
    prior: FramePrior | None = None,
    max_iterations: int = MAX_ITERATIONS,
) -> Session:
    """
    Map that a robot makes of noisy images, in a frame of its own.

    The frame is random within the group of `gauge`; what a metric map claims to know of it errs
    by `prior`. A small `max_iterations` is a robot that had no time to reach its optimum.

    Raises
    ------
    AdjustmentError
        See `adjust`.

    """
    prior = prior or FramePrior()
    noise_px = sigma_px * rng.normal(size=truth.observations_px.shape)
    noisy = replace(
        truth,
        observations_px=truth.observations_px + noise_px,
        gauge=gauge,
        prior=prior,
        sigma_px=sigma_px,
    )
    start = _disturbed(noisy, rng)
    # Drawn last: the same seed gives the same noise in every gauge.
    S_map_world = random_frame(rng, gauge)
    centre_map = S_map_world.apply(truth.centres_map()).mean(axis=0)
    S_map_world = frame_error(rng, gauge, prior, centre_map) @ S_map_world
    adjusted = solve(start.transformed(S_map_world), max_iterations=max_iterations).bundle
    return Session(
        bundle=anchored(adjusted, truth.transformed(S_map_world)),
        truth=truth,
        S_world_map=S_map_world.inverse(),
        landmark_ids=truth.point_ids,
    )


def with_descriptors(
    session: Session, rng: np.random.Generator, descriptors: Bytes, flip_ratio: float
) -> Session:
    """Give every point its descriptor (n, size), each bit flipped with `flip_ratio`."""
    flips = rng.random((*descriptors.shape, 8)) < flip_ratio
    rows = descriptors ^ np.packbits(flips, axis=-1)[..., 0]
    seen = replace(session.bundle, descriptors=Descriptors(DescriptorType.BINARY, rows))
    return replace(session, bundle=seen)


def with_private_ids(session: Session, rng: np.random.Generator) -> Session:
    """Number the points by 1..n in random order: ids that mean nothing to other robots."""
    ids = (rng.permutation(len(session.landmark_ids)) + 1).astype(np.uint64)
    return replace(session, bundle=replace(session.bundle, point_ids=ids))


def _disturbed(bundle: Bundle, rng: np.random.Generator) -> Bundle:
    """Values to start the adjustment from."""
    depth = float(np.median(bundle.points_camera()[:, 2]))
    return bundle.moved(
        _steps(rng, len(bundle.keyframe_ids), (START_ERROR_RATIO, START_ERROR_RATIO * depth)),
        _steps(rng, len(bundle.point_ids), (START_ERROR_RATIO * depth,)),
    )


def _steps(rng: np.random.Generator, count: int, stds: tuple[float, ...]) -> Floats:
    """Random steps (count, 3 per std)."""
    steps: Floats = rng.normal(size=(count, 3 * len(stds))) * np.repeat(stds, 3)
    return steps
