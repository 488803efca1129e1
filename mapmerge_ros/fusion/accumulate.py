# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What has arrived: the newest revision of every sub-map, no measurement twice."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from mapmerge_ros.fusion.refusal import Refusal
from mapmerge_ros.submap import SubMap


@dataclass(frozen=True, slots=True)
class Receipt:
    """Whether a sub-map was taken in, and if not, why."""

    accepted: bool
    reason: str = ''
    restarted: bool = False
    """Whether its robot counts revisions anew"""
    conflict: bool = False
    """Whether it was left out although it is news: another robot's name, or an old revision's"""


class Store:
    """Newest revision of each map_id. Not thread-safe: one owner."""

    def __init__(self, own_map_id: str) -> None:
        self._own_map_id = own_map_id
        self._submaps: dict[str, SubMap] = {}

    def add(self, submap: SubMap) -> Receipt:
        """
        Take a sub-map in, unless it is our own output, another robot's name, or no newer.

        A robot that was restarted under its name may count revisions from the beginning. What it
        sends then has newer measurements than anything from its life before, which no late
        message of an older revision can have.
        """
        if submap.map_id == self._own_map_id:
            return Receipt(False, f'{submap.map_id} is the map that this fusion publishes')
        known = self._submaps.get(submap.map_id)
        if known is not None and known.robot_id != submap.robot_id:
            return Receipt(
                False,
                f'map_id {submap.map_id} belongs to robot {known.robot_id!r}: '
                f'robot {submap.robot_id!r} needs one of its own',
                conflict=True,
            )
        is_newer = known is None or known.revision < submap.revision
        if known is not None and not is_newer and not _is_of_next_life(submap, known):
            reason = f'revision {submap.revision} is not newer than {known.revision}'
            if submap.revision == known.revision and not _is_repetition(submap, known):
                reason += ', but its landmarks are others: a map that changes needs a higher one'
                return Receipt(False, reason, conflict=True)
            return Receipt(False, reason)
        self._submaps[submap.map_id] = submap
        return Receipt(True, restarted=not is_newer)

    def remove(self, map_ids: Iterable[str]) -> int:
        """Forget sub-maps; return how many were known."""
        return sum(self._submaps.pop(map_id, None) is not None for map_id in tuple(map_ids))

    def snapshot(self) -> tuple[SubMap, ...]:
        """All sub-maps by map_id: the order of arrival leaves no trace."""
        return tuple(self._submaps[map_id] for map_id in sorted(self._submaps))


def _is_of_next_life(submap: SubMap, known: SubMap) -> bool:
    """Whether a revision that is not above the known one was made after it all the same."""
    if submap.stamp_ns <= known.stamp_ns:
        return False
    # Who stamps a repetition anew has not begun again.
    return submap.revision < known.revision or not _is_repetition(submap, known)


def _is_repetition(submap: SubMap, known: SubMap) -> bool:
    return np.array_equal(submap.points, known.points)


def without_duplicates(
    submaps: Iterable[SubMap],
) -> tuple[tuple[SubMap, ...], tuple[Refusal, ...]]:
    """
    Sub-maps without a common leaf, and those left out so that no data counts twice.

    A merged map whose leaves are all here themselves adds nothing to them (as where the output of
    a fusion was recorded beside its inputs). Of others the one with more leaves stays; between
    equals the one whose map_id comes first.
    """
    by_size = sorted(submaps, key=lambda submap: (-len(submap.sources), submap.map_id))
    leaves_here = {one.map_id: one.revision for one in by_size if _is_leaf(one)}
    owners: dict[str, str] = {}
    kept, refused = [], []
    for submap in by_size:
        if not _is_leaf(submap) and all(
            leaves_here.get(source.map_id, -1) >= source.revision for source in submap.sources
        ):
            count = len(submap.sources)
            reason = f'all it is merged from ({count} sub-maps) is here itself, and as new'
            refused.append(Refusal(submap.map_id, reason))
            continue
        leaves = [source.map_id for source in submap.sources]
        twice = next((leaf for leaf in leaves if leaf in owners), None)
        if twice is None:
            kept.append(submap)
            owners.update((leaf, submap.map_id) for leaf in leaves)
        else:
            reason = f'its data would count twice: {twice} is already inside {owners[twice]}'
            refused.append(Refusal(submap.map_id, reason))
    return tuple(sorted(kept, key=lambda submap: submap.map_id)), tuple(refused)


def _is_leaf(submap: SubMap) -> bool:
    return [source.map_id for source in submap.sources] == [submap.map_id]
