# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Frames that hang together through alignments of pairs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.sparse
import scipy.sparse.csgraph

from mapmerge_ros.geometry.similarity import Similarity

AT_ONCE = 64
"""Frames from which distances to all others are made together: memory for this many rows."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameGraph:
    """Frames 0 … count - 1, and what is known between pairs of them."""

    count: int
    S_a_b: Mapping[tuple[int, int], Similarity]
    """By pair, a < b"""
    lengths: Sequence[float]
    """Of each pair, in the same order, above 0: the shorter, the more it is to be relied on"""

    def components(self) -> tuple[tuple[int, ...], ...]:
        """Frames that pairs connect, by their first one."""
        if not self.count:
            return ()
        labels = scipy.sparse.csgraph.connected_components(self._matrix(), directed=False)[1]
        return tuple(tuple(map(int, np.flatnonzero(labels == k))) for k in np.unique(labels))

    def centre(self, eligible: Sequence[int], members: Sequence[int]) -> int:
        """Return the eligible frame from which all members together are nearest."""
        matrix, reached = self._matrix(), list(members)
        totals = [
            scipy.sparse.csgraph.dijkstra(
                matrix, directed=False, indices=eligible[start : start + AT_ONCE]
            )[:, reached].sum(axis=1)
            for start in range(0, len(eligible), AT_ONCE)
        ]
        return eligible[int(np.argmin(np.concatenate(totals)))]

    def frames_from(self, root: int) -> dict[int, Similarity]:
        """S_root_k of every frame k that pairs connect with `root`, along the shortest paths."""
        distances, before = scipy.sparse.csgraph.dijkstra(
            self._matrix(), directed=False, indices=[root], return_predecessors=True
        )
        distances, before = distances[0], before[0]
        frames = {root: Similarity.identity()}
        reached = [int(k) for k in np.flatnonzero(np.isfinite(distances)) if k != root]
        for k in sorted(reached, key=lambda k: (distances[k], k)):
            frames[k] = frames[int(before[k])] @ self._between(int(before[k]), k)
        return frames

    def _between(self, a: int, b: int) -> Similarity:
        return self.S_a_b[a, b] if a < b else self.S_a_b[b, a].inverse()

    def _matrix(self) -> scipy.sparse.csr_array:
        ends = [a for a, _ in self.S_a_b], [b for _, b in self.S_a_b]
        return sparse_graph(list(self.lengths), *ends, self.count)


def sparse_graph(
    lengths: npt.ArrayLike, first: npt.ArrayLike, second: npt.ArrayLike, count: int
) -> scipy.sparse.csr_array:
    """
    Edges (n,) of a graph of `count` nodes as a matrix, rows and columns sorted.

    Its indices are short: before SciPy 1.17 `scipy.sparse.csgraph` takes no others.
    """
    ends = np.asarray(first, np.int32), np.asarray(second, np.int32)
    graph = scipy.sparse.csr_array((np.asarray(lengths), ends), shape=(count, count))
    graph.sort_indices()
    return graph
