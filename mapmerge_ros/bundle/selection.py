# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Which points of a bundle are worth the bytes: R is quadratic in them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mapmerge_ros.arrays import Floats, Ids, Ints, Mask
from mapmerge_ros.bundle.bundle import Bundle
from mapmerge_ros.bundle.elimination import point_information
from mapmerge_ros.bundle.linearise import linearise
from mapmerge_ros.bundle.quality import TrackQuality, good_tracks


def matched(
    bundles: Sequence[Bundle], cap: int | None = None, quality: TrackQuality | None = None
) -> tuple[Ids, ...]:
    """
    Point ids of each bundle that another bundle has too; ids mean the same to all of them.

    With `cap`, at most so many in each bundle: those in most bundles first, then those with
    most observations, then by id. A point is taken for at least two bundles or for none.
    With `quality`, only good tracks, see `good_tracks`; areas are those of the common points.
    """
    ids, slots = np.unique(
        np.concatenate([bundle.point_ids for bundle in bundles]), return_inverse=True
    )
    ends = np.cumsum([len(bundle.point_ids) for bundle in bundles])[:-1]
    slots_of = np.split(slots.ravel(), ends)
    owners = np.zeros((len(bundles), len(ids)), np.bool_)
    views = np.zeros(len(ids), np.int64)
    for k, (bundle, own) in enumerate(zip(bundles, slots_of, strict=True)):
        owners[k, own] = True
        views[own] += _track_lengths(bundle)
    if quality:
        _drop_bad(owners, bundles, slots_of, quality)
    shared = owners.sum(axis=0)
    ranking = np.lexsort((ids, -views, -shared))
    ranking = ranking[shared[ranking] >= 2]
    room = np.full(len(bundles), len(ids) if cap is None else cap)
    taken = np.zeros_like(owners)
    for slot in ranking:
        takers = owners[:, slot] & (room > 0)
        if takers.sum() >= 2:
            taken[takers, slot] = True
            room[takers] -= 1
    return tuple(ids[row] for row in taken)


def best_tracks(bundle: Bundle, count: int, quality: TrackQuality | None = None) -> Ids:
    """Ids of the first of `ranked_tracks`, by id."""
    return np.sort(ranked_tracks(bundle, quality)[:count])


def ranked_tracks(bundle: Bundle, quality: TrackQuality | None = None) -> Ids:
    """
    Ids of all points, longest tracks first; equally long ones the better determined first.

    With `quality`, good tracks come before all others.
    """
    rows = np.arange(len(bundle.point_ids))
    bad = ~good_tracks(bundle, rows, quality) if quality else np.zeros(len(rows), np.bool_)
    order = np.lexsort((bundle.point_ids, _variances(bundle), -_track_lengths(bundle), bad))
    return bundle.point_ids[order]


def _drop_bad(
    owners: Mask, bundles: Sequence[Bundle], slots_of: Sequence[Ints], quality: TrackQuality
) -> None:
    """Take ownership (bundles, ids) of what several bundles have from those that see it badly."""
    common = owners.sum(axis=0) >= 2
    for k, (bundle, own) in enumerate(zip(bundles, slots_of, strict=True)):
        rows = np.flatnonzero(common[own])
        owners[k, own[rows]] = good_tracks(bundle, rows, quality)


def _track_lengths(bundle: Bundle) -> Ints:
    """(n,) observations of each point."""
    return np.bincount(bundle.observation_points, minlength=len(bundle.point_ids))


def _variances(bundle: Bundle) -> Floats:
    """(n,) trace of each point's covariance for σ = 1, cameras held fixed; inf if unknown."""
    strengths = np.linalg.eigvalsh(point_information(linearise(bundle)))
    with np.errstate(divide='ignore'):
        variances: Floats = np.sum(1.0 / np.maximum(strengths, 0.0), axis=1)
    return variances
