# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
Nested dissection of the map graph: a binary tree whose leaves are sub-maps.

Maps are cut in two halves of equal number, across the direction that cuts the fewest links; the
landmarks that both halves have are the separator (George 1973).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse

from mapmerge_ros.arrays import Floats, Ints

DIRECTIONS = 8
"""Ways to cut that are compared, half a turn in all: a grid of maps may lie askew."""


@dataclass(frozen=True, slots=True, eq=False)
class Tree:
    """Sub-maps as leaves of a binary tree."""

    order: Ints
    """(maps,) sub-map of each leaf, from left to right"""
    spans: tuple[tuple[int, int, int], ...]
    """
    Per node, children first: leaves from `low` to `high`, cut before `middle`

    A leaf has high = low + 1 and no cut: middle = low.
    """


def dissect(places: Floats, maps: Ints, tracks: Ints) -> Tree:
    """
    Tree of maps at `places` (maps, 3); row i says that map `maps[i]` has track `tracks[i]`.

    Deterministic; where the maps are only decides how fast the factorisation is.
    """
    count = len(places)
    membership = scipy.sparse.csr_array((np.ones(len(maps)), (maps, tracks)))
    shared = scipy.sparse.triu(membership @ membership.T, 1).tocoo()
    keys = (places - places.mean(axis=0)) @ _directions(places)
    order = np.arange(count)
    spans: list[tuple[int, int, int]] = []

    def split(low: int, high: int, links: Ints) -> None:
        if high - low == 1:
            spans.append((low, low, high))
            return
        middle = (low + high) // 2
        own = order[low:high]
        side = np.zeros(count, bool)
        best, fewest = own, np.inf
        for key in keys.T if len(own) > 2 else keys.T[:1]:
            ranked = own[np.argsort(key[own], kind='stable')]
            side[own], side[ranked[middle - low :]] = False, True
            cut = side[shared.row[links]] != side[shared.col[links]]
            weight = float(shared.data[links][cut].sum())
            if weight < fewest:
                best, fewest = ranked, weight
        order[low:high] = best
        side[own], side[best[middle - low :]] = False, True
        right = side[shared.row[links]]
        within = right == side[shared.col[links]]
        split(low, middle, links[within & ~right])
        split(middle, high, links[within & right])
        spans.append((low, middle, high))

    split(0, count, np.arange(len(shared.data)))
    return Tree(order, tuple(spans))


def _directions(places: Floats) -> Floats:
    """(3, d) directions in the plane in which the maps are spread most, and across it."""
    _, _, axes = np.linalg.svd(places - places.mean(axis=0), full_matrices=True)
    turns = np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    plane = np.outer(axes[0], np.cos(turns)) + np.outer(axes[1], np.sin(turns))
    return np.column_stack([plane, axes[2]])
