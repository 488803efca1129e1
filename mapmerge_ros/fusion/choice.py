# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
Which landmarks to ask for: in many maps, sure, spread over the overlap of every pair.

R is quadratic in its landmarks, so every sub-map has a budget. Each pair that overlaps gets a
fair share of both budgets first; what is left goes round again, until nothing is.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mapmerge_ros.arrays import Floats, Ids, Ints, Mask
from mapmerge_ros.fusion.catalogues import Tracks
from mapmerge_ros.fusion.common import Common, find_common
from mapmerge_ros.submap import SubMap


def choose_landmarks(
    submaps: Sequence[SubMap], tracks: Tracks, budgets: Sequence[int], min_shared: int = 1
) -> tuple[Ids, ...]:
    """
    Landmark ids that each sub-map should compress, most wanted first.

    `budgets` (maps,) is the most landmarks for each. Pairs with fewer than `min_shared` common
    tracks count as apart. A pair (a, b) gets all that it has in common, or at least the smaller
    of budget / partners of a and of b. A track is chosen in at least two sub-maps or in none.
    The result does not depend on any order or numbering; the start of each list is fair to all
    pairs too.
    """
    common = find_common(submaps, tracks)
    room = np.asarray(budgets, np.int64)[common.order]
    found = _Selection(common, room, min_shared).run()
    chosen: list[Ids] = [np.zeros(0, np.uint64)] * len(submaps)
    for k, place in enumerate(common.order):
        chosen[place] = common.ids(k, found[k])
    return tuple(chosen)


class _Selection:
    """
    The state of one choice.

    A track is taken in a sub-map only if that serves a pair which still needs one. So the room
    left in a sub-map never falls below what its pairs still need, and no pair is starved.
    """

    def __init__(self, common: Common, room: Ints, min_shared: int) -> None:
        self._common = common
        self._owners = common.owners
        self._room = np.maximum(room, 0)
        self._taken = np.zeros_like(self._owners)
        self._urgency = np.full(self._owners.shape, np.inf)
        """When each was taken: the round and the share of the pair's need before it"""
        counts = _pair_counts(self._owners)
        self._linked = (counts >= min_shared) & (counts > 0)
        self._need = np.zeros_like(counts)

    def run(self) -> list[Ints]:
        """Tracks chosen per sub-map, most wanted first."""
        turn = 0
        while self._set_needs():
            available = _pair_counts(self._owners) - _pair_counts(self._taken)
            pairs = np.argwhere(np.triu(self._need) > 0)
            for a, b in sorted(pairs, key=lambda pair: (available[tuple(pair)], *pair)):
                self._serve(int(a), int(b), turn)
            turn += 1
        self._join(turn)
        return [
            np.lexsort((np.arange(len(row)), -self._common.worth, row))[: taken.sum()]
            for row, taken in zip(self._urgency, self._taken, strict=True)
        ]

    def _set_needs(self) -> bool:
        """Divide the room left among the pairs with something left; whether there is any."""
        open_ = self._owners & ~self._taken & (self._room > 0)[:, None]
        available = _pair_counts(open_) * self._linked
        partners = (available > 0).sum(axis=1)
        share = np.maximum(self._room // np.maximum(partners, 1), self._room > 0)
        self._need = np.minimum(available, np.minimum.outer(share, share))
        return bool(self._need.any())

    def _serve(self, a: int, b: int, turn: int) -> None:
        """Give a pair what it needs: again and again the one that is farthest from the others."""
        shared = np.flatnonzero(self._owners[a] & self._owners[b])
        points, weights = self._places(a, shared), self._weights(a, b, shared)
        gaps = np.full(
            len(shared), 4.0 * np.sum((points - points.mean(axis=0)) ** 2, axis=1).max()
        )
        for place in np.flatnonzero(self._taken[a, shared] & self._taken[b, shared]):
            _narrow(gaps, points, place)
        need = int(self._need[a, b])
        while self._need[a, b] > 0:
            in_a, in_b = self._taken[a, shared], self._taken[b, shared]
            free = (in_a | (self._room[a] > 0)) & (in_b | (self._room[b] > 0)) & ~(in_a & in_b)
            if not free.any():
                return
            best = int(np.argmax(np.where(free, gaps * weights, -1.0)))
            served = 1.0 - self._need[a, b] / need
            self._take(int(shared[best]), a, b, turn + served)
            _narrow(gaps, points, best)

    def _places(self, k: int, tracks: Ints) -> Floats:
        points: Floats = self._common.submaps[k].points[self._common.rows[k, tracks]]
        return points

    def _weights(self, a: int, b: int, tracks: Ints) -> Floats:
        rows, sureness = self._common.rows, self._common.sureness
        both: Floats = sureness[a][rows[a, tracks]] * sureness[b][rows[b, tracks]]
        return np.sqrt(both) * self._common.worth[tracks]

    def _take(self, track: int, a: int, b: int, urgency: float) -> None:
        """Take a track in a and b, and wherever else it serves a pair that needs one."""
        old = self._taken[:, track].copy()
        takers = old.copy()
        takers[[a, b]] = True
        for c in np.flatnonzero(self._owners[:, track] & ~takers & (self._room > 0)):
            takers[c] = bool((self._need[c, takers] > 0).any())
        new = takers & ~old
        self._taken[new, track] = True
        self._urgency[new, track] = urgency
        self._room[new] -= 1
        members = np.flatnonzero(takers)
        served = new[members, None] | new[members]
        block = np.ix_(members, members)
        self._need[block] = np.maximum(self._need[block] - served, 0)

    def _join(self, turn: int) -> None:
        """Fill the room that is left with what partners have taken anyway."""
        takers = self._taken.sum(axis=0)
        for k in np.flatnonzero(self._room > 0):
            partners = self._linked[k] @ self._taken.astype(np.int64)
            free = np.flatnonzero(self._owners[k] & ~self._taken[k] & (partners > 0))
            rank = np.lexsort((free, -self._common.worth[free], -takers[free]))
            joined = free[rank[: self._room[k]]]
            self._urgency[k, joined] = turn
        self._taken |= np.isfinite(self._urgency)


def _narrow(gaps: Floats, points: Floats, place: int | np.integer[Any]) -> None:
    """Squared distance of each point to the nearest one that is taken."""
    np.minimum(gaps, np.sum((points - points[place]) ** 2, axis=1), out=gaps)


def _pair_counts(owned: Mask) -> Ints:
    """(maps, maps) tracks common to two sub-maps, zero on the diagonal."""
    members = owned.astype(np.float32)
    counts: Ints = np.rint(members @ members.T).astype(np.int64)
    np.fill_diagonal(counts, 0)
    return counts
