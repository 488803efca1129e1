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
import itertools
from collections.abc import Sequence

import numpy as np
import scipy.sparse.csgraph

from mapmerge_ros.arrays import Ids, Ints, Mask
from mapmerge_ros.fusion.catalogues import Tracks
from mapmerge_ros.fusion.common import Common, find_common
from mapmerge_ros.fusion.coverage import Coverage
from mapmerge_ros.fusion.members import grouped, pairs_of_members
from mapmerge_ros.geometry import sparse_graph
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


class _Links:
    """Pairs of sub-maps that have enough in common, and the members that they share."""

    def __init__(self, common: Common, min_shared: int) -> None:
        first, second = pairs_of_members(common.maps, common.tracks)
        keys = common.maps[first] * len(common.submaps) + common.maps[second]
        unique, inverse, counts = np.unique(keys, return_inverse=True, return_counts=True)
        enough = counts >= min_shared
        first, second = first[enough[inverse]], second[enough[inverse]]
        self.a, self.b = np.divmod(unique[enough], max(1, len(common.submaps)))
        self.counts = counts[enough]
        """(links,) tracks in common"""
        self._ends = np.concatenate([[0], np.cumsum(self.counts)])
        self.first, self.second = first, second
        """(pairs,) members of one track, link after link"""
        order, self._partner_ends = grouped(np.concatenate([first, second]), len(common.maps))
        self._partners = np.concatenate([second, first])[order]

    def members(self, link: int) -> tuple[Ints, Ints]:
        """Members of what the two maps of a link have in common, by track."""
        rows = slice(int(self._ends[link]), int(self._ends[link + 1]))
        return self.first[rows], self.second[rows]

    def partners(self, member: int) -> Ints:
        """Members of the same track in maps that are linked with that of this one."""
        return self._partners[self._partner_ends[member] : self._partner_ends[member + 1]]

    def touched(self, chosen: Mask) -> Mask:
        """Which members (members,) have a chosen partner."""
        touched = np.zeros(len(chosen), bool)
        touched[self.first[chosen[self.second]]] = True
        touched[self.second[chosen[self.first]]] = True
        return touched


