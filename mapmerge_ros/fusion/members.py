# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Which members of tracks belong together: sparse, as most sub-maps have nothing in common."""

from __future__ import annotations

import numpy as np

from mapmerge_ros.arrays import Ints


def pairs_of_members(maps: Ints, tracks: Ints) -> tuple[Ints, Ints]:
    """
    Members (pairs,) and (pairs,) of one track in two sub-maps, that of the first map first.

    Member i belongs to sub-map `maps[i]` and to track `tracks[i]`. Pairs are sorted by both
    sub-maps, then by track.
    """
    order = np.lexsort((maps, tracks))
    first, second = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for apart in range(1, int(np.bincount(tracks).max(initial=1))):
        low, high = order[:-apart], order[apart:]
        same = tracks[low] == tracks[high]
        first.append(low[same])
        second.append(high[same])
    lower, upper = np.concatenate(first), np.concatenate(second)
    by_pair = np.lexsort((tracks[lower], maps[upper], maps[lower]))
    return lower[by_pair], upper[by_pair]


def grouped(keys: Ints, count: int) -> tuple[Ints, Ints]:
    """
    Rows by their key (rows,), 0 to count - 1: an order (rows,) and its ends (count + 1,).

    The rows with key k are order[ends[k]:ends[k + 1]], in ascending order.
    """
    ends = np.concatenate([[0], np.cumsum(np.bincount(keys, minlength=count))])
    return np.argsort(keys, kind='stable'), ends
