# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Links between all pairs of sub-maps at once: what `link_pair` says of one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapmerge_ros.arrays import Floats, Ints, Mask
from mapmerge_ros.fusion.associate import Association
from mapmerge_ros.fusion.config import FusionConfig
from mapmerge_ros.fusion.members import pairs_of_members
from mapmerge_ros.fusion.overlap import (
    Link,
    Turn,
    harmonic,
    link_pair,
)
from mapmerge_ros.fusion.pair_frames import align_pairs
from mapmerge_ros.fusion.warm import Condition, Warm
from mapmerge_ros.fusion.wrong_ids import Unlike, rows_apart, why_unlike
from mapmerge_ros.geometry import Segments, align_segments
from mapmerge_ros.submap import SubMap


@dataclass(frozen=True, slots=True, eq=False)
class _Pairs:
    """Pairs of sub-maps a < b, and what they have in common, pair after pair by track."""

    a: Ints
    """(pairs,)"""
    b: Ints
    segments: Segments
    tracks: Ints
    """(rows,)"""
    rows_a: Ints
    """(rows,) of the stacked compressed landmarks of all sub-maps"""
    rows_b: Ints

    def only(self, chosen: Mask) -> _Pairs:
        """Some of the pairs."""
        rows = np.repeat(chosen, self.segments.lengths)
        return _Pairs(
            self.a[chosen],
            self.b[chosen],
            self.segments.only(chosen),
            self.tracks[rows],
            self.rows_a[rows],
            self.rows_b[rows],
        )


def find_links(
    submaps: Sequence[SubMap],
    association: Association,
    config: FusionConfig,
    warm: Warm | None = None,
) -> tuple[Link, ...]:
    """
    All pairs with common landmarks, aligned pairwise where that is possible.

    What `warm` knows of a pair is not computed again.
    """
    if not submaps:
        return ()
    warm = Warm() if warm is None else warm
    weights = [information.weights for information in warm.informations(submaps)]
    pairs = _pairs(association)
    conditions = _conditions(pairs, association, config)
    known = [
        warm.known_link(submaps[a], submaps[b], condition)
        for a, b, condition in zip(pairs.a, pairs.b, conditions, strict=True)
    ]
    unknown = np.array([link is None for link in known], bool)
    some = unknown & (pairs.segments.lengths >= config.min_shared)
    aligned = dict[tuple[int, int], Link]()
    if some.any():
        found = _links(submaps, weights, pairs.only(some), config)
        aligned = {(link.a, link.b): link for link in found}
    links = []
    for k, (a, b) in enumerate(zip(pairs.a.tolist(), pairs.b.tolist(), strict=True)):
        tracks = pairs.tracks[pairs.segments.rows(k)]
        link = known[k]
        if link is None:
            # What could not be aligned with the others says by itself why.
            link = aligned.get((a, b)) or link_pair(submaps, association, weights, (a, b), config)
            own = replace(link, contradicting=np.flatnonzero(np.isin(tracks, link.contradicting)))
            warm.learn_link(submaps[a], submaps[b], conditions[k], own)
        else:
            link = replace(link, a=a, b=b, contradicting=tracks[link.contradicting])
        links.append(link)
    return tuple(links)


def _conditions(pairs: _Pairs, association: Association, config: FusionConfig) -> list[Condition]:
    starts = np.cumsum([0, *(len(own) for own in association.tracks)])
    owners = pairs.segments.owners
    own_a = pairs.rows_a - starts[pairs.a[owners]]
    own_b = pairs.rows_b - starts[pairs.b[owners]]
    return [
        (own_a[rows].tobytes(), own_b[rows].tobytes(), config)
        for rows in map(pairs.segments.rows, range(len(pairs.segments)))
    ]


def _pairs(association: Association) -> _Pairs:
    maps = np.repeat(np.arange(len(association.tracks)), [len(own) for own in association.tracks])
    tracks = np.concatenate(association.tracks)
    rows_a, rows_b = pairs_of_members(maps, tracks)
    keys = maps[rows_a] * len(association.tracks) + maps[rows_b]
    _, starts, lengths = np.unique(keys, return_index=True, return_counts=True)
    return _Pairs(
        maps[rows_a[starts]],
        maps[rows_b[starts]],
        Segments.of_lengths(lengths),
        tracks[rows_a],
        rows_a,
        rows_b,
    )


def _links(
    submaps: Sequence[SubMap], weights: Sequence[Floats], pairs: _Pairs, config: FusionConfig
) -> list[Link]:
    """Links of the pairs that can be aligned."""
    points = np.concatenate([submap.compressed_points for submap in submaps])
    stacked = np.concatenate(list(weights))
    gauges = np.array([int(submap.gauge) for submap in submaps])
    gauges = np.maximum(gauges[pairs.a], gauges[pairs.b])
    points_a, points_b = points[pairs.rows_a], points[pairs.rows_b]
    plain = align_segments(points_a, points_b, pairs.segments, gauges, np.ones(len(points_a)))
    ratios = plain.S_target_source.scales[pairs.segments.owners]
    with np.errstate(all='ignore'):
        precision = harmonic(stacked[pairs.rows_a], stacked[pairs.rows_b] / ratios**2)
    robust = align_pairs(points_a, points_b, pairs.segments, gauges, precision)
    moved_b = robust.S_target_source.apply(pairs.segments, points_b)
    apart = rows_apart(points_a, moved_b, precision, pairs.segments, config)
    determined = plain.determined & robust.determined
    unlike = why_unlike(points_a, points_b, moved_b, precision, pairs.segments, gauges, config)
    turns = _worst_turns(points_a, moved_b, pairs.segments)
    links = []
    for k, rows in enumerate(map(pairs.segments.rows, range(len(pairs.segments)))):
        a, b, shared = int(pairs.a[k]), int(pairs.b[k]), int(pairs.segments.lengths[k])
        if not determined[k]:
            continue  # nobody knows how far apart they are
        if why := unlike.get(k):
            anew = pairs.tracks[rows] if why is Unlike.NUMBERED_ANEW else np.zeros(0, np.int64)
            links.append(Link(a, b, shared, None, f'{shared} {why.value}', contradicting=anew))
        else:
            contradicting = pairs.tracks[rows][apart[rows]]
            S_a_b = robust.S_target_source[k]
            links.append(Link(a, b, shared, S_a_b, turn=turns[k], contradicting=contradicting))
    return links


def _worst_turns(points_a: Floats, points_b: Floats, segments: Segments) -> list[Turn]:
    means = segments.sums(points_a) / segments.lengths[:, None]
    centred = points_a - means[segments.owners]
    scatter = segments.sums(centred[:, :, None] * centred[:, None, :])
    spreads, axes = np.linalg.eigh(scatter)
    across = np.sqrt(np.maximum(spreads[:, :2].sum(axis=1), 0.0) / segments.lengths)
    distances = segments.medians(np.linalg.norm(points_a - points_b, axis=1))
    with np.errstate(all='ignore'):
        stds = distances / across
    return [
        Turn(axis, mean, float(std))
        for axis, mean, std in zip(axes[:, :, 2], means, stds, strict=True)
    ]
