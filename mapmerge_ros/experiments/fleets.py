# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Simulated sessions of the paper as one fleet: their maps, their truth, their full bundle."""

from __future__ import annotations

from collections.abc import Sequence

from mapmerge_ros.bundle import MapName
from mapmerge_ros.simulation import Fleet, Scene, Session, Truth

ID_SPACE = 'scene'


def fleet_of(scene: Scene, sessions: Sequence[Session]) -> Fleet:
    """Sessions of one scene in which nothing moved; ids are those of the scene."""
    return Fleet(
        bundles=tuple(session.bundle for session in sessions),
        names=tuple(map_name(k) for k in range(len(sessions))),
        truth=Truth(
            scene=scene,
            moved=(),
            S_world_map=tuple(session.S_world_map for session in sessions),
            bundles=tuple(session.truth for session in sessions),
            landmark_ids=tuple(session.landmark_ids for session in sessions),
        ),
    )


def map_name(k: int) -> MapName:
    """Name of the map of session k."""
    return MapName(f'map{k + 1}', f'robot{k + 1}', stamp_ns=k, id_space=ID_SPACE)
