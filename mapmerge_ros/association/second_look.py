# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
Once two maps are aligned: which landmarks are the same, by where they are and how they look.

Descriptors alone find the partners that stand out in the whole map. Near where the alignment
says a partner must be there are few landmarks to choose from, and a weak descriptor suffices.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.spatial
from scipy.special import gammaln

from mapmerge_ros.arrays import Floats, Ints, Mask
from mapmerge_ros.association.appearance import Appearance, distances
from mapmerge_ros.association.landmarks import Landmarks
from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.geometry import align_robustly

MEDIAN_CHI2_3 = 2.366
"""Median of χ² with three degrees of freedom."""
TAILS = 3.0
"""Degrees of freedom of Student's t: narrow gates cost recall on real maps, which are bent."""
GATE = 10.0
"""Standard deviations within which other landmarks compete."""
CROWD = 2.5
"""Standard deviations within which other landmarks are counted: more would leave the surface."""
NEIGHBOURS = 12
"""Landmarks of the other map that are looked at around each."""
FIELD_NEIGHBOURS = 12
"""Links that the smooth displacement between the maps is averaged over."""


@dataclass(frozen=True, slots=True, eq=False)
class Links:
    """Landmarks of two maps that may be the same point."""

    of_a: Ints
    """(n,)"""
    of_b: Ints
    """(n,)"""
    posteriors: Floats
    """(n,) probability of each link, from appearance and position"""

    def __len__(self) -> int:
        return len(self.of_a)

    def best(self, count_a: int, count_b: int) -> Links:
        """Return the probable ones that are the best of both landmarks: one partner each."""
        kept = mutual_best(self.of_a, self.of_b, self.posteriors, count_a, count_b)
        kept &= self.posteriors > 0.5
        return Links(self.of_a[kept], self.of_b[kept], self.posteriors[kept])

    def above(self, posterior: float) -> Links:
        """Return those with at least this posterior."""
        kept = self.posteriors >= posterior
        return Links(self.of_a[kept], self.of_b[kept], self.posteriors[kept])


def second_look(a: Landmarks, b: Landmarks, links: Links, rounds: int = 3) -> Links:
    """
    Search the partners of all landmarks; `a` and `b` are in one frame, aligned up to bending.

    `links` are those known so far: they say how well the maps fit and how alike partners look.
    What follows from them changes how the maps fit, but not how alike partners look: the further
    one searches the more false ones come in, and they would teach that anything may pass.
    """
    right = distances(a.descriptors, b.descriptors, links.of_a, links.of_b)
    tree_a = scipy.spatial.KDTree(a.points)
    for _ in range(rounds):
        b = _realigned(a, b, links)
        bending = Bending.between(a, b, links)
        moved = b.points + bending.field(b.points)
        near_a, near_b = _candidates(tree_a, moved)
        wrong = distances(a.descriptors, b.descriptors, near_a, near_b)
        alike = Appearance.learnt(right, wrong).log_ratio(wrong)
        gaps = a.points[near_a] - moved[near_b]
        covariances = a.covariances[near_a] + b.covariances[near_b]
        chi2 = mahalanobis(gaps, covariances, bending.variance)
        found = _weigh(near_a, near_b, chi2, alike, (len(a), len(b)))
        links = found.best(len(a), len(b))
    return found


def _realigned(a: Landmarks, b: Landmarks, links: Links) -> Landmarks:
    """Return b moved by what its links say, each weighted with what is known of its ends."""
    ends_a, ends_b = a.points[links.of_a], b.points[links.of_b]
    covariances = a.covariances[links.of_a] + b.covariances[links.of_b]
    variances = np.trace(covariances, axis1=1, axis2=2) / 3.0
    variances += unexplained_variance(ends_a - ends_b, covariances)
    gauge = max(a.gauge, b.gauge)
    try:
        moved = align_robustly(ends_a, ends_b, gauge=gauge, weights=1.0 / variances)
    except DegenerateGeometry:
        return b
    return b.moved(moved.S_target_source)


@dataclass(frozen=True, slots=True, eq=False)
class Bending:
    """Smooth displacement of b against a, and the variance that it does not explain."""

    at: Floats
    """(n, 3) places of the links"""
    displacements: Floats
    """(n, 3) a - b"""
    weights: Floats
    """(n,) inverse variances"""
    variance: float
    """of one coordinate, beyond the landmarks' own covariances [map units²]"""

    @classmethod
    def between(cls, a: Landmarks, b: Landmarks, links: Links) -> Bending:
        """Measure it at the links."""
        displacements = a.points[links.of_a] - b.points[links.of_b]
        covariances = a.covariances[links.of_a] + b.covariances[links.of_b]
        variance = unexplained_variance(displacements, covariances)
        own = np.trace(covariances, axis1=1, axis2=2) / 3.0
        raw = cls(a.points[links.of_a], displacements, 1.0 / (own + variance), variance)
        left = displacements - raw.field(raw.at, leave_out=True)
        return cls(raw.at, displacements, raw.weights, unexplained_variance(left, covariances))

    def field(self, points: Floats, leave_out: bool = False) -> Floats:
        """Displacement (n, 3) at points (n, 3); `leave_out` drops the nearest link, itself."""
        count = min(FIELD_NEIGHBOURS + leave_out, len(self.at))
        if count - leave_out < 3:
            return np.zeros_like(points)
        ranges, nearest = map(np.asarray, scipy.spatial.KDTree(self.at).query(points, k=count))
        if leave_out:
            ranges, nearest = ranges[:, 1:], nearest[:, 1:]
        reach = np.maximum(ranges[:, -1:], np.finfo(float).tiny)
        weights = self.weights[nearest] * np.exp(-2.0 * (ranges / reach) ** 2)
        weights /= weights.sum(axis=1, keepdims=True)
        return np.asarray(np.einsum('nk,nkc->nc', weights, self.displacements[nearest]))


