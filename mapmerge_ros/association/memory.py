# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What was found about pairs of sub-maps, kept for as long as their landmarks stay the same."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from mapmerge_ros.arrays import Ints
from mapmerge_ros.association.align_pair import match_pair
from mapmerge_ros.association.config import AssociationConfig
from mapmerge_ros.association.pair import PairMatch
from mapmerge_ros.association.second_look import Links
from mapmerge_ros.association.signature import Signature, signature
from mapmerge_ros.submap import SubMap

Key = tuple[bytes, bytes]


class Memory:
    """
    Pairs that were matched before. Not thread-safe: one owner.

    A revision that only compresses other landmarks of the same map costs nothing again. What the
    last association did not use is forgotten.
    """

    def __init__(self) -> None:
        self._kept: dict[Key, PairMatch] = {}
        self._used: dict[Key, PairMatch] = {}
        self._kept_signatures: dict[bytes, Signature] = {}
        self._used_signatures: dict[bytes, Signature] = {}
        self._kept_links: dict[Key, Links] = {}
        self._used_links: dict[Key, Links] = {}

    def turn(self) -> None:
        """Begin an association: forget what the one before did not use."""
        self._kept, self._used = self._used, {}
        self._kept_links, self._used_links = self._used_links, {}
        self._kept_signatures, self._used_signatures = self._used_signatures, {}

    def signature(self, a: Named, config: AssociationConfig) -> Signature:
        """Return what screening knows of a map, from memory if there."""
        found = self._kept_signatures.get(a.key)
        self._used_signatures[a.key] = (
            found if found is not None else signature(a.submap.descriptors[a.order], config)
        )
        return self._used_signatures[a.key]

    def match(self, a: Named, b: Named, config: AssociationConfig) -> PairMatch:
        """Return `match_pair`, from memory if there."""
        key = a.key, b.key
        found = self._kept.get(key)
        if found is None:
            by_rows = match_pair(a.submap, b.submap, config)
            found = _exchanged_rows(by_rows, a.ranks, b.ranks)
        self._used[key] = found
        return _exchanged_rows(found, a.order, b.order)

    def links(self, a: Named, b: Named, look: Callable[[], Links]) -> Links:
        """Return the second look at a pair, from memory if there."""
        key = a.key, b.key
        found = self._kept_links.get(key)
        self._used_links[key] = found if found is not None else look()
        return self._used_links[key]


class Named:
    """A sub-map, and a name that only its landmarks decide."""

    def __init__(self, submap: SubMap) -> None:
        self.submap = submap
        self.order: Ints = np.argsort(submap.landmark_ids)
        """(n,) row in the message of each landmark, by id"""
        self.ranks: Ints = np.argsort(self.order)
        """(n,) place by id of each row of the message"""
        digest = hashlib.blake2b(digest_size=16)
        digest.update(f'{submap.map_id} {int(submap.gauge)} {submap.descriptors.type}'.encode())
        digest.update(submap.landmark_ids[self.order].tobytes())
        digest.update(submap.points[self.order].tobytes())
        digest.update(submap.descriptors.rows[self.order].tobytes())
        if submap.covariances is not None:
            digest.update(submap.covariances[self.order].tobytes())
        self.key = digest.digest()


def _exchanged_rows(match: PairMatch, a: Ints, b: Ints) -> PairMatch:
    return replace(
        match,
        rows_a=a[match.rows_a],
        rows_b=b[match.rows_b],
        candidates_a=a[match.candidates_a],
        candidates_b=b[match.candidates_b],
    )
