# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Joint merges of simulated drones of every gauge, a part of their landmarks private."""

from dataclasses import replace

import numpy as np

from mapmerge_ros.fusion import FusionConfig
from mapmerge_ros.fusion.associate import associate_by_id
from mapmerge_ros.fusion.element import Element
from mapmerge_ros.fusion.informations import informations
from mapmerge_ros.fusion.joint.cost import JointCost
from mapmerge_ros.fusion.joint.minimise import minimise
from mapmerge_ros.fusion.joint.start import initial_points
from mapmerge_ros.fusion.links import find_links
from mapmerge_ros.fusion.overlap import spanning_tree
from mapmerge_ros.geometry import Gauge
from mapmerge_ros.simulation import FleetConfig, Sensing, simulate_fleet

GAUGES = [Gauge.SIMILARITY, Gauge.RIGID, Gauge.YAW_TRANSLATION, Gauge.NONE]
CASES = [[gauge] * 6 for gauge in GAUGES]
CASES.append([7, 6, 4, 7, 6, 7])
IDS = ['similarity', 'rigid', 'yaw', 'none', 'mixed']
CONFIG = FusionConfig(convergence=1e-6)
"""Held against the plain form, a merge ends where only rounding is left."""


def made_fleets():
    """Six drones on a grid per gauge; a fifth of what they compress is private."""
    made = {}
    for gauge in GAUGES:
        config = FleetConfig(drones=6, keyframes=16, landmarks=140, sensing=Sensing(gauge=gauge))
        fleet = simulate_fleet(config, 3)
        made[gauge] = fleet.submaps(catalogue=False)
    return made


def case(fleets, gauges):
    submaps = [fleets[Gauge(gauge)][k] for k, gauge in enumerate(gauges)]
    own = [submap.compressed_ids[::9] for submap in submaps]
    submaps = [
        replace(
            submap,
            landmark_ids=np.where(
                np.isin(submap.landmark_ids, ids),
                submap.landmark_ids + np.uint64(10**6 * (k + 1)),
                submap.landmark_ids,
            ),
        )
        for k, (submap, ids) in enumerate(zip(submaps, own, strict=True))
    ]
    association = associate_by_id(submaps)
    weights = np.linspace(0.5, 2.0, len(submaps))
    is_shared = association.views > 1
    elements = [
        Element.from_submap(submap, tracks, is_shared[tracks], weight)
        for submap, tracks, weight in zip(submaps, association.tracks, weights, strict=True)
    ]
    return (
        submaps,
        association,
        elements,
        JointCost.of(submaps, association.tracks, is_shared, weights, informations(submaps)),
    )


def merged(submaps, association, cost):
    links = find_links(submaps, association, CONFIG)
    centre, frames = spanning_tree(range(len(cost)), [Gauge(int(g)) for g in cost.gauges], links)
    gauge = Gauge(int(cost.gauges.min()))
    return minimise(cost.reduced(), initial_points(cost.reduced(), frames, centre), gauge, CONFIG)


def at_optimum(submaps, association, cost):
    found = merged(submaps, association, cost)
    assert found.converged
    return found, cost.evaluate(cost.recover_private(found.points, association.count))
