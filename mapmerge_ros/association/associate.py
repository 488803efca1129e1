# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""From sub-maps to tracks: pairs → loops → second look → tracks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from mapmerge_ros.arrays import Ints
from mapmerge_ros.association.align_pair import rank
from mapmerge_ros.association.by_id import number_by_id
from mapmerge_ros.association.config import AssociationConfig
from mapmerge_ros.association.consensus import greedy_tracks, transitive
from mapmerge_ros.association.landmarks import Landmarks
from mapmerge_ros.association.memory import Memory, Named
from mapmerge_ros.association.network import Network, close_loops
from mapmerge_ros.association.pair import Decision, PairMatch
from mapmerge_ros.association.screening import screen
from mapmerge_ros.association.second_look import Links, second_look
from mapmerge_ros.association.support import supported
from mapmerge_ros.geometry import Similarity
from mapmerge_ros.submap import DescriptorType, SubMap


@dataclass(frozen=True, slots=True, eq=False)
class Correspondences:
    """Which landmarks of which sub-maps are one point, their catalogues included."""

    tracks: tuple[Ints, ...]
    """Per sub-map the track (n_k,) of each landmark, in the order of its message"""
    count: int
    """Tracks have numbers below it; not all are in use"""
    matches: dict[tuple[int, int], PairMatch]
    """Every pair that was looked at, by index; what came of it and why"""

    def common(self, a: int, b: int) -> int:
        """Return the number of landmarks that two sub-maps have in common."""
        return len(np.intersect1d(self.tracks[a], self.tracks[b]))

    def restricted(self, maps: Sequence[int]) -> Correspondences:
        """Return what is known of some of the sub-maps, in the given order."""
        place = {k: slot for slot, k in enumerate(maps)}
        kept = {
            (place[a], place[b]): match
            for (a, b), match in self.matches.items()
            if a in place and b in place
        }
        return Correspondences(
            tuple(self.tracks[k] for k in maps),
            self.count,
            {(min(x), max(x)): kept[x] if x[0] < x[1] else kept[x].exchanged() for x in kept},
        )


def associate(
    submaps: Sequence[SubMap],
    config: AssociationConfig | None = None,
    memory: Memory | None = None,
    by_descriptors: bool = True,
) -> Correspondences:
    """
    Find common landmarks by id within an id space, by descriptors and geometry elsewhere.

    The result depends neither on the order of the sub-maps nor on their names. `memory` keeps what
    was found about pairs, so that a new sub-map is matched against the others and nothing else is
    done again.
    """
    config = config or AssociationConfig()
    memory = Memory() if memory is None else memory
    by_descriptors = by_descriptors and bool(_described(submaps))
    every = range(len(submaps))
    # Ids need no order but a fixed one, and the names cost nothing.
    order = (
        sorted(every, key=lambda k: rank(submaps[k]))
        if by_descriptors
        else sorted(every, key=lambda k: submaps[k].map_id)
    )
    found = _associate([submaps[k] for k in order], config, memory, by_descriptors)
    return found.restricted([order.index(k) for k in range(len(submaps))])


def _associate(
    maps: Sequence[SubMap], config: AssociationConfig, memory: Memory, by_descriptors: bool
) -> Correspondences:
    """Sub-maps by rank: alignments and searches are in the frame of the first of a pair."""
    known, count = number_by_id(maps, [submap.landmark_ids for submap in maps])
    memory.turn()
    described = _described(maps) if by_descriptors else []
    if not described:
        return Correspondences(known, count, {})
    named = [Named(submap) for submap in maps]
    pairs = _pairs(named, described, memory, config)
    matches = {(a, b): memory.match(named[a], named[b], config) for a, b in pairs}
    network = close_loops(tuple(maps), matches)
    marks = [Landmarks.of(one.submap, one.order) for one in named]
    looked = {
        pair: _looked_again(marks, named, pair, match, memory)
        for pair, match in network.matches.items()
        if match.decision is Decision.JOINED
    }
    heard = supported(looked, [len(mark) for mark in marks], config)
    links = {pair: _sure(own, marks[pair[0]], config) for pair, own in heard.items()}
    by_rank = [own[one.order] for own, one in zip(known, named, strict=True)]
    tracks = greedy_tracks(by_rank, links)
    composed = _composed(marks, network, tracks, config)
    if composed:
        tracks = greedy_tracks(by_rank, {**links, **composed})
    return Correspondences(
        tuple(own[one.ranks] for own, one in zip(tracks, named, strict=True)),
        count,
        network.matches,
    )


def _described(maps: Sequence[SubMap]) -> list[int]:
    """Sub-maps with descriptors, unless ids say all that there is to say of them."""
    found = [k for k, own in enumerate(maps) if own.descriptors.type is not DescriptorType.NONE]
    spaces = [maps[k].id_space for k in found]
    return found if len(found) > 1 and (len(set(spaces)) > 1 or '' in spaces) else []


def _pairs(
    named: Sequence[Named], described: Sequence[int], memory: Memory, config: AssociationConfig
) -> list[tuple[int, int]]:
    """Pairs worth matching: descriptors to compare, and no ids that say it all."""
    maps = [named[k].submap for k in described]
    pairs = screen(maps, config, lambda i: memory.signature(named[described[i]], config))
    return [
        (described[i], described[j])
        for i, j in pairs
        if not maps[i].id_space or maps[i].id_space != maps[j].id_space
    ]


def _looked_again(
    marks: Sequence[Landmarks],
    named: Sequence[Named],
    pair: tuple[int, int],
    match: PairMatch,
    memory: Memory,
) -> Links:
    a, b = pair
    assert match.S_a_b is not None
    first = Links(
        named[a].ranks[match.rows_a],
        named[b].ranks[match.rows_b],
        np.ones(len(match.rows_a)),
    )
    moved = marks[b].moved(match.S_a_b)
    return memory.links(named[a], named[b], lambda: second_look(marks[a], moved, first))


def _composed(
    marks: Sequence[Landmarks],
    network: Network,
    tracks: Sequence[Ints],
    config: AssociationConfig,
) -> dict[tuple[int, int], Links]:
    """Links of pairs that no direct match joined, but whose frames others tell."""
    found = {}
    for group in network.components:
        for a, b in combinations(group, 2):
            match = network.matches.get((a, b))
            if match is not None and match.decision is Decision.JOINED:
                continue
            first = transitive(tracks, a, b)
            if len(first) < config.min_transitive:
                continue
            S_a_b: Similarity = network.S_root_map[a].inverse() @ network.S_root_map[b]
            found[a, b] = _sure(
                second_look(marks[a], marks[b].moved(S_a_b), first), marks[a], config
            )
    return found


def _sure(links: Links, mark: Landmarks, config: AssociationConfig) -> Links:
    """Links with a posterior that is high enough for this kind of descriptor."""
    sift = mark.descriptors.type is DescriptorType.SIFT
    return links.above(config.min_posterior_sift if sift else config.min_posterior_binary)
