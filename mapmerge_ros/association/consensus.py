# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""From links between pairs of maps to tracks over all maps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.association.second_look import Links

MapLinks = Mapping[tuple[int, int], Links]
"""Links of pairs of maps (a, b), by index, a < b."""


def greedy_tracks(sizes: Sequence[int], links: MapLinks) -> tuple[Ints, ...]:
    """
    Track of every landmark, (n_k,) per map; no track has two landmarks of one map.

    The surest link is taken first, then every next one that does not bring two landmarks of one
    map together: plain connected components would break long tracks at a single wrong link.
    """
    starts = np.concatenate([[0], np.cumsum(sizes)])
    ends_a, ends_b = _ordered(starts, links)
    forest = _Forest(np.repeat(np.arange(len(sizes)), sizes).tolist())
    for a, b in zip(ends_a.tolist(), ends_b.tolist(), strict=True):
        forest.join(a, b)
    roots = np.array([forest.root(k) for k in range(int(starts[-1]))], np.int64)
    tracks = np.unique(roots, return_inverse=True)[1].astype(np.int64)
    return tuple(np.split(tracks, starts[1:-1]))


def _ordered(starts: Ints, links: MapLinks) -> tuple[Ints, Ints]:
    """Ends (n,) of all links, numbered over all maps, surest first."""
    ends_a = [starts[a] + part.of_a for (a, _), part in links.items()]
    ends_b = [starts[b] + part.of_b for (_, b), part in links.items()]
    posteriors: list[Floats] = [part.posteriors for part in links.values()]
    if not posteriors:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    a, b = np.concatenate(ends_a), np.concatenate(ends_b)
    order = np.lexsort((b, a, -np.concatenate(posteriors)))
    return a[order], b[order]


class _Forest:
    """Disjoint sets of landmarks that refuse to hold two of one map."""

    def __init__(self, map_of: list[int]) -> None:
        self._map_of = map_of
        self._parent = list(range(len(map_of)))
        self._maps: dict[int, set[int]] = {}

    def root(self, k: int) -> int:
        parent = self._parent
        while parent[k] != k:
            parent[k] = parent[parent[k]]
            k = parent[k]
        return k

    def join(self, a: int, b: int) -> None:
        root_a, root_b = self.root(a), self.root(b)
        if root_a == root_b:
            return
        maps_a = self._maps.setdefault(root_a, {self._map_of[root_a]})
        maps_b = self._maps.setdefault(root_b, {self._map_of[root_b]})
        if maps_a & maps_b:
            return
        if len(maps_a) < len(maps_b):
            root_a, root_b, maps_a, maps_b = root_b, root_a, maps_b, maps_a
        maps_a |= maps_b
        self._parent[root_b] = root_a


def transitive(tracks: Sequence[Ints], a: int, b: int) -> Links:
    """Links of two maps that follow from others: both landmarks are in one track."""
    _, of_a, of_b = np.intersect1d(tracks[a], tracks[b], return_indices=True)
    return Links(of_a, of_b, np.ones(len(of_a)))
