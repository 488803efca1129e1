# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
A robot takes merged landmarks over, re-optimises the rest, and is ready to linearise again.

Rounds of this are Gauss-Newton on the full bundle of all robots, with compressed sub-maps as the
only thing that is exchanged (the robot's side of DESIGN "Close the loop with the robot").
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapmerge_ros.arrays import Floats, Ids, Ints
from mapmerge_ros.bundle.bundle import Bundle
from mapmerge_ros.bundle.compress import eliminate, into_map
from mapmerge_ros.bundle.follow import follow
from mapmerge_ros.bundle.linearise import linearise
from mapmerge_ros.errors import InvalidValue

MAX_STEPS = 30
RELATIVE_DECREASE = 1e-15
"""Of the cost: the rounds shall end at 1e-8 of it, so one of them must be far more exact."""

MAX_HALVINGS = 12
"""A step of 1/4000 that still does not lower the cost is rounding, or points the wrong way."""


@dataclass(frozen=True, slots=True, eq=False)
class Relinearised:
    """A bundle whose shared points lie where the fusion found them; all else is at its best."""

    bundle: Bundle
    cost_px2: float
    """r'r with the shared points held fixed"""
    steps: int
    converged: bool


def relinearise(bundle: Bundle, landmark_ids: Ids, points_global: Floats) -> Relinearised:
    """
    Move some points of a bundle to merged positions (k, 3) and re-optimise everything else.

    The points come in any frame of the bundle's gauge. The first step is that of ds/dq; further
    Gauss-Newton steps keep the shared points and never raise the cost. `compress` of the result
    gives the next revision, with its c.

    Raises
    ------
    InvalidValue
        An id that the bundle does not have, or a point that would be behind its camera.
    DegenerateGeometry
        Too few landmarks to hold the cameras.

    """
    rows = bundle.rows_of(np.asarray(landmark_ids, np.uint64))
    current = _follow(bundle, rows, points_global)
    cost = linearise(current).cost_px2
    for step in range(1, MAX_STEPS + 1):
        before, (current, cost) = cost, _improved(current, rows, cost)
        if before - cost <= RELATIVE_DECREASE * before:
            return Relinearised(current, cost, step, True)
    return Relinearised(current, cost, MAX_STEPS, False)


def _follow(bundle: Bundle, rows: Ints, points_global: Floats) -> Bundle:
    lin = linearise(bundle)
    found = eliminate(lin, rows)
    S_map_global = into_map(bundle, rows, found, points_global)
    shared_steps = S_map_global.apply(points_global) - bundle.points[rows]
    return follow(lin, rows, found.steps(lin, shared_steps))


def _improved(bundle: Bundle, rows: Ints, cost: float) -> tuple[Bundle, float]:
    """One step of everything but the shared points that does not raise the cost, halved to fit."""
    lin, still = linearise(bundle), np.zeros((len(rows), 3))
    pose_steps, point_steps, lens_steps = eliminate(lin, rows).steps(lin, still)
    share = 1.0
    for _ in range(MAX_HALVINGS):
        try:
            trial = lin.moved(share * pose_steps, share * point_steps, share * lens_steps)
        except InvalidValue:  # a badly determined point stepped behind its camera
            share /= 2.0
            continue
        trial_cost = linearise(trial).cost_px2
        if trial_cost <= cost:
            return trial, trial_cost
        share /= 2.0
    return bundle, cost
