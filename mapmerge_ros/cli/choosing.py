# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Which points of the given models are compressed, within a budget."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapmerge_ros.arrays import Ids
from mapmerge_ros.bundle import Bundle, MapName, announce
from mapmerge_ros.bundle.quality import TrackQuality
from mapmerge_ros.bundle.selection import ranked_tracks
from mapmerge_ros.cli import console
from mapmerge_ros.errors import InvalidValue
from mapmerge_ros.fusion.offline import choose_for_bundles
from mapmerge_ros.io.wording import readable_bytes
from mapmerge_ros.submap import catalogue_bytes, most_landmarks

_NOTHING_COMMON = (
    'no two models have a landmark in common: without --id-space NAME they are matched by '
    'descriptors (descriptors.npz beside each model), see mapmerge info for the reasons'
)


@dataclass(frozen=True, slots=True)
class Budget:
    """What a sub-map may be."""

    max_landmarks: int
    """Of those that are chosen because another model has them"""
    max_bytes: int = 0
    """Of its message; 0 = no limit"""
    catalogue: bool = True


def choose(
    bundles: Sequence[Bundle],
    names: Sequence[MapName],
    wanted: str | int,
    budget: Budget,
    good_only: bool = False,
) -> tuple[Ids, ...]:
    """
    Ids of the points to compress, per bundle.

    Raises
    ------
    InvalidValue
        Not even a sub-map without compressed landmarks keeps the bytes.

    """
    quality = TrackQuality()
    most = [_most(*own, budget) for own in zip(bundles, names, strict=True)]
    matched: tuple[Ids, ...] = tuple(bundle.point_ids[:0] for bundle in bundles)
    if wanted == 'matched' or (wanted != 'all' and len(bundles) > 1):
        cap = budget.max_landmarks if wanted == 'matched' else int(wanted)
        matched = choose_for_bundles(
            bundles,
            names,
            cap,
            quality if good_only else None,
            budget.max_bytes,
            catalogue=budget.catalogue,
        )
    if wanted == 'matched':
        if len(bundles) > 1 and not any(len(ids) for ids in matched):
            console.warn(_NOTHING_COMMON)
        return matched
    counts = [len(bundle.point_ids) if wanted == 'all' else int(wanted) for bundle in bundles]
    return tuple(
        _filled(bundle, ids, min(count, room), quality)
        for bundle, ids, count, room in zip(bundles, matched, counts, most, strict=True)
    )


def _most(bundle: Bundle, name: MapName, budget: Budget) -> int:
    """Landmarks that keep the bytes."""
    if not budget.max_bytes:
        return len(bundle.point_ids)
    announced = announce(bundle, name)
    most = most_landmarks(announced, budget.max_bytes, catalogue=budget.catalogue)
    if 3 * most <= int(bundle.gauge):
        size = readable_bytes(catalogue_bytes(announced)) if budget.catalogue else ''
        remedy = f'the catalogue alone has {size}: --no-catalogue' if size else 'give more'
        raise InvalidValue(
            f'{name.map_id}: --max-bytes {budget.max_bytes} leaves {most} landmarks: {remedy}'
        )
    return most


def _filled(bundle: Bundle, ids: Ids, count: int, quality: TrackQuality) -> Ids:
    """`ids`, and the best tracks beside them until there are `count`."""
    if len(ids) >= count:
        return ids[:count]
    ranked = ranked_tracks(bundle, quality)
    others = ranked[~np.isin(ranked, ids)]
    return np.concatenate([ids, others[: count - len(ids)]])
