# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The experiments by name."""

from __future__ import annotations

import mapmerge_ros.experiments.bookshelf as bookshelf
import mapmerge_ros.experiments.corrupt as corrupt
import mapmerge_ros.experiments.early_stop as early_stop
import mapmerge_ros.experiments.gamma as gamma
import mapmerge_ros.experiments.loop_closure as loop_closure
import mapmerge_ros.experiments.office as office
import mapmerge_ros.experiments.relinearise as relinearise
from mapmerge_ros.experiments.result import Experiment

_MODULES = (gamma, early_stop, loop_closure, bookshelf, office, corrupt, relinearise)

EXPERIMENTS: dict[str, Experiment] = {
    module.EXPERIMENT.name: module.EXPERIMENT for module in _MODULES
}
"""In the order of the paper, then ours"""
