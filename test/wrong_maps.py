# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Sub-maps that are wrong as a whole, one of a fleet."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mapmerge_ros.submap import SubMap


def bent(submap: SubMap, share: float) -> SubMap:
    centred = submap.points - submap.points.mean(axis=0)
    axes = np.linalg.svd(centred, full_matrices=False)[2]
    along = centred @ axes[0]
    raised = np.outer(share * along**2 / np.abs(along).max(), axes[2])
    return replace(submap, points=submap.points + raised)


def shaken(submap: SubMap, factor: float, seed: int) -> SubMap:
    white = factor * submap.sigma * np.random.default_rng(seed).normal(size=submap.rank)
    errors = np.linalg.lstsq(submap.triangle(), white, rcond=None)[0].reshape(-1, 3)
    return replace(submap, points=submap.points + errors)


def with_one(submaps, k, damaged):
    return [damaged if at == k else submap for at, submap in enumerate(submaps)]
