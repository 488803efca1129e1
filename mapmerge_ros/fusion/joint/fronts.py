# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
Which landmarks are eliminated where, and which rows of a front its children fill.

A landmark is eliminated at the lowest node of the tree above all maps that have it. The front of
a node holds those landmarks and the boundary: all others that maps below it have.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapmerge_ros.arrays import Ints, Mask
from mapmerge_ros.fusion.joint.dissection import Tree

Run = tuple[int, int, int]
"""Rows start to stop of a child's boundary come to the front from row `at` on."""


@dataclass(frozen=True, slots=True, eq=False)
class Front:
    """One node; all numbers count coordinates, three to a landmark."""

    rows: Ints
    """(k + b,) global coordinates: those eliminated here, then the boundary, in one order"""
    eliminated: int
    """k"""
    children: tuple[int, ...]
    runs: tuple[tuple[Run, ...], ...]
    """Per child where its boundary goes; cut at k"""
    leaf: int
    """Sub-map of a leaf, else -1"""
    leaf_order: Ints
    """(k + b,) coordinates of that sub-map in the order of the front"""


@dataclass(frozen=True, slots=True, eq=False)
class Fronts:
    """The fronts of a problem, children before their parents; the last one is the root."""

    fronts: tuple[Front, ...]
    size: int
    """Coordinates of all landmarks"""


@dataclass(frozen=True, slots=True, eq=False)
class _Numbers:
    """Per landmark the node that eliminates it, its place in the order, and the order."""

    node_of: Ints
    rank: Ints
    by_rank: Ints


def plan_fronts(
    tree: Tree, tracks: Sequence[Ints], count: int, last: Mask | None = None
) -> Fronts:
    """
    Fronts for maps with landmarks `tracks` (one array each) out of `count`.

    With `last` (count,), those landmarks are eliminated after all others, in a front of their own
    at the root.
    """
    node_of = _eliminated_at(tree, tracks, count)
    if last is not None:
        node_of = np.where(last, len(tree.spans), node_of)
    by_rank = _order(tree, tracks, node_of)
    rank = np.empty(count, np.int64)
    rank[by_rank] = np.arange(count)
    numbers = _Numbers(node_of, rank, by_rank)
    fronts: list[Front] = []
    boundaries: list[Ints] = []
    waiting: list[int] = []
    for node, (low, _, high) in enumerate(tree.spans):
        leaf = int(tree.order[low]) if high - low == 1 else -1
        children = () if leaf >= 0 else (waiting[-2], waiting[-1])
        parts = [tracks[leaf]] if leaf >= 0 else [boundaries[child] for child in children]
        fronts.append(_front(node, leaf, children, parts, numbers, boundaries))
        del waiting[len(waiting) - len(children) :]
        waiting.append(node)
        for child in children:
            boundaries[child] = np.zeros(0, np.int64)
    if last is not None:
        top = len(tree.spans)
        fronts.append(_front(top, -1, (top - 1,), [boundaries[top - 1]], numbers, boundaries))
    return Fronts(tuple(fronts), 3 * count)


def _front(
    node: int,
    leaf: int,
    children: tuple[int, ...],
    parts: list[Ints],
    numbers: _Numbers,
    boundaries: list[Ints],
) -> Front:
    """Front of the landmarks of `parts`; its boundary is appended to `boundaries`."""
    rank = numbers.rank
    landmarks = np.unique(rank[np.concatenate(parts)])
    own = numbers.by_rank[landmarks]
    k = int((numbers.node_of[own] == node).sum())
    boundaries.append(own[k:])
    runs = tuple(_runs(np.searchsorted(landmarks, rank[part]), k) for part in parts if leaf < 0)
    order = np.argsort(rank[parts[0]]) if leaf >= 0 else np.zeros(0, np.int64)
    return Front(_three(own), 3 * k, children, runs, leaf, _three(order))


def _eliminated_at(tree: Tree, tracks: Sequence[Ints], count: int) -> Ints:
    """Node (count,) at which each landmark is eliminated."""
    first, final = np.full(count, len(tracks)), np.full(count, -1)
    for place, k in enumerate(tree.order):
        first[tracks[k]] = np.minimum(first[tracks[k]], place)
        final[tracks[k]] = place
    node_of = np.full(count, -1)
    # Children come first, so the first node that spans a landmark is the lowest.
    pending = np.arange(count)
    for node, (low, _, high) in enumerate(tree.spans):
        inside = (first[pending] >= low) & (final[pending] < high)
        node_of[pending[inside]] = node
        pending = pending[~inside]
    return node_of


def _order(tree: Tree, tracks: Sequence[Ints], node_of: Ints) -> Ints:
    """Landmarks by node, those of the same maps side by side: so runs are long."""
    count = len(node_of)
    first, final, total = (np.zeros(count, np.int64) for _ in range(3))
    for place, k in enumerate(tree.order):
        final[tracks[k]] = place
        total[tracks[k]] += place * place + 1
    for place, k in reversed(list(enumerate(tree.order))):
        first[tracks[k]] = place
    return np.lexsort((np.arange(count), total, final, first, node_of))


def _runs(rows: Ints, eliminated: int) -> tuple[Run, ...]:
    """Landmark rows (ascending) as runs of coordinates, cut where elimination ends."""
    breaks = np.flatnonzero((np.diff(rows) != 1) | (rows[1:] == eliminated)) + 1
    starts = np.concatenate([[0], breaks])
    stops = np.concatenate([breaks, [len(rows)]])
    if not len(rows):
        return ()
    return tuple(
        (3 * int(start), 3 * int(stop), 3 * int(rows[start]))
        for start, stop in zip(starts, stops, strict=True)
    )


def _three(landmarks: Ints) -> Ints:
    return np.asarray((3 * landmarks[:, None] + np.arange(3)).ravel())
