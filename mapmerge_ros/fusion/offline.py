# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Asking and answering in one step, where all bundles are at hand."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from mapmerge_ros.arrays import Ids
from mapmerge_ros.bundle import Bundle, MapName, announce
from mapmerge_ros.fusion.catalogues import Tracks, tracks_by_id
from mapmerge_ros.fusion.choice import choose_landmarks
from mapmerge_ros.submap import SubMap


def choose_for_bundles(
    bundles: Sequence[Bundle],
    names: Sequence[MapName],
    cap: int,
    match: Callable[[Sequence[SubMap]], Tracks] = tracks_by_id,
) -> tuple[Ids, ...]:
    """
    Points of each bundle that the fusion side would ask for, at most `cap`, most wanted first.

    `match` finds which landmarks of the announcements are one point.
    """
    announced = [announce(bundle, name) for bundle, name in zip(bundles, names, strict=True)]
    return choose_landmarks(announced, match(announced), [cap] * len(announced))
