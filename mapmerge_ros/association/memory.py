# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What was found about pairs of sub-maps, kept for as long as their landmarks stay the same."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace
from typing import Generic, TypeVar

import numpy as np

from mapmerge_ros.arrays import Ints
from mapmerge_ros.association.align_pair import match_pair
from mapmerge_ros.association.config import AssociationConfig
from mapmerge_ros.association.pair import PairMatch
from mapmerge_ros.association.second_look import Links
from mapmerge_ros.association.signature import Signature, signature
from mapmerge_ros.submap import SubMap

Key = tuple[bytes, bytes]
K = TypeVar('K')
V = TypeVar('V')


class Generations(Generic[K, V]):
    """Values by key; those that a generation did not use are forgotten with the next."""

    def __init__(self) -> None:
        self._before: dict[K, V] = {}
        self._now: dict[K, V] = {}

    def turn(self) -> None:
        """Begin a generation."""
        self._before, self._now = self._now, {}

    def find(self, key: K) -> V | None:
        """Return what is kept, which is used by that."""
        found = self._now.get(key, self._before.get(key))
        if found is not None:
            self._now[key] = found
        return found

    def earlier(self, key: K) -> V | None:
        """Return what the generation before had, which is not used by that."""
        return self._before.get(key)

    def keep(self, key: K, value: V) -> None:
        """Keep a value for this generation and the next."""
        self._now[key] = value

    def get(self, key: K, make: Callable[[], V]) -> V:
        """Return what is kept, or what is made now."""
        found = self.find(key)
        if found is None:
            found = make()
            self.keep(key, found)
        return found


class Memory:
    """
    Pairs that were matched before. Not thread-safe: one owner.

    A revision that only compresses other landmarks of the same map costs nothing again. What the
    last association did not use is forgotten.
    """

    def __init__(self) -> None:
        self._matches = Generations[Key, PairMatch]()
        self._links = Generations[Key, Links]()
        self._signatures = Generations[bytes, Signature]()

    def turn(self) -> None:
        """Begin an association: forget what the one before did not use."""
        for kept in (self._matches, self._links, self._signatures):
            kept.turn()

    def signature(self, a: Named, config: AssociationConfig) -> Signature:
        """Return what screening knows of a map, from memory if there."""
        return self._signatures.get(
            a.key, lambda: signature(a.submap.descriptors[a.order], config)
        )

    def match(self, a: Named, b: Named, config: AssociationConfig) -> PairMatch:
        """Return `match_pair`, from memory if there."""

        def by_rank() -> PairMatch:
            return _exchanged_rows(match_pair(a.submap, b.submap, config), a.ranks, b.ranks)

        return _exchanged_rows(self._matches.get((a.key, b.key), by_rank), a.order, b.order)

    def links(self, a: Named, b: Named, look: Callable[[], Links]) -> Links:
        """Return the second look at a pair, from memory if there."""
        return self._links.get((a.key, b.key), look)


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
