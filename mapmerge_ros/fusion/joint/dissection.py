# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
Nested dissection of the map graph: a binary tree whose leaves are sub-maps.

Maps are cut in two across the direction, and near the middle at the place, where the fewest links
are cut; the landmarks that both parts have are the separator (George 1973).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse

from mapmerge_ros.arrays import Floats, Ints

DIRECTIONS = 8
"""Ways to cut that are compared, half a turn in all: a grid of maps may lie askew."""

OFF_MIDDLE = 1.0 / 6.0
"""
Share of the maps by which a cut may miss their middle.

Rows of a grid are not of equal length when they lie askew, and a cut along a row is the shortest:
against equal halves it saves a fifth of the elimination at 64 drones, an eighth at 1024.
"""


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
    ends = np.stack([shared.row, shared.col])
    keys = (places - places.mean(axis=0)) @ _directions(places)
    order, is_right = np.arange(count), np.zeros(count, bool)
    places_of = np.empty(keys.shape, np.int64)
    spans: list[tuple[int, int, int]] = []

    def split(low: int, high: int, links: Ints) -> None:
        if high - low == 1:
            spans.append((low, low, high))
            return
        own = order[low:high]
        ranked = own[np.argsort(keys[own], axis=0, kind='stable')]
        joined = ends[:, links]
        direction, left = 0, 1
        if len(own) > 2:
            places_of[ranked, range(keys.shape[1])] = np.arange(len(own))[:, None]
            direction, left = _cut(places_of[joined], shared.data[links], len(own))
        middle = low + left
        order[low:high] = ranked[:, direction]
        is_right[order[low:middle]], is_right[order[middle:high]] = False, True
        first, second = is_right[joined]
        split(low, middle, links[~(first | second)])
        split(middle, high, links[first & second])
        spans.append((low, middle, high))

    split(0, count, np.arange(len(shared.data)))
    return Tree(order, tuple(spans))


def _cut(places: Ints, weights: Floats, count: int) -> tuple[int, int]:
    """
    Direction of the best cut of `count` maps, and how many of them are left of it.

    Links of these weights (links,) go from places[0] to places[1] (links, d) along each direction.
    Equal parts are worth something: a cut counts in proportion to all pairs of maps that it parts.
    """
    directions = places.shape[2]
    at = count * np.arange(directions)
    start, stop = np.minimum(*places) + at, np.maximum(*places) + at
    each = np.repeat(weights, directions)
    opened, closed = (np.bincount(end.ravel(), each, count * directions) for end in (start, stop))
    cut = np.cumsum((opened - closed).reshape(directions, count), axis=1)
    off = int(OFF_MIDDLE * count)
    left = np.arange(count // 2 - off, count - count // 2 + off + 1)
    # One more: where nothing is cut, the middle is best.
    ratios = (1.0 + cut[:, left - 1]) / (left * (count - left))
    direction, k = np.unravel_index(np.argmin(ratios), ratios.shape)
    return int(direction), int(left[k])


def _directions(places: Floats) -> Floats:
    """(3, d) directions in the plane in which the maps are spread most, and across it."""
    _, _, axes = np.linalg.svd(places - places.mean(axis=0), full_matrices=True)
    turns = np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    plane = np.outer(axes[0], np.cos(turns)) + np.outer(axes[1], np.sin(turns))
    return np.column_stack([plane, axes[2]])
