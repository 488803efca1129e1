# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
Where the landmarks may be as well: the confidence region of a merge, as curved as it is.

R̄ of the outgoing map, and the standard deviations, describe an ellipsoid. Where a rotation
between sub-maps is weakly determined the true region bends away from it; the cost of merging
follows.
"""

from __future__ import annotations

import numpy as np

from mapmerge_ros.arrays import Floats, Ids, Ints
from mapmerge_ros.distributions import tail
from mapmerge_ros.errors import InvalidValue
from mapmerge_ros.fusion.informations import informations
from mapmerge_ros.fusion.joint.cost import JointCost
from mapmerge_ros.fusion.noise import pool_noise
from mapmerge_ros.fusion.outcome import Fusion
from mapmerge_ros.submap import SubMap


def p_value_of(fusion: Fusion, ids: Ids, points: Floats) -> float:
    """
    p-value of the shared landmarks of the global map lying at `points` (n, 3).

    The price of merging rises from its optimum ã to that at `points`; divided by σ² the rise is
    χ²(3n - g), or F where σ is estimated. Values below 0.01 are outside the 99 % region. The
    frame of the points does not matter within the gauge of the map. All shared landmarks have
    to be given, in any order; others are ignored.

    Raises
    ------
    InvalidValue
        Nothing is merged, or a shared landmark is missing.

    """
    members = _published(fusion)
    noise = pool_noise(members)
    association, names = fusion.components[0].association, fusion.components[0].names
    is_shared = association.views > 1
    if (is_shared & names.nameless).any():
        raise InvalidValue('ids: a shared landmark has an id that two points claim')
    shared = np.flatnonzero(is_shared)
    given = _rows(np.asarray(ids, np.uint64), names.of_tracks(association)[shared])
    positions = points[given]
    cost = JointCost.of(
        members, association.tracks, is_shared, noise.weights, informations(members)
    )
    price = cost.reduced().evaluate(positions).cost
    rise = max(price - fusion.verdict.a_tilde, 0.0) / noise.sigma**2
    freedom = 3 * len(shared) - int(fusion.components[0].gauge)
    return float(tail(rise, freedom, noise.estimated_from or np.inf))


def _published(fusion: Fusion) -> list[SubMap]:
    if not fusion.components or len(fusion.components[0].map_ids) < 2:
        raise InvalidValue('fusion: nothing is merged, so nothing is known of the landmarks')
    inside = set(fusion.components[0].map_ids)
    return [item.submap for item in fusion.alignments if item.submap.map_id in inside]


def _rows(ids: Ids, wanted: Ids) -> Ints:
    order = np.argsort(ids)
    slots = np.minimum(np.searchsorted(ids, wanted, sorter=order), len(ids) - 1)
    rows = order[slots]
    missing = ids[rows] != wanted
    if missing.any():
        raise InvalidValue(f'ids: shared landmark {wanted[missing][0]} is missing')
    return rows
