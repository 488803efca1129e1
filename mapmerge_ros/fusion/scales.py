# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
Whether the scale of each metric sub-map is that of the others.

One direction among hundreds: ten standard deviations of it hardly show in the price of a merge.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapmerge_ros.arrays import Floats
from mapmerge_ros.fusion.local import Sensitivity
from mapmerge_ros.fusion.quadratic import Quadratic
from mapmerge_ros.geometry import Gauge

LEAST_STATISTIC = 36.0
"""χ²(1) from which a scale is wrong: six standard deviations, since priors are often too sure."""


@dataclass(frozen=True, slots=True)
class ScaleTest:
    """How much larger a sub-map is than the others have it."""

    k: int
    log_scale: float
    std: float

    @property
    def statistic(self) -> float:
        """χ²(1) if nothing is wrong."""
        return (self.log_scale / self.std) ** 2


def wrong_scale(state: Sensitivity, merge: Quadratic) -> ScaleTest | None:
    """Metric sub-map whose scale is farthest off, if it is; None below three sub-maps."""
    metric = [k for k, gauge in enumerate(merge.gauges) if gauge is not Gauge.SIMILARITY]
    if len(metric) < 3:
        return None
    worst = max((_tested(state, merge.points, k) for k in metric), key=lambda test: test.statistic)
    return worst if worst.statistic >= LEAST_STATISTIC else None


def _tested(state: Sensitivity, points: Floats, k: int) -> ScaleTest:
    part = state.members.of_map(k)
    here = points[state.members.tracks[part]]
    growth = (here - here.mean(axis=0)).ravel()
    information = float(growth @ state.within[k] @ growth)
    if not information > 0.0:
        return ScaleTest(k, 0.0, 1.0)
    score = float(growth @ state.score[part].ravel())
    return ScaleTest(k, score / information, float(1.0 / np.sqrt(information)))
