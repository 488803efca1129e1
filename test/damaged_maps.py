# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Fleets of simulated drones, and sub-maps that are wrong as a whole, one of a fleet."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mapmerge_ros.bundle.bundle import FramePrior
from mapmerge_ros.geometry import Gauge
from mapmerge_ros.simulation import FleetConfig, simulate_fleet
from mapmerge_ros.simulation.drones import Sensing
from mapmerge_ros.submap import SubMap


def six_drones() -> list[SubMap]:
    return list(simulate_fleet(FleetConfig(drones=6), 71).submaps(catalogue=False))


def metric_drones() -> list[SubMap]:
    """Four whose scale is known to 0.3 per cent."""
    sensing = Sensing(gauge=Gauge.RIGID, prior=FramePrior(scale_std_ratio=0.003))
    return list(simulate_fleet(FleetConfig(sensing=sensing), 70).submaps(catalogue=False))


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
