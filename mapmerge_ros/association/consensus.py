# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""From links between pairs of maps to tracks over all maps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from mapmerge_ros.arrays import Ints
from mapmerge_ros.association.second_look import Links

MapLinks = Mapping[tuple[int, int], Links]
"""Links of pairs of maps (a, b), by index, a < b."""


def greedy_tracks(known: Sequence[Ints], links: MapLinks) -> tuple[Ints, ...]:
    """
    Track of every landmark, (n_k,) per map; no track has two landmarks of one map.

    `known` are the tracks that ids give, (n_k,) per map. Then the surest link is taken, and every
    next one that does not bring two landmarks of one map together: plain connected components
    would break long tracks at a single wrong link.
    """
    forest = _Forest(known)
    for a, b in _surest_first(known, links):
        forest.join(a, b)
    roots = np.array([forest.root(k) for k in range(forest.count)], np.int64)
    return tuple(roots[own] for own in known)


def _surest_first(known: Sequence[Ints], links: MapLinks) -> list[tuple[int, int]]:
    """Tracks that links would join."""
    if not links:
        return []
    ends_a = np.concatenate([known[a][part.of_a] for (a, _), part in links.items()])
    ends_b = np.concatenate([known[b][part.of_b] for (_, b), part in links.items()])
    posteriors = np.concatenate([part.posteriors for part in links.values()])
    order = np.lexsort((ends_b, ends_a, -posteriors))
    return list(zip(ends_a[order].tolist(), ends_b[order].tolist(), strict=True))


class _Forest:
    """Disjoint sets of tracks that refuse to hold two landmarks of one map."""

    def __init__(self, known: Sequence[Ints]) -> None:
        self.count = max((int(own.max()) + 1 for own in known if len(own)), default=0)
        self._parent = list(range(self.count))
        owners = np.repeat(np.arange(len(known)), [len(own) for own in known])
        members = np.concatenate([np.zeros(0, np.int64), *known])
        order = np.argsort(members, kind='stable')
        ends = np.cumsum(np.bincount(members, minlength=self.count))
        self._maps = [set(part.tolist()) for part in np.split(owners[order], ends[:-1])]

    def root(self, k: int) -> int:
        parent = self._parent
        while parent[k] != k:
            parent[k] = parent[parent[k]]
            k = parent[k]
        return k

    def join(self, a: int, b: int) -> None:
        root_a, root_b = self.root(a), self.root(b)
        maps_a, maps_b = self._maps[root_a], self._maps[root_b]
        if root_a == root_b or maps_a & maps_b:
            return
        if (len(maps_a), -root_a) < (len(maps_b), -root_b):
            root_a, root_b, maps_a, maps_b = root_b, root_a, maps_b, maps_a
        maps_a |= maps_b
        self._parent[root_b] = root_a


def transitive(tracks: Sequence[Ints], a: int, b: int) -> Links:
    """Links of two maps that follow from others: both landmarks are in one track."""
    _, of_a, of_b = np.intersect1d(tracks[a], tracks[b], return_indices=True)
    return Links(of_a, of_b, np.ones(len(of_a)))
