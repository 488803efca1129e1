# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What one fusion leaves for the next one, of nearly the same sub-maps."""

from __future__ import annotations

from collections.abc import Sequence

from mapmerge_ros.association.memory import Generations, Memory
from mapmerge_ros.fusion.config import FusionConfig
from mapmerge_ros.fusion.informations import informations
from mapmerge_ros.fusion.joint.resume import Resumable
from mapmerge_ros.fusion.overlap import Link
from mapmerge_ros.submap import LandmarkInformation, SubMap

PairKey = tuple[int, int]
"""Identities of two sub-maps, which are held by `informations`"""

Condition = tuple[bytes, bytes, FusionConfig]
"""Rows of the common landmarks in the one and in the other sub-map; settings"""

Known = tuple[Link, Condition]


class Warm(Memory):
    """
    Memory of a fusion: matches of pairs, their links, and the last merge. Not thread-safe.

    Sub-maps are immutable, so that one is known by its identity; each is held here as long as
    what was made of it, and what the last fusion did not use is forgotten.
    """

    def __init__(self) -> None:
        super().__init__()
        self._informations = Generations[int, tuple[SubMap, LandmarkInformation]]()
        self._pairs = Generations[PairKey, Known]()
        self._merges = Generations[str, Resumable]()

    def turn(self) -> None:
        """Begin a fusion: forget what the one before did not use."""
        super().turn()
        for kept in (self._informations, self._pairs, self._merges):
            kept.turn()

    def informations(self, submaps: Sequence[SubMap]) -> tuple[LandmarkInformation, ...]:
        """Of the compressed landmarks of each sub-map."""
        known = {id(one): self._informations.find(id(one)) for one in submaps}
        new = [submap for submap in submaps if known[id(submap)] is None]
        for submap, information in zip(new, informations(new), strict=True):
            self._informations.keep(id(submap), (submap, information))
            known[id(submap)] = submap, information
        return tuple(found[1] for one in submaps if (found := known[id(one)]))

    def known_link(self, a: SubMap, b: SubMap, condition: Condition) -> Link | None:
        """Link of two sub-maps, if it was found under the same conditions."""
        key = id(a), id(b)
        known = self._pairs.earlier(key)
        if known is None or known[1] != condition:
            return None
        self._pairs.keep(key, known)
        return known[0]

    def learn_link(self, a: SubMap, b: SubMap, condition: Condition, link: Link) -> None:
        """Keep a link, its contradicting landmarks numbered within the pair."""
        self._pairs.keep((id(a), id(b)), (link, condition))

    def last_merge(self, map_ids: Sequence[str]) -> Resumable | None:
        """Last merge, of the fusion before, that had the most of these sub-maps."""
        found = [merge for name in map_ids if (merge := self._merges.earlier(name))]
        return max(found, key=found.count, default=None)

    def learn_merge(self, merge: Resumable) -> None:
        """Keep a merge for the next time."""
        for name in merge.members.map_ids:
            self._merges.keep(name, merge)
