# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Which pairs of many sub-maps are worth matching, for far less than matching them all."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import combinations

import numpy as np

from mapmerge_ros.arrays import Ints
from mapmerge_ros.association.config import AssociationConfig
from mapmerge_ros.association.signature import Signature, distances, signature
from mapmerge_ros.submap import DescriptorType, SubMap

VERIFIED_AT_ONCE = 1 << 18
"""Meetings whose codes are compared in one piece: bounds the memory."""


def screen(
    submaps: Sequence[SubMap],
    config: AssociationConfig,
    signature_of: Callable[[int], Signature] | None = None,
) -> tuple[tuple[int, int], ...]:
    """
    Pairs (i, j), i < j, that may show the same place.

    Few maps: all pairs. Otherwise those with enough landmarks that look alike, and for every map
    its best partners, so that no map is left alone. The order of the maps changes nothing.
    `signature_of` a map, by index, is for who keeps them.
    """
    if len(submaps) <= config.screen_above:
        return tuple(combinations(range(len(submaps)), 2))
    make = signature_of or (lambda k: signature(submaps[k].descriptors, config))
    signatures = [make(k) for k in range(len(submaps))]
    scores = likeness(signatures, config)
    sizes = np.array([len(own) for own in signatures])
    smaller = np.minimum(sizes[:, None], sizes)
    wanted = scores >= np.maximum(config.min_alike, config.min_alike_ratio * smaller)
    if len(scores) < 2:
        return ()
    partners = min(config.best_partners, len(scores) - 1)
    # Ties at the last place are all in: a cut through them would depend on the order.
    last = np.sort(scores, axis=1)[:, -partners][:, None]
    wanted |= (scores >= last) & (scores >= config.min_alike_partner)
    pairs = np.argwhere(np.triu(wanted | wanted.T, 1))
    return tuple((int(i), int(j)) for i, j in pairs)


def likeness(signatures: Sequence[Signature], config: AssociationConfig) -> Ints:
    """(n, n) landmarks of a pair of maps that look alike, each counted once; 0 on the diagonal."""
    scores = np.zeros((len(signatures), len(signatures)), np.int64)
    for kind in sorted({own.kind for own in signatures}):
        maps = [i for i, own in enumerate(signatures) if own.kind == kind and len(own)]
        if len(maps) > 1 and kind[1]:
            alike = _likeness([signatures[i] for i in maps], config)
            scores[np.ix_(maps, maps)] = alike
    return scores


def _likeness(signatures: Sequence[Signature], config: AssociationConfig) -> Ints:
    sift = signatures[0].kind[0] is DescriptorType.SIFT
    limit = config.max_alike_sift if sift else config.max_alike_binary
    codes = np.concatenate([own.codes for own in signatures])
    keys = np.concatenate([own.keys for own in signatures])
    owners = np.repeat(np.arange(len(signatures)), [len(own) for own in signatures])
    # A place that every map has seen puts one landmark of each under the same key.
    bucket = max(config.max_bucket, 2 * len(signatures))
    found = [pairs for table in keys.T for pairs in _meetings(table, owners, bucket)]
    together = np.concatenate([np.zeros(0, np.int64), *found])
    first, second = np.divmod(np.unique(together), len(codes))
    near = np.concatenate(
        [
            distances(codes[first[part]], codes[second[part]]) <= limit
            for part in _parts(len(first))
        ]
    )
    return _each_once(first[near], second[near], owners, len(signatures))


def _meetings(keys: Ints, owners: Ints, max_bucket: int) -> Iterator[Ints]:
    """
    Landmarks of different maps with the same key, as first * n + second, first < second.

    Keys that more than `max_bucket` landmarks have tell nothing and would cost the square.
    """
    count = len(keys)
    order = np.argsort(keys, kind='stable')
    ordered = keys[order]
    starts = np.flatnonzero(np.r_[True, ordered[1:] != ordered[:-1]])
    sizes = np.diff(np.r_[starts, count])
    usable = np.repeat(sizes <= max_bucket, sizes)
    at = np.flatnonzero(usable)
    for step in range(1, max_bucket):
        at = at[at + step < count]
        at = at[ordered[at] == ordered[at + step]]
        if not len(at):
            return
        one, other = order[at], order[at + step]
        different = owners[one] != owners[other]
        yield one[different] * count + other[different]


def _parts(count: int) -> list[slice]:
    return [slice(s, s + VERIFIED_AT_ONCE) for s in range(0, max(count, 1), VERIFIED_AT_ONCE)]


def _each_once(first: Ints, second: Ints, owners: Ints, maps: int) -> Ints:
    """(maps, maps) number of landmarks with a look-alike, of the map that has fewer of them."""
    counts = []
    for own, other in ((first, second), (second, first)):
        unique = np.unique(own * maps + owners[other])
        landmark, partner = np.divmod(unique, maps)
        flat = np.bincount(owners[landmark] * maps + partner, minlength=maps * maps)
        counts.append(flat.reshape(maps, maps))
    # `first` always belongs to the earlier map: the two tables are each other's transpose.
    scores: Ints = np.minimum(counts[0], counts[1].T)
    return np.maximum(scores, scores.T)
