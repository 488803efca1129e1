# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
Which parts of a session may be believed: merged one at a time, each merge tested.

The paper's section 'Using merging for increased robustness'. Pure: bundling a part anew is the
caller's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.stats

from mapmerge_ros.arrays import Ints
from mapmerge_ros.fusion import Fusion, FusionConfig, fuse
from mapmerge_ros.submap import SubMap


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """A stretch of a session's trajectory and the map that it makes by itself."""

    keyframe_rows: Ints
    submap: SubMap | None
    """None: it makes no map at all"""


@dataclass(frozen=True, slots=True, eq=False)
class Consensus:
    """Parts that agree, and what cannot be reconciled with them."""

    kept: tuple[Part, ...]
    refused: tuple[Part, ...]
    """As small as they could be split"""
    merges: int
    """Tests that it took"""
    fusion: Fusion
    """Of the kept parts"""

    @property
    def refused_rows(self) -> Ints:
        """Key frames of the refused parts, ascending."""
        rows = [part.keyframe_rows for part in self.refused]
        return np.sort(np.concatenate([np.zeros(0, np.int64), *rows]))


Split = Callable[[Part], Sequence[Part]]
"""Smaller parts of a part, each bundled by itself; none: it is as small as it may be."""


def find_corrupt(
    parts: Sequence[Part], split: Split, config: FusionConfig | None = None
) -> Consensus:
    """
    Keep the largest set of parts that the test believes; of the others, what can be saved.

    A part that makes the test fail is split and its pieces are tried one by one, and so on. So
    is one whose own residuals are larger than known noise explains: what is wrong inside one
    part, a price of merging does not show.

    The test is repeated many times: `config.significance` is best well below 1 / tests.
    """
    trial = _Trial(config or FusionConfig(unlock=False))
    kept, refused = _largest_agreement(list(parts), trial)
    smallest: list[Part] = []
    while refused:
        part = refused.pop(0)
        pieces = split(part)
        if not pieces:
            smallest.append(part)
            continue
        kept, failed = _grow(kept, list(pieces), trial)
        refused += failed
    return Consensus(tuple(kept), tuple(smallest), trial.merges, trial.fuse(kept))


class _Trial:
    """Merges parts and counts how often."""

    def __init__(self, config: FusionConfig) -> None:
        self._config = config
        self.merges = 0

    def fuse(self, parts: Sequence[Part]) -> Fusion:
        self.merges += 1
        return fuse([part.submap for part in parts if part.submap], self._config)

    def believes(self, parts: Sequence[Part]) -> bool:
        """Whether the parts make one map that passes the test, all of their ids taken alike."""
        if any(part.submap is None for part in parts):
            return False
        merged = self.fuse(parts)
        # The engine sets ids apart that contradict the geometry, and so saves the map; here
        # they are what is looked for.
        whole = len(merged.components) == 1 and not merged.contradictions
        return whole and merged.verdict.accepted

    def plausible(self, part: Part) -> bool:
        """Whether the residuals of a part by itself are as large as known noise makes them."""
        submap = part.submap
        if submap is None or submap.sigma == 0.0:
            return submap is not None
        p_value = scipy.stats.chi2.sf((submap.a / submap.sigma) ** 2, submap.redundancy)
        return bool(p_value >= self._config.significance)


def _largest_agreement(parts: list[Part], trial: _Trial) -> tuple[list[Part], list[Part]]:
    """
    Grow from the first part, and from every part that this leaves out; the most parts win.

    A set that began with a corrupt part leaves out those that contradict it: one of these is
    then a better beginning.
    """
    best = _grow([], parts, trial)
    for part in [part for part in best[1] if trial.plausible(part)]:
        found = _grow([], [part, *(other for other in parts if other is not part)], trial)
        if len(found[0]) > len(best[0]):
            best = found
    return best


def _grow(kept: list[Part], waiting: list[Part], trial: _Trial) -> tuple[list[Part], list[Part]]:
    """Add parts one at a time, the one with most in common first; return kept and refused."""
    kept, waiting, refused = list(kept), list(waiting), list[Part]()
    while waiting:
        part = waiting.pop(_nearest(kept, waiting))
        fits = trial.plausible(part) and (not kept or trial.believes([*kept, part]))
        (kept if fits else refused).append(part)
    return kept, refused


def _nearest(kept: Sequence[Part], waiting: Sequence[Part]) -> int:
    known = [part.submap.compressed_ids for part in kept if part.submap]
    ids = np.unique(np.concatenate(known)) if known else np.zeros(0, np.uint64)
    shared = [
        np.isin(part.submap.compressed_ids, ids).sum() if part.submap else -1 for part in waiting
    ]
    return int(np.argmax(shared)) if kept else 0
