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

OPERATIONS_PER_NUMBER = 17.0
"""
Floating-point operations in the time that a step needs to read one number.

A factorisation computes, a step reads: it costs as much as 20 steps for 16 drones, 50 for 1024.
"""

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
    """Landmarks of that sub-map in the order of the front"""
    start: int
    """Place of the first eliminated coordinate in the order of elimination"""
    boundary: Ints
    """(b,) places of the others"""
    depth: int
    """Fronts above it"""

    @property
    def places(self) -> Ints:
        """(k + b,) places of all in the order of elimination."""
        return np.concatenate([self.start + np.arange(self.eliminated), self.boundary])


@dataclass(frozen=True, slots=True, eq=False)
class Fronts:
    """The fronts of a problem, children before their parents; the last one is the root."""

    fronts: tuple[Front, ...]
    order: Ints
    """(size,) global coordinates in the order of elimination"""

    @property
    def size(self) -> int:
        """Coordinates of all landmarks."""
        return len(self.order)

    @property
    def storage(self) -> int:
        """Numbers in a factor."""
        return sum(len(front.rows) * front.eliminated for front in self.fronts)

    @property
    def operations(self) -> int:
        """Floating-point operations of a factorisation, elements of the sub-maps included."""
        total = 0
        for front in self.fronts:
            k, n = front.eliminated, len(front.rows)
            total += k**2 * (n - k) + k * (n - k) ** 2 + 2 * k**3 // 3
            total += n**3 if front.leaf >= 0 else 0
        return total

    @property
    def read_by_a_step(self) -> int:
        """Numbers that one step reads: the factor forwards and backwards, R of every sub-map."""
        return 2 * self.storage + self.triangles

    @property
    def worth(self) -> float:
        """Steps that cost as much as a factorisation."""
        return self.operations / self.read_by_a_step / OPERATIONS_PER_NUMBER

    @property
    def triangles(self) -> int:
        """Numbers in triangles of all sub-maps, R or blocks of the inverse."""
        return sum(len(front.rows) ** 2 // 2 for front in self.fronts if front.leaf >= 0)

    def path(self, leaf: int) -> tuple[int, ...]:
        """Fronts from that of a sub-map up to the root."""
        nodes = [next(node for node, front in enumerate(self.fronts) if front.leaf == leaf)]
        for node in range(nodes[0] + 1, len(self.fronts)):
            if nodes[-1] in self.fronts[node].children:
                nodes.append(node)
        return tuple(nodes)

    @property
    def largest(self) -> int:
        """Numbers in the largest part of a factor that one front makes."""
        return max(len(front.rows) * front.eliminated for front in self.fronts)


@dataclass(frozen=True, slots=True, eq=False)
class _Numbers:
    """Per landmark the node that eliminates it, its place in the order, and the order."""

    node_of: Ints
    rank: Ints
    by_rank: Ints
    starts: Ints
    """Per node, place of the first coordinate that it eliminates"""
    depths: Ints
    """Per node, nodes above it"""


def plan_fronts(
    tree: Tree, tracks: Sequence[Ints], count: int, last: Mask | None = None
) -> Fronts:
    """
    Fronts for maps with landmarks `tracks` (one array each) out of `count`.

    With `last` (count,), those landmarks are eliminated after all others, in a front of their own
    at the root.
    """
    children = _children(tree)
    numbers = _number(tree, children, tracks, count, last)
    fronts: list[Front] = []
    boundaries: list[Ints] = []
    for node, (low, _, high) in enumerate(tree.spans):
        leaf = int(tree.order[low]) if high - low == 1 else -1
        parts = [tracks[leaf]] if leaf >= 0 else [boundaries[c] for c in children[node]]
        fronts.append(_front(node, leaf, children[node], parts, numbers, boundaries))
        for child in children[node]:
            boundaries[child] = np.zeros(0, np.int64)
    if last is not None:
        top = len(tree.spans)
        parts = [boundaries[top - 1]]
        fronts.append(_front(top, -1, (top - 1,), parts, numbers, boundaries))
    return Fronts(tuple(fronts), _three(numbers.by_rank))


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
    ranks = [rank[part] for part in parts]
    landmarks = np.sort(ranks[0]) if len(parts) == 1 else np.union1d(*ranks)
    own = numbers.by_rank[landmarks]
    k = int((numbers.node_of[own] == node).sum())
    boundaries.append(own[k:])
    runs = tuple(_runs(np.searchsorted(landmarks, part), k) for part in ranks if leaf < 0)
    order = np.argsort(ranks[0]) if leaf >= 0 else np.zeros(0, np.int64)
    boundary = _three(landmarks[k:])
    start, depth = int(numbers.starts[node]), int(numbers.depths[node])
    return Front(_three(own), 3 * k, children, runs, leaf, order, start, boundary, depth)


def _children(tree: Tree) -> tuple[tuple[int, ...], ...]:
    """Nodes below each node; none for a leaf."""
    children: list[tuple[int, ...]] = []
    waiting: list[int] = []
    for node, (low, _, high) in enumerate(tree.spans):
        own = () if high - low == 1 else (waiting[-2], waiting[-1])
        del waiting[len(waiting) - len(own) :]
        waiting.append(node)
        children.append(own)
    return tuple(children)


def _number(
    tree: Tree,
    children: tuple[tuple[int, ...], ...],
    tracks: Sequence[Ints],
    count: int,
    last: Mask | None,
) -> _Numbers:
    """Landmarks by node, those of the same maps side by side: so runs are long."""
    leaves = np.repeat(np.arange(len(tracks)), [len(tracks[k]) for k in tree.order])
    rows = np.concatenate([tracks[k] for k in tree.order])
    first, final = np.zeros(count, np.int64), np.zeros(count, np.int64)
    final[rows] = leaves  # of equal rows, the last one stays
    first[rows[::-1]] = leaves[::-1]
    total = np.bincount(rows, weights=leaves * leaves + 1, minlength=count)
    node_of = _lowest_above(tree, children, first, final)
    if last is not None:
        node_of[last] = len(tree.spans)
    by_rank = np.lexsort((np.arange(count), total, final, first, node_of))
    rank = np.empty(count, np.int64)
    rank[by_rank] = np.arange(count)
    starts = 3 * np.searchsorted(node_of[by_rank], np.arange(len(tree.spans) + 1))
    return _Numbers(node_of, rank, by_rank, starts, _depths(children, last is not None))


def _depths(children: tuple[tuple[int, ...], ...], below_another: bool) -> Ints:
    depths = np.zeros(len(children) + 1, np.int64)
    depths[len(children) - 1] = below_another
    for node in range(len(children) - 1, -1, -1):
        for child in children[node]:
            depths[child] = depths[node] + 1
    return depths


def _lowest_above(
    tree: Tree, children: tuple[tuple[int, ...], ...], first: Ints, final: Ints
) -> Ints:
    """Lowest node (count,) above all leaves from the first to the final one."""
    spans = np.array(tree.spans)
    below = np.array([own or (node, node) for node, own in enumerate(children)])
    node_of = np.full(len(first), len(spans) - 1)
    moving = np.arange(len(first))
    while len(moving):
        node = node_of[moving]
        middle = spans[node, 1]
        left, right = final[moving] < middle, first[moving] >= middle
        goes = (left | right) & (spans[node, 2] - spans[node, 0] > 1)
        node_of[moving[goes]] = below[node[goes], right[goes].astype(np.int64)]
        moving = moving[goes]
    return node_of


def _runs(rows: Ints, eliminated: int) -> tuple[Run, ...]:
    """Landmark rows (ascending) as runs of coordinates, cut where elimination ends."""
    if not len(rows):
        return ()
    breaks = np.flatnonzero((rows[1:] != rows[:-1] + 1) | (rows[1:] == eliminated)) + 1
    starts = [0, *breaks.tolist()]
    stops = [*starts[1:], len(rows)]
    places = rows[starts].tolist()
    return tuple(
        (3 * start, 3 * stop, 3 * place)
        for start, stop, place in zip(starts, stops, places, strict=True)
    )


def _three(landmarks: Ints) -> Ints:
    return np.asarray((3 * landmarks[:, None] + np.arange(3)).ravel())