def unexplained_variance(displacements: Floats, covariances: Floats) -> float:
    """Variance per coordinate that brings the median χ² of (n, 3) displacements to its value."""
    squares = np.sum(displacements**2, axis=1)
    low, high = 0.0, float(np.median(squares)) + np.finfo(float).tiny
    for _ in range(40):
        middle = 0.5 * (low + high)
        chi2 = mahalanobis(displacements, covariances, middle)
        low, high = (middle, high) if np.median(chi2) > MEDIAN_CHI2_3 else (low, middle)
    return high


def mahalanobis(displacements: Floats, covariances: Floats, variance: float = 0.0) -> Floats:
    """
    Squared distances (n,) in standard deviations; `variance` is added to every coordinate.

    By the Cholesky factors without roots, all at once: six times as fast as `np.linalg.solve`.
    """
    x, y, z = displacements.T
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = covariances.transpose(1, 2, 0)
    more = variance + 1e-12 * (xx + yy + zz + 3.0 * variance) + 1e-300
    xx, yy, zz = xx + more, yy + more, zz + more
    y_x, z_x = xy / xx, xz / xx
    yy, yz, y = yy - y_x * xy, yz - y_x * xz, y - y_x * x
    z_y = yz / yy
    zz, z = zz - z_x * xz - z_y * yz, z - z_x * x - z_y * y
    return np.asarray(x**2 / xx + y**2 / yy + z**2 / zz)


def _candidates(tree_a: scipy.spatial.KDTree, moved: Floats) -> tuple[Ints, Ints]:
    """Pairs of landmarks that are neighbours of each other, seen from either map."""
    tree_b = scipy.spatial.KDTree(moved)
    forward = _neighbours(tree_a.data, tree_b)
    backward = _neighbours(moved, tree_a)
    keys = np.concatenate(
        [forward[0] * len(moved) + forward[1], backward[1] * len(moved) + backward[0]]
    )
    keys.sort()
    keys = keys[np.diff(keys, prepend=-1) > 0]
    near_a, near_b = np.divmod(keys, len(moved))
    return near_a, near_b


def _neighbours(points: Floats, others: scipy.spatial.KDTree) -> tuple[Ints, Ints]:
    count = min(NEIGHBOURS, others.n)
    _, nearest = others.query(points, k=count)
    return np.repeat(np.arange(len(points)), count), np.asarray(nearest, np.int64).ravel()


def _weigh(of_a: Ints, of_b: Ints, chi2: Floats, alike: Floats, counts: tuple[int, int]) -> Links:
    """Posteriors of pairs that are near enough; `counts` are the landmarks of both maps."""
    near = chi2 < GATE**2
    of_a, of_b, chi2, alike = of_a[near], of_b[near], chi2[near], alike[near]
    close = chi2 < CROWD**2
    crowd = np.maximum(
        np.bincount(of_a[close], minlength=counts[0])[of_a],
        np.bincount(of_b[close], minlength=counts[1])[of_b],
    ).clip(1)
    log_ratio = log_student(chi2) + np.log(4.0 / 3.0 * np.pi * CROWD**3 / crowd) + alike
    return Links(of_a, of_b, _posteriors(of_a, of_b, log_ratio, *counts))


def log_student(chi2: Floats) -> Floats:
    """Log density of a three-dimensional Student t at squared distances (n,)."""
    scale = (TAILS - 2.0) / TAILS  # so that the covariance is the identity
    constant = (
        gammaln((TAILS + 3.0) / 2.0) - gammaln(TAILS / 2.0) - 1.5 * np.log(TAILS * np.pi * scale)
    )
    density: Floats = constant - (TAILS + 3.0) / 2.0 * np.log1p(chi2 / (TAILS * scale))
    return density


def _posteriors(of_a: Ints, of_b: Ints, log_ratio: Floats, count_a: int, count_b: int) -> Floats:
    """Probability of each pair against all other partners of its landmarks, and none."""
    ratio = np.exp(np.minimum(log_ratio, 50.0))
    looked_at = min(np.count_nonzero(np.bincount(of_a)), np.count_nonzero(np.bincount(of_b)))
    share = 0.5
    for _ in range(10):
        odds = share / (1.0 - share) * ratio
        total_a = np.bincount(of_a, odds, count_a)[of_a]
        total_b = np.bincount(of_b, odds, count_b)[of_b]
        posterior: Floats = odds / (1.0 + np.maximum(total_a, total_b))
        share = float(np.clip(posterior.sum() / max(looked_at, 1), 0.05, 0.95))
    return posterior


def mutual_best(of_a: Ints, of_b: Ints, values: Floats, count_a: int, count_b: int) -> Mask:
    """Pairs that are the best of both of their landmarks."""
    best_a, best_b = np.full(count_a, -np.inf), np.full(count_b, -np.inf)
    np.maximum.at(best_a, of_a, values)
    np.maximum.at(best_b, of_b, values)
    return np.asarray((values == best_a[of_a]) & (values == best_b[of_b]))
