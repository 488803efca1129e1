# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
Rounds between the fusion and its robots: from one linearisation to the full bundle.

Every round merges, hands the landmarks back, lets each robot re-optimise what is its own, and
compresses again where it then stands. What travels is one sub-map per robot and round.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapmerge_ros.arrays import Floats, Ids
from mapmerge_ros.bundle import Bundle, MapName, compress
from mapmerge_ros.bundle.relinearise import relinearise
from mapmerge_ros.errors import InvalidValue, MapMergeError
from mapmerge_ros.fusion.config import FusionConfig
from mapmerge_ros.fusion.engine import fuse
from mapmerge_ros.fusion.outcome import Fusion, State
from mapmerge_ros.geometry import align
from mapmerge_ros.submap import SubMap

MAX_HALVINGS = 8
"""Shares of a step down to 1/256; a joint step that is still worse is not taken at all."""


CONVERGENCE = 1e-6
"""How near the merge of each round comes to its optimum: what is left of it, no round can mend."""

CONVERGED_STEP_RATIO = 1e-9
"""Moves of a billionth of a standard deviation are rounding."""


class NothingMerged(MapMergeError):
    """Rounds of refinement need at least two maps that can be merged."""


@dataclass(frozen=True, slots=True, eq=False)
class Robot:
    """A bundle at hand, and the landmarks that it shares."""

    name: MapName
    bundle: Bundle
    landmark_ids: Ids


@dataclass(frozen=True, slots=True, eq=False)
class Round:
    """What one round found."""

    fusion: Fusion
    """from the sub-maps as they stood before the round"""
    cost_px2: float
    """
    True cost: sum of r'r over the merged robots, each at its best for the common landmarks; where
    a robot knows its σ, in units of that.
    """
    step_ratio: float
    """Largest move of a landmark over its standard deviation; inf in the first round"""
    share: float
    """Of the merge's step that was taken; below 1 where all of it raised the true cost"""


def refine(
    robots: Sequence[Robot],
    rounds: int,
    config: FusionConfig | None = None,
    on_round: Callable[[Round], None] | None = None,
) -> tuple[tuple[Robot, ...], tuple[Round, ...]]:
    """
    Run rounds of merge and re-linearisation; the true cost never rises from one to the next.

    Ends early when a round changes nothing any more. Robots outside the published component
    stay as they are.

    Raises
    ------
    InvalidValue
        No round, or no robot.
    NothingMerged
        No two robots hang together.

    """
    if rounds < 1 or not robots:
        raise InvalidValue(f'rounds: {rounds} rounds with {len(robots)} robots do nothing')
    config = replace(
        config or FusionConfig(),
        match_descriptors=False,
        unlock=False,
        convergence=CONVERGENCE,
    )
    state = _State(tuple(robots), None, np.inf)
    history = list[Round]()
    for number in range(1, rounds + 1):
        fusion = fuse([_compressed(robot, number) for robot in state.robots], config)
        _require_merge(fusion)
        if history:  # ids that contradict are not compressed again, and stay told
            known = (*history[-1].fusion.contradictions, *fusion.contradictions)
            fusion = replace(fusion, contradictions=tuple(dict.fromkeys(known)))
        state, taken = _advance(state, fusion)
        history.append(Round(fusion, state.cost_px2, _step_ratio(fusion, taken), taken.share))
        if on_round:
            on_round(history[-1])
        if history[-1].step_ratio < CONVERGED_STEP_RATIO:
            break
    return state.robots, tuple(history)


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    robots: tuple[Robot, ...]
    landmarks: _Points | None
    """Where the robots stand; None before the first merge"""
    cost_px2: float


@dataclass(frozen=True, slots=True, eq=False)
class _Points:
    ids: Ids
    """ascending"""
    points_global: Floats

    def of(self, ids: Ids) -> Floats:
        return self.points_global[np.searchsorted(self.ids, ids)]


@dataclass(frozen=True, slots=True, eq=False)
class _Taken:
    before: _Points | None
    """Old landmarks in the frame of the new ones"""
    after: _Points
    share: float


def _advance(state: _State, fusion: Fusion) -> tuple[_State, _Taken]:
    """Take as much of the merge's step as lowers the true cost, halving; nothing at the worst."""
    wanted = _landmarks(fusion)
    before = _in_frame_of(wanted, state.landmarks) if state.landmarks else None
    share = 1.0
    for _ in range(MAX_HALVINGS if before else 1):
        points = _between(before, wanted, share) if before else wanted
        try:
            robots, cost = _relinearised(state.robots, fusion, points)
        except InvalidValue:  # the step takes a landmark behind a camera of some robot
            if before is None:
                raise
            robots, cost = state.robots, np.inf
        if cost <= state.cost_px2:
            return _State(robots, points, cost), _Taken(before, points, share)
        share /= 2.0
    assert before is not None
    return state, _Taken(before, before, 0.0)


def _relinearised(
    robots: Sequence[Robot], fusion: Fusion, points: _Points
) -> tuple[tuple[Robot, ...], float]:
    merged = {item.submap.map_id for item in fusion.in_state(State.MERGED)}
    moved, cost = list[Robot](), 0.0
    for robot in robots:
        if robot.name.map_id not in merged:
            moved.append(robot)
            continue
        known = robot.landmark_ids[np.isin(robot.landmark_ids, points.ids)]
        found = relinearise(robot.bundle, known, points.of(known))
        moved.append(replace(robot, bundle=found.bundle, landmark_ids=known))
        cost += found.cost_px2 / (robot.bundle.sigma_px**2 or 1.0)
    return tuple(moved), cost


def _compressed(robot: Robot, number: int) -> SubMap:
    name = replace(robot.name, revision=robot.name.revision + number - 1)
    return compress(robot.bundle, name, robot.landmark_ids, catalogue=False, dtype=np.float64)


def _landmarks(fusion: Fusion) -> _Points:
    landmarks = fusion.components[0].landmarks
    return _Points(landmarks.ids, landmarks.points_global)


def _in_frame_of(wanted: _Points, before: _Points) -> _Points:
    common = before.ids[np.isin(before.ids, wanted.ids)]
    S = align(wanted.of(common), before.of(common)).S_target_source
    return _Points(before.ids, S.apply(before.points_global))


def _between(before: _Points, wanted: _Points, share: float) -> _Points:
    moved = before.of(wanted.ids) + share * (wanted.points_global - before.of(wanted.ids))
    return _Points(wanted.ids, moved)


def _step_ratio(fusion: Fusion, taken: _Taken) -> float:
    if taken.before is None:
        return float('inf')
    std = fusion.components[0].landmarks.std
    moves = taken.after.points_global - taken.before.of(taken.after.ids)
    return float(np.max(np.linalg.norm(moves, axis=1) / np.linalg.norm(std, axis=1)))


def _require_merge(fusion: Fusion) -> None:
    if not fusion.in_state(State.MERGED):
        reasons = '; '.join(f'{item.submap.map_id}: {item.reason}' for item in fusion.alignments)
        raise NothingMerged(f'no two maps hang together: {reasons}')
