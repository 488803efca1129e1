# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
Which landmarks to ask for: in many maps, sure, and standing for all that maps have in common.

R is quadratic in its landmarks, so every sub-map has a budget. First the map graph is held
together: every pair of its maximum spanning forest gets a few. The rest of each budget goes where
it brings the common landmarks of all maps closest to a chosen one.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph

from mapmerge_ros.arrays import Ids, Ints, Mask
from mapmerge_ros.fusion.catalogues import Tracks
from mapmerge_ros.fusion.common import Common, find_common
from mapmerge_ros.fusion.coverage import Coverage, mean_sureness
from mapmerge_ros.submap import SubMap

ENOUGH = 8
"""
Landmarks that hold a pair of the spanning forest together, where it has them.

Twice the four of `min_shared`: half of them may be wrong or lost. Fair shares of whole budgets
for every pair cost accuracy: on Caliterra a quarter more error than landmarks drawn by lot.
"""


def choose_landmarks(
    submaps: Sequence[SubMap], tracks: Tracks, budgets: Sequence[int], min_shared: int = 1
) -> tuple[Ids, ...]:
    """
    Landmark ids that each sub-map should compress, most wanted first.

    `budgets` (maps,) is the most landmarks for each. Pairs with fewer than `min_shared` common
    tracks count as apart. A pair of the maximum spanning forest gets ENOUGH, all that it has in
    common, or the smaller of budget / partners in the forest of both. A track is chosen in at
    least two sub-maps or in none. The result does not depend on any order or numbering; what
    holds the forest together is at the start of each list.
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

    In the forest a track is taken in a sub-map only if that serves a pair which still needs one,
    or if there is room for more. So the room left never falls below what the pairs still need.
    """

    def __init__(self, common: Common, room: Ints, min_shared: int) -> None:
        self._common = common
        self._coverage = Coverage(common)
        self._worth = common.worth * mean_sureness(common)
        counts = _pair_counts(common.owners)
        self._counts = np.where(counts >= min_shared, counts, 0)
        self._linked = self._counts > 0
        self._owners = common.owners & ((self._linked.astype(np.int64) @ common.owners) > 0)
        self._room = np.maximum(room, 0)
        self._taken = np.zeros_like(self._owners)
        self._urgency = np.full(self._owners.shape, np.inf)
        """When each was taken"""
        self._need = np.zeros_like(counts)

    def run(self) -> list[Ints]:
        """Tracks chosen per sub-map, most wanted first."""
        self._set_needs()
        pairs = np.argwhere(np.triu(self._need) > 0)
        for a, b in sorted(pairs, key=lambda pair: (self._counts[tuple(pair)], *pair)):
            self._serve(int(a), int(b))
        self._cover()
        self._join()
        return [
            np.lexsort((np.arange(len(row)), -self._common.worth, row))[: taken.sum()]
            for row, taken in zip(self._urgency, self._taken, strict=True)
        ]

    def _set_needs(self) -> None:
        """Divide the room among the pairs of the forest, as far as it takes to hold them."""
        tree = scipy.sparse.csgraph.minimum_spanning_tree(-self._counts).toarray() < 0.0
        forest = tree | tree.T
        share = self._room // np.maximum(forest.sum(axis=1), 1)
        share = np.minimum(np.maximum(share, self._room > 0), ENOUGH)
        self._need = np.where(forest, np.minimum(np.minimum.outer(share, share), self._counts), 0)

    def _serve(self, a: int, b: int) -> None:
        """Give a pair what it needs, the best first."""
        shared = np.flatnonzero(self._owners[a] & self._owners[b])
        need = int(self._need[a, b])
        while self._need[a, b] > 0:
            free = ~(self._taken[a, shared] & self._taken[b, shared])
            for k in (a, b):
                if not self._room[k]:  # only what is taken already can serve the pair
                    free &= self._taken[k, shared]
            if not free.any():
                return
            gains = (self._coverage.gains(a) + self._coverage.gains(b))[shared]
            best = shared[np.argmax(np.where(free, gains * self._worth[shared], -1.0))]
            self._take_for(int(best), a, b, 1.0 - self._need[a, b] / need)

    def _take_for(self, track: int, a: int, b: int, urgency: float) -> None:
        """Take a track in a and b, and wherever that leaves room for what pairs need."""
        takers = self._taken[:, track].copy()
        takers[[a, b]] = True
        for c in np.flatnonzero(self._owners[:, track] & ~takers & (self._room > 0)):
            is_needed = bool((self._need[c, takers] > 0).any())
            takers[c] = is_needed or self._is_free(int(c), takers)
        new = takers & ~self._taken[:, track]
        self._take(track, new, urgency)
        members = np.flatnonzero(takers)
        block = np.ix_(members, members)
        self._need[block] = np.maximum(self._need[block] - (new[members, None] | new[members]), 0)

    def _is_free(self, k: int, takers: Mask) -> bool:
        """Whether a sub-map has more room than its pairs need, and is linked to who takes it."""
        is_linked = bool(self._linked[k, takers].any())
        return is_linked and bool(self._room[k] > self._need[k].sum())

    def _take(self, track: int, new: Mask, urgency: float) -> None:
        self._taken[new, track] = True
        self._urgency[new, track] = urgency
        self._room[new] -= 1
        for k in np.flatnonzero(new):
            self._coverage.take(int(k), track)

    def _cover(self) -> None:
        """Take what gains most for its place, again and again; gains only fall on the way."""
        queue = self._queue()
        turn = 1.0
        while queue:
            _, track = heapq.heappop(queue)
            new = self._takers(track)
            present = -self._value(track, new)
            if not new.any():
                continue
            if queue and present > queue[0][0]:
                heapq.heappush(queue, (present, track))
                continue
            self._take(track, new, turn)
            turn += 1.0
            if not self._room[new].all():  # without the map that is full, others may gain more
                queue = self._queue()

    def _queue(self) -> list[tuple[float, int]]:
        """Every track that could still be taken, as a heap of negative values."""
        new = self._owners & ~self._taken & (self._room > 0)[:, None]
        new &= (self._linked.astype(np.int64) @ (self._taken | new)) > 0
        gains = np.array([self._coverage.gains(k) for k in range(len(new))])
        open_ = np.flatnonzero(new.any(axis=0))
        values = np.where(new, gains, 0.0).sum(axis=0)[open_] / new.sum(axis=0)[open_]
        found = list(zip((-values * self._worth[open_]).tolist(), open_.tolist(), strict=True))
        heapq.heapify(found)
        return found

    def _takers(self, track: int) -> Mask:
        """Sub-maps that would take a track: with room, and linked to another that has it then."""
        taken = self._taken[:, track]
        new = self._owners[:, track] & ~taken & (self._room > 0)
        new &= self._linked[:, taken | new].any(axis=1)
        return np.asarray(new)

    def _value(self, track: int, new: Mask) -> float:
        """What a track gains in the mean over those that would take it."""
        if not new.any():
            return 0.0
        gains = [self._coverage.gain(int(k), track) for k in np.flatnonzero(new)]
        return sum(gains) / len(gains) * float(self._worth[track])

    def _join(self) -> None:
        """Fill the room that is left with what partners have taken anyway."""
        takers = self._taken.sum(axis=0)
        for k in np.flatnonzero(self._room > 0):
            partners = self._taken[self._linked[k]].any(axis=0)
            free = np.flatnonzero(self._owners[k] & ~self._taken[k] & partners)
            rank = np.lexsort((free, -self._common.worth[free], -takers[free]))
            joined = free[rank[: self._room[k]]]
            self._urgency[k, joined] = len(takers) + 1.0
        self._taken |= np.isfinite(self._urgency)


def _pair_counts(owned: Mask) -> Ints:
    """(maps, maps) tracks common to two sub-maps, zero on the diagonal."""
    rows, columns = np.nonzero(owned)
    members = scipy.sparse.csr_array(
        (np.ones(len(rows), np.int64), (rows, columns)), shape=(len(owned), owned.shape[1])
    )
    counts = np.asarray((members @ members.T).toarray())
    np.fill_diagonal(counts, 0)
    return counts
