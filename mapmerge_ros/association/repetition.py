# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
Whether the landmarks that are like no other one found their partners too.

Where the same façade stands twice, window matches window as well as in truth; but what only one
of the two has, and what is therefore easiest to find again, is missing in the other.
"""

from __future__ import annotations

import numpy as np

from mapmerge_ros.arrays import Floats, Ints, Mask
from mapmerge_ros.association.config import AssociationConfig
from mapmerge_ros.association.nearest import EMBEDDINGS
from mapmerge_ros.submap import Descriptors


def within(points: Floats, chosen: Mask, radius: float) -> Mask:
    """Which points are not farther off than `radius` standard deviations of the chosen ones."""
    centred = points - points[chosen].mean(axis=0)
    cov = np.atleast_2d(np.cov(centred[chosen].T, bias=True))
    # Flat scenes: the thickness of the chosen ones is no measure of the overlap's.
    cov = cov + 0.01 * np.trace(cov) * np.eye(3) + np.finfo(float).tiny * np.eye(3)
    squared = np.einsum('ni,ni->n', centred, np.linalg.solve(cov, centred.T).T)
    near: Mask = squared <= radius**2
    return near


def peculiar_score(
    points: Floats, descriptors: Descriptors, matched_rows: Ints, config: AssociationConfig
) -> float:
    """
    Standard score of how much rather the peculiar landmarks of the overlap are matched.

    A landmark is peculiar when the nearest other descriptor of its own map is far (rank sum test
    of Wilcoxon). Far below zero: those that have a twin match, those that have none do not.
    """
    matched = np.zeros(len(points), bool)
    matched[matched_rows] = True
    rows = np.flatnonzero(within(points, matched, config.overlap_radius) & descriptors.known)
    rows = np.random.default_rng(config.seed).permutation(rows)[: config.max_peculiar]
    hits = matched[rows]
    found, missed = int(hits.sum()), int((~hits).sum())
    if not found or not missed:
        return 0.0
    ranks = _ranks(_twin_distances(descriptors, rows))
    excess = ranks[hits].sum() - 0.5 * found * (len(rows) + 1)
    return float(excess / np.sqrt(found * missed * (len(rows) + 1) / 12.0))


def _ranks(values: Floats) -> Floats:
    """Ranks (k,) from 1, equal values sharing the mean of theirs."""
    _, which, counts = np.unique(values, return_inverse=True, return_counts=True)
    means: Floats = np.cumsum(counts) - 0.5 * (counts - 1)
    return means[which]


def _twin_distances(descriptors: Descriptors, rows: Ints) -> Floats:
    """Distance (k,), on a scale of its own, of each row's nearest other descriptor."""
    embed = EMBEDDINGS[descriptors.type]
    products = embed(descriptors.rows[rows], False) @ embed(descriptors.rows, True).T
    products[np.arange(len(rows)), rows] = -np.inf
    distances: Floats = -products.max(axis=1)
    return distances