class _Selection:
    """
    The state of one choice.

    In the forest a track is taken in a sub-map only if that serves a pair which still needs one,
    or if there is room for more. So the room left never falls below what the pairs still need.
    """

    def __init__(self, common: Common, room: Ints, min_shared: int) -> None:
        self._common, self._links = common, _Links(common, min_shared)
        self._coverage = Coverage(common)
        self._worth = common.worth * common.mean_sureness()
        self._owned = self._links.touched(np.ones(len(common.maps), bool))
        """Members with a partner in a map that is linked"""
        owned = np.flatnonzero(self._owned)
        order, self._track_ends = grouped(common.tracks[owned], common.count)
        self._by_track = owned[order]
        self._maps: list[int] = common.maps.tolist()
        self._room = np.maximum(room, 0)
        self._taken = np.zeros(len(common.maps), bool)
        self._urgency = np.full(len(common.maps), np.inf)
        """When each was taken"""
        self._need: list[dict[int, int]] = [{} for _ in common.submaps]
        """Per map what each of its pairs in the forest still needs"""

    def run(self) -> list[Ints]:
        """Members chosen per sub-map, most wanted first."""
        served = self._set_needs()
        for link in served[np.argsort(self._links.counts[served], kind='stable')]:
            self._serve(int(link))
        self._cover()
        self._join()
        common = self._common
        worth = common.worth[common.tracks]
        order = np.lexsort((common.tracks, -worth, self._urgency, common.maps))
        chosen = order[self._taken[order]]
        return np.split(chosen, np.searchsorted(common.maps[chosen], range(1, len(self._room))))

    def _set_needs(self) -> Ints:
        """Divide the room among the links of the forest, as far as it takes to hold them."""
        links, maps = self._links, len(self._room)
        both = np.concatenate([links.a, links.b]), np.concatenate([links.b, links.a])
        graph = sparse_graph(-np.tile(links.counts, 2), *both, maps)
        tree = scipy.sparse.csgraph.minimum_spanning_tree(graph).tocoo()
        low, high = np.minimum(tree.row, tree.col), np.maximum(tree.row, tree.col)
        served = np.searchsorted(links.a * maps + links.b, np.sort(low * maps + high))
        share = self._room // np.maximum(np.bincount(np.concatenate([low, high]), None, maps), 1)
        share = np.minimum(np.maximum(share, self._room > 0), ENOUGH)
        for a, b, count in zip(
            links.a[served], links.b[served], links.counts[served], strict=True
        ):
            need = int(min(share[a], share[b], count))
            if need:
                self._need[a][int(b)] = self._need[b][int(a)] = need
        return np.asarray(served)

    def _serve(self, link: int) -> None:
        """Give a pair what it needs, the best first."""
        a, b = int(self._links.a[link]), int(self._links.b[link])
        members = self._links.members(link)
        worth = self._worth[self._common.tracks[members[0]]]
        need = self._need[a].get(b, 0)
        while self._need[a].get(b, 0) > 0:
            free = ~(self._taken[members[0]] & self._taken[members[1]])
            for k, own in zip((a, b), members, strict=True):
                if not self._room[k]:  # only what is taken already can serve the pair
                    free &= self._taken[own]
            if not free.any():
                return
            gains = self._coverage.gains(a, members[0]) + self._coverage.gains(b, members[1])
            best = int(np.argmax(np.where(free, gains * worth, -1.0)))
            urgency = 1.0 - self._need[a][b] / need
            self._take_for(int(members[0][best]), int(members[1][best]), urgency)

    def _take_for(self, first: int, second: int, urgency: float) -> None:
        """Take a track in two maps, and wherever that leaves room for what pairs need."""
        maps = self._maps
        members = self._members_of(int(self._common.tracks[first]))
        takers = [m for m in members if self._taken[m] or m in (first, second)]
        for member in members:
            k = maps[member]
            if member not in takers and self._room[k] > 0:
                is_needed = any(self._need[k].get(maps[other], 0) for other in takers)
                if is_needed or self._is_free(member, takers):
                    takers.append(member)
        new = [member for member in takers if not self._taken[member]]
        self._take(new, urgency)
        for member in new:
            k = maps[member]
            for other in takers:
                partner = maps[other]
                # Between two that are new, the pair is met twice, from either side.
                if self._need[k].get(partner, 0) and not (other in new and partner < k):
                    self._need[k][partner] -= 1
                    self._need[partner][k] -= 1

    def _is_free(self, member: int, takers: list[int]) -> bool:
        """Whether a sub-map has more room than its pairs need, and is linked to who takes it."""
        k = self._maps[member]
        is_linked = not set(takers).isdisjoint(self._links.partners(member).tolist())
        return is_linked and bool(self._room[k] > sum(self._need[k].values()))

    def _members_of(self, track: int) -> list[int]:
        """Owned members of a track, by sub-map."""
        members = self._by_track[self._track_ends[track] : self._track_ends[track + 1]]
        return list(members.tolist())

    def _take(self, new: list[int], urgency: float) -> None:
        self._taken[new] = True
        self._urgency[new] = urgency
        self._room[self._common.maps[new]] -= 1
        for member in new:
            self._coverage.take(member)

    def _cover(self) -> None:
        """Take what gains most for its place, again and again; gains only fall on the way."""
        queue = self._queue()
        turn = 1.0
        while queue:
            _, track = heapq.heappop(queue)
            new = self._takers(track)
            if not new:
                continue
            present = -self._value(track, new)
            if queue and present > queue[0][0]:
                heapq.heappush(queue, (present, track))
                continue
            self._take(new, turn)
            turn += 1.0
            for k in self._common.maps[new]:
                if not self._room[k]:
                    self._renew(queue, int(k))

    def _queue(self) -> list[tuple[float, int]]:
        """Every track that could still be taken, as a heap of negative values."""
        new = self._owned & ~self._taken & (self._room > 0)[self._common.maps]
        new &= self._links.touched(self._taken | new)
        gains = np.zeros(len(new))
        for k in range(len(self._room)):
            own = self._common.members(k)
            members = own.start + np.flatnonzero(new[own])
            gains[members] = self._coverage.gains(k, members)
        tracks, count = self._common.tracks[new], self._common.count
        takers = np.bincount(tracks, minlength=count)
        open_ = np.flatnonzero(takers)
        values = np.bincount(tracks, gains[new], count)[open_] / takers[open_] * self._worth[open_]
        found = list(zip((-values).tolist(), open_.tolist(), strict=True))
        heapq.heapify(found)
        return found

    def _renew(self, queue: list[tuple[float, int]], full: int) -> None:
        """Without the map that is full, others may gain more from what they share with it."""
        for track in self._common.tracks[self._common.members(full)].tolist():
            new = self._takers(track)
            if new:
                heapq.heappush(queue, (-self._value(track, new), track))

    def _takers(self, track: int) -> list[int]:
        """Members that would be taken: with room, and linked to another that is taken then."""
        members = self._members_of(track)
        taken = [self._taken[member] for member in members]
        new = [
            member
            for member, is_taken in zip(members, taken, strict=True)
            if not is_taken and self._room[self._maps[member]] > 0
        ]
        active = {*new, *itertools.compress(members, taken)}
        return [m for m in new if not active.isdisjoint(self._links.partners(m).tolist())]

    def _value(self, track: int, new: list[int]) -> float:
        """What a track gains in the mean over those that would take it."""
        gains = sum(self._coverage.gain(member) for member in new)
        return gains / len(new) * float(self._worth[track])

    def _join(self) -> None:
        """Fill the room that is left with what partners have taken anyway."""
        common = self._common
        takers = np.bincount(common.tracks, self._taken, common.count)
        free = self._owned & ~self._taken & self._links.touched(self._taken)
        for k in np.flatnonzero(self._room > 0):
            own = common.ends[k] + np.flatnonzero(free[common.members(int(k))])
            tracks = common.tracks[own]
            rank = np.lexsort((tracks, -common.worth[tracks], -takers[tracks]))
            joined = own[rank[: self._room[k]]]
            self._urgency[joined] = common.count + 1.0
        self._taken |= np.isfinite(self._urgency)
