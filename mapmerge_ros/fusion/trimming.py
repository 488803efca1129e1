# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Which landmarks are too far off to have a say in a fit."""

from __future__ import annotations

import numpy as np

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.distributions import chi2_quantile
from mapmerge_ros.fusion.contrasts import MANY_CONTRASTS, Contrasts
from mapmerge_ros.fusion.likelihood import SEEN, Weighing

TRIM = chi2_quantile(1e-3, 3)
"""Statistic beyond which a landmark has no say in the fit: of Gaussian ones, one in a thousand."""

MOST_ASIDE, MOST_ASIDE_OF_FEW = 0.25, 0.15
"""
Share of the tracks that may be set aside: what is left has to be the rule.

Of few, chance makes the bulk look narrow once its widest are gone.
"""

KEEP_TRIMMED = 0.8
"""Share of `TRIM` below which a landmark gets its say back; less than 1, or it goes in circles."""


def trimmed(data: Contrasts, weighing: Weighing, aside: Ints, moved: Ints) -> tuple[Ints, Floats]:
    """
    Members to set aside, starting from those that are; and the statistic of each track.

    The worst member of a track speaks for it; who is aside is tested against the others alone,
    who is not, given that those are.
    """
    statistics = _statistics(data, weighing.unlocked(data, aside), np.append(moved, aside))
    limits = np.full(len(statistics), TRIM)
    if len(aside):
        of_aside = np.isin(data.owners, data.owners[aside])
        statistics[of_aside] = 0.0
        statistics[aside] = _given_each_other(data, weighing, aside)
        limits[aside] *= KEEP_TRIMMED
    order = np.lexsort((statistics, data.owners))
    is_last = np.append(np.diff(data.owners[order]) > 0, True)
    worst = order[is_last & (statistics[order] > 0.0)]
    chosen = worst[statistics[worst] > limits[worst]]
    share = MOST_ASIDE if len(data.tracks) >= MANY_CONTRASTS else MOST_ASIDE_OF_FEW
    most = int(share * len(worst))
    chosen = chosen[np.argsort(-statistics[chosen], kind='stable')][:most]
    return np.sort(_together(data, weighing, chosen)), statistics[worst]


def _statistics(data: Contrasts, weighing: Weighing, unlocked: Ints) -> Floats:
    """Statistic (s,) of each locked member given the unlocked; 0 where there is none."""
    locked = data.owners >= 0
    locked[unlocked] = False
    views = np.bincount(data.owners[locked], minlength=int(data.owners.max()) + 1)
    tested = np.flatnonzero(locked & (views[data.owners] > 1))
    blocks, is_seen = weighing.blocks(data)
    tested = tested[is_seen[tested]]
    scores, blocks = data.scores(weighing.weighted)[tested], blocks[tested]
    statistics = np.zeros(len(locked))
    statistics[tested] = _squares(scores, blocks)
    return statistics


def _together(data: Contrasts, weighing: Weighing, members: Ints) -> Ints:
    """
    Members (m,) whose displacements are all seen, each given those before it.

    Of a map with few members in the sample some can be free, the others then hold its frame.
    """
    information = np.asarray(weighing.seen(columns := data.columns(members)) @ columns)
    sizes = np.einsum('ii->i', information).copy()
    kept = []
    for k in range(len(members)):
        own = slice(3 * k, 3 * k + 3)
        values, vectors = np.linalg.eigh(information[own, own])
        if values[0] <= SEEN * sizes[own].sum():
            continue
        kept.append(k)
        root = information[:, own] @ (vectors / np.sqrt(values))
        information = information - root @ root.T
    return members[kept]


def _given_each_other(data: Contrasts, weighing: Weighing, aside: Ints) -> Floats:
    """Statistic (m,) of each unlocked member, the others staying unlocked."""
    columns = data.columns(aside)
    covariance = np.linalg.inv(weighing.seen(columns) @ columns)
    displacement = (covariance @ (columns.T @ weighing.weighted)).reshape(-1, 3)
    count, every = len(aside), np.arange(len(aside))
    blocks = covariance.reshape(count, 3, count, 3)[every, :, every, :]
    return _squares(displacement, blocks)


def _squares(vectors: Floats, blocks: Floats) -> Floats:
    """Square v' B⁻¹ v for each of (n, 3) and (n, 3, 3)."""
    solved = np.linalg.solve(blocks, vectors[..., None])[..., 0]
    return np.asarray(np.einsum('si,si->s', vectors, solved))
