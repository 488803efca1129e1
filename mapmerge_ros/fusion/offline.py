# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Asking and answering in one step, where all bundles are at hand."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mapmerge_ros.arrays import Ids, Ints, Mask
from mapmerge_ros.association import associate
from mapmerge_ros.bundle import Bundle, MapName, announce
from mapmerge_ros.bundle.quality import TrackQuality, good_tracks
from mapmerge_ros.fusion.catalogues import ALONE, Tracks
from mapmerge_ros.fusion.choice import choose_landmarks
from mapmerge_ros.submap import most_landmarks


def choose_for_bundles(
    bundles: Sequence[Bundle],
    names: Sequence[MapName],
    cap: int,
    quality: TrackQuality | None = None,
    max_bytes: int = 0,
    *,
    catalogue: bool = True,
) -> tuple[Ids, ...]:
    """
    Points of each bundle that the fusion side would ask for, at most `cap`, most wanted first.

    With `max_bytes`, no more than keep the message, with its catalogue or without, to that size.

    Common points are found by id within an id space, by descriptors elsewhere. With `quality`,
    only those that a robot sees well, and the best of every area, see `good_tracks`.
    """
    announced = [announce(bundle, name) for bundle, name in zip(bundles, names, strict=True)]
    found = associate(announced)
    views = np.bincount(np.concatenate(found.tracks), minlength=found.count)
    tracks = [
        own if quality is None else _good_only(bundle, own, views[own] > 1, quality)
        for bundle, own in zip(bundles, found.tracks, strict=True)
    ]
    caps = [
        min(cap, most_landmarks(each, max_bytes, catalogue=catalogue)) if max_bytes else cap
        for each in announced
    ]
    return choose_landmarks(announced, Tracks(tuple(tracks), found.count), caps)


def _good_only(bundle: Bundle, tracks: Ints, common: Mask, quality: TrackQuality) -> Ints:
    """Take the common points (n,) that the bundle sees badly out of their tracks."""
    rows = np.flatnonzero(common)
    kept = tracks.copy()
    kept[rows[~good_tracks(bundle, rows, quality)]] = ALONE
    return kept
