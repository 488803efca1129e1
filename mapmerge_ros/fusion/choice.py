# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
Which landmarks to ask for: in many maps, sure, spread over the overlap of every pair.

R is quadratic in its landmarks, so every sub-map has a budget. Each pair that overlaps gets a
fair share of both budgets first; what is left goes round again, until nothing is.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.sparse

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
        spread = _Spread(self._places(a, shared), self._weights(a, b, shared))
        for place in np.flatnonzero(self._taken[a, shared] & self._taken[b, shared]):
            spread.take(int(place))
        need = int(self._need[a, b])
        while self._need[a, b] > 0:
            # Where there is no room left, only what is taken already can serve the pair.
            eligible = [self._taken[k, shared] for k in (a, b) if not self._room[k]]
            best = spread.farthest(eligible)
            if best is None:
                return
            served = 1.0 - self._need[a, b] / need
            self._take(int(shared[best]), a, b, turn + served)
            spread.take(best)

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
            partners = self._taken[self._linked[k]].any(axis=0)
            free = np.flatnonzero(self._owners[k] & ~self._taken[k] & partners)
            rank = np.lexsort((free, -self._common.worth[free], -takers[free]))
            joined = free[rank[: self._room[k]]]
            self._urgency[k, joined] = turn
        self._taken |= np.isfinite(self._urgency)


class _Spread:
    """Farthest-point sampling of weighted points (n, 3)."""

    def __init__(self, points: Floats, weights: Floats) -> None:
        self._points = points - points.mean(axis=0)
        self._weights = weights
        self._norms: Floats = np.einsum('ni,ni->n', self._points, self._points)
        self._gaps = np.full(len(points), 4.0 * self._norms.max())
        """Squared distance to the nearest one that is taken; no two points are farther apart"""
        self._is_left = np.ones(len(points), bool)

    def take(self, place: int) -> None:
        """Take one of the points."""
        distances = self._norms + self._norms[place] - 2.0 * self._points @ self._points[place]
        np.minimum(self._gaps, np.maximum(distances, 0.0), out=self._gaps)
        self._is_left[place] = False

    def farthest(self, eligible: Sequence[Mask]) -> int | None:
        """Place of the best point that is left and in all masks; None when there is none."""
        free = np.logical_and.reduce([self._is_left, *eligible])
        if not free.any():
            return None
        return int(np.argmax(np.where(free, self._gaps * self._weights, -1.0)))


def _pair_counts(owned: Mask) -> Ints:
    """(maps, maps) tracks common to two sub-maps, zero on the diagonal."""
    rows, columns = np.nonzero(owned)
    members = scipy.sparse.csr_array(
        (np.ones(len(rows), np.int64), (rows, columns)), shape=(len(owned), owned.shape[1])
    )
    counts = np.asarray((members @ members.T).toarray())
    np.fill_diagonal(counts, 0)
    return counts
