# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A merge that verifies itself: where the test refuses, better basins are looked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.fusion.config import FusionConfig
from mapmerge_ros.fusion.joint.cost import JointCost
from mapmerge_ros.fusion.joint.minimise import minimise
from mapmerge_ros.fusion.joint.resume import Start
from mapmerge_ros.fusion.joint.start import STEPS, initial_points
from mapmerge_ros.fusion.merge import Estimate
from mapmerge_ros.fusion.overlap import Link, components, spanning_tree
from mapmerge_ros.geometry import Gauge, Similarity

WEAK_TURN_RAD = 0.1
"""
Uncertainty of a rotation from which a start may lie in the wrong basin.

Six degrees: below it, no start of the rooms of the paper's third experiment did.
"""

TWISTS = (1.0, -1.0, 2.0, -2.0)
"""Turns of a weak link, in its own standard deviations; half a turn is tried as well."""


def search(
    cost: JointCost,
    links: Sequence[Link],
    gauge: Gauge,
    believed: Callable[[float], bool],
    config: FusionConfig,
    start: Start | None = None,
) -> Estimate:
    """
    Merge from one start after the other until the test believes it; the cheapest one counts.

    Deterministic, and a single start where no rotation is weakly determined: a refusal is then
    about the data. Where one is, noise explains wrong basins too: the cheaper of two starts at
    least (11 wrong narrow rooms of 1000; see docs/experiments.md).
    `start` is where the last merge ended: it comes first, and does not count.

    Raises
    ------
    DegenerateGeometry
        No start leads to a merge.

    """
    gauges = [Gauge(int(own)) for own in cost.gauges]
    best: Estimate | None = None
    failure: DegenerateGeometry | None = None
    if start is not None:
        resumed = _resumed(cost, start, gauge, config)
        # Where there is only one basin, a refusal is about the data.
        if resumed and (believed(resumed.cost) or is_certain(links, len(cost))):
            return resumed
    tried, least = 0, 1 if is_certain(links, len(cost)) else 2
    for some, steps in _starts(links, len(cost)):
        if tried == config.max_starts:
            break
        tried += 1
        try:
            centre, frames = spanning_tree(range(len(cost)), gauges, some)
            found = minimise(cost, initial_points(cost, frames, centre, steps), gauge, config)
        except DegenerateGeometry as err:
            failure = err
            continue
        if best is None or found.cost < best.cost:
            best = found
        if tried >= least and believed(best.cost):
            break
    if best is None:
        raise failure or DegenerateGeometry('no sub-map to merge')
    return replace(best, starts=tried)


def _resumed(cost: JointCost, start: Start, gauge: Gauge, config: FusionConfig) -> Estimate | None:
    try:
        found = minimise(cost, start.points, gauge, config, start.matrix)
    except DegenerateGeometry:
        return None
    return found if found.converged else None


def is_certain(links: Sequence[Link], count: int) -> bool:
    """Whether links that determine every rotation well connect all sub-maps: one basin only."""
    return not loosely_tied(links, count)


def loosely_tied(links: Sequence[Link], count: int) -> tuple[int, ...]:
    """Sub-maps that such links do not connect to most of the others: they may be turned."""
    firm = [link for link in links if link.turn and link.turn.std_rad <= WEAK_TURN_RAD]
    return tuple(sorted(k for group in components(count, firm)[1:] for k in group))


def _starts(links: Sequence[Link], count: int) -> Iterator[tuple[Sequence[Link], int]]:
    """
    Links, and steps of all frames towards their mean.

    Links as they are, frames settled or as the paths put them (a weak rotation is better left as
    its own landmarks say); without a weak link; with a weak one turned. The weakest first.
    """
    yield links, STEPS
    yield links, 0
    weak = [k for k, link in enumerate(links) if link.turn and link.turn.std_rad > WEAK_TURN_RAD]
    weak.sort(key=lambda k: -_std_rad(links[k]))
    for k in weak:
        rest = [link for position, link in enumerate(links) if position != k]
        if len(components(count, rest)) == 1:
            yield rest, STEPS
    for k in weak:
        for twist in (*(sigmas * _std_rad(links[k]) for sigmas in TWISTS), np.pi):
            turned = [_turned(link, twist) if link is links[k] else link for link in links]
            yield turned, STEPS


def _std_rad(link: Link) -> float:
    return link.turn.std_rad if link.turn else 0.0


def _turned(link: Link, angle_rad: float) -> Link:
    """Return the link with its frames turned about the landmarks that they share."""
    assert link.turn is not None
    assert link.S_a_b is not None
    rotation = Similarity.exp(np.append(angle_rad * link.turn.axis_a, np.zeros(4))).rotation
    pivot = link.turn.pivot_a
    return replace(link, S_a_b=Similarity(1.0, rotation, pivot - rotation @ pivot) @ link.S_a_b)
