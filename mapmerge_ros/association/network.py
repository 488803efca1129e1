# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Pairs of maps checked against each other around loops, and the frames that follow."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from mapmerge_ros.arrays import Floats
from mapmerge_ros.association.pair import Decision, PairMatch
from mapmerge_ros.geometry import FrameGraph, Similarity
from mapmerge_ros.submap import SubMap

Matches = Mapping[tuple[int, int], PairMatch]
"""Pairs of maps (a, b), by index, a < b."""

LOOP_TOLERANCE = 3.0
"""
Times the tolerances of all alignments around a loop that its ends may lie apart.

Weak joins are right, but up to 13 % of the scene's radius off; aliases of repeated structure are
off by the size of what repeats, which is many tolerances.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Network:
    """What is left of the pairs when loops have been closed."""

    matches: dict[tuple[int, int], PairMatch]
    """All pairs; decisions of those that loops confirm or contradict are changed"""
    components: tuple[tuple[int, ...], ...]
    """Maps that joined pairs connect; by first map"""
    S_root_map: tuple[Similarity, ...]
    """Per map its frame in that of the first map of its component"""


def close_loops(submaps: tuple[SubMap, ...], matches: Matches) -> Network:
    """
    Drop joined pairs that loops contradict, and take undecided ones that they confirm.

    An undecided pair between two components stays out, however many others say the same:
    repeated structure is consistent with itself.
    """
    joined = _without_contradictions(submaps, matches)
    components, frames = _frames(len(submaps), joined)
    component_of = {k: index for index, group in enumerate(components) for k in group}
    settled = dict(matches)
    for pair, match in matches.items():
        a, b = pair
        if match.decision is Decision.JOINED and pair not in joined:
            reason = 'contradicts the alignments of other sub-maps around a loop'
            settled[pair] = replace(match, decision=Decision.UNDECIDED, reason=reason)
        elif match.decision is Decision.UNDECIDED and component_of[a] == component_of[b]:
            settled[pair] = _settled(submaps, match, pair, frames[a].inverse() @ frames[b])
    return Network(settled, components, frames)


def _settled(
    submaps: tuple[SubMap, ...], match: PairMatch, pair: tuple[int, int], S_a_b: Similarity
) -> PairMatch:
    assert match.S_a_b is not None
    gap = _median_gap(submaps[pair[1]].points[match.rows_b], match.S_a_b, S_a_b)
    if gap <= 2.0 * LOOP_TOLERANCE * match.tolerance_a:
        return replace(match, decision=Decision.JOINED, reason='')
    reason = f'{match.reason}; other sub-maps place it elsewhere'
    return replace(match, decision=Decision.APART, reason=reason)


def _without_contradictions(
    submaps: tuple[SubMap, ...], matches: Matches
) -> dict[tuple[int, int], PairMatch]:
    """Joined pairs, less those that more triangles contradict than confirm, worst first."""
    joined = {pair: x for pair, x in matches.items() if x.decision is Decision.JOINED}
    verdicts = {loop: _closes(submaps, joined, loop) for loop in _triangles(joined)}
    while True:
        balance = dict.fromkeys(joined, 0)
        for loop, closes in verdicts.items():
            for pair in combinations(loop, 2):
                balance[pair] += 1 if closes else -1
        worst = min(joined, key=lambda pair: (balance[pair], _support(joined[pair])), default=None)
        if worst is None or balance[worst] >= 0:
            return joined
        del joined[worst]
        verdicts = {
            loop: closes for loop, closes in verdicts.items() if not set(worst) <= set(loop)
        }


def _support(match: PairMatch) -> int:
    return len(match.rows_a)


def _triangles(joined: Matches) -> list[tuple[int, int, int]]:
    partners: dict[int, set[int]] = {}
    for a, b in joined:
        partners.setdefault(a, set()).add(b)
    return [
        (a, b, c)
        for a, b in joined
        for c in sorted(partners.get(a, set()) & partners.get(b, set()))
    ]


def _closes(submaps: tuple[SubMap, ...], joined: Matches, loop: tuple[int, int, int]) -> bool:
    a, b, c = loop
    ab, bc, ac = joined[a, b], joined[b, c], joined[a, c]
    assert ab.S_a_b is not None and bc.S_a_b is not None and ac.S_a_b is not None
    around = ab.S_a_b @ bc.S_a_b
    gap = _median_gap(submaps[c].points[ac.rows_b], ac.S_a_b, around)
    tolerance = ab.tolerance_a + ac.tolerance_a + ab.S_a_b.scale * bc.tolerance_a
    return gap <= LOOP_TOLERANCE * tolerance


def _median_gap(points: Floats, S: Similarity, other: Similarity) -> float:
    return float(np.median(np.linalg.norm(S.apply(points) - other.apply(points), axis=1)))


def _frames(
    count: int, joined: Matches
) -> tuple[tuple[tuple[int, ...], ...], tuple[Similarity, ...]]:
    """Components and frames along the paths of best support."""
    known = {pair: x.S_a_b for pair, x in joined.items() if x.S_a_b is not None}
    graph = FrameGraph(count, known, [1.0 / _support(joined[pair]) for pair in known])
    groups = graph.components()
    frames = {k: S for group in groups for k, S in graph.frames_from(group[0]).items()}
    return groups, tuple(frames[k] for k in range(count))
