# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
How sub-maps differ at their common landmarks: the data of the covariance model.

Per track the positions that i sub-maps give it are taken to i - 1 orthonormal (Helmert)
contrasts, which do not depend on where the landmark is. What the frames can explain is left in:
the likelihood takes it out (docs/statistics.md).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
import scipy.sparse
import scipy.spatial.distance

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.blas import inverse_of_positive
from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.fusion.element import coordinates
from mapmerge_ros.fusion.quadratic import Quadratic
from mapmerge_ros.fusion.sample import LEAST_OF_A_MAP, NOBODY, spread_over, within_some_maps
from mapmerge_ros.geometry import scene_radius

SMOOTH_RADII = 0.7
"""Length of the smooth field, in scene radii: a lens that is wrong bends a map over its extent."""

MANY_CONTRASTS = 50
"""Fewer do not carry three variances and their tails without what is known of them before."""

Sparse: TypeAlias = scipy.sparse.csc_array


@dataclass(frozen=True, slots=True, eq=False)
class Contrasts:
    """Contrasts w (3t,) of the merge with the parts of their covariance, all for unit size."""

    from_members: scipy.sparse.csr_array
    """(t, s) orthonormal rows, the same for x, y and z"""
    tracks: Ints
    """(t,) ascending"""
    owners: Ints
    """(s,) track of each member; -1: it is in none of these contrasts"""
    differences: Floats
    """w (3t,) global map units"""
    noise: Floats
    """(3t, 3t) what the sub-maps say of themselves, for their σ [map units²]"""
    smooth: Floats
    """(t, t) correlation of the smooth field, the same for x, y and z"""
    frames: Floats
    """(3t, Σg_k - g) orthonormal: differences that frames can explain"""
    unit: float
    """Typical standard deviation of a difference [map units]"""
    radius: float
    """Of the scene [map units]"""
    pairs: tuple[Ints, Ints, Ints, Floats]
    """Contrasts (p,) and (p,) that have the same member (p,), and the product of their weights"""

    @property
    def dof(self) -> int:
        """Differences less what frames explain."""
        return int(self.differences.size - self.frames.shape[1])

    def covariance(self, variances: Floats) -> Floats:
        """V (3t, 3t) for variances (3,) of noise, ground floor and smooth field."""
        noise, ground, smooth = variances * np.array([1.0, self.unit**2, self.unit**2])
        covariance: Floats = noise * self.noise
        covariance[np.diag_indices_from(covariance)] += ground
        if smooth > 0.0:
            for axis in range(3):
                covariance[axis::3, axis::3] += smooth * self.smooth
        return covariance

    def parts(self, vector: Floats) -> Floats:
        """Derivative of V by each variance, times a vector (3t,): (3, 3t)."""
        smooth = (self.smooth @ vector.reshape(-1, 3)).ravel()
        scale = np.array([[1.0], [self.unit**2], [self.unit**2]])
        parts: Floats = scale * np.array([self.noise @ vector, vector, smooth])
        return parts

    def traces(self, matrix: Floats) -> Floats:
        """Trace of a matrix (3t, 3t) times the derivative of V by each variance: (3,)."""
        by_axis = sum(float(np.vdot(matrix[k::3, k::3], self.smooth)) for k in range(3))
        scale = np.array([1.0, self.unit**2, self.unit**2])
        traces: Floats = scale * [np.vdot(matrix, self.noise), np.trace(matrix), by_axis]
        return traces

    def traces_of_square(self, root: Floats) -> Floats:
        """`traces` of R'R, for R (u, 3t)."""
        by_axis = sum(float(np.vdot(own @ self.smooth, own)) for own in _axes(root))
        scale = np.array([1.0, self.unit**2, self.unit**2])
        traces: Floats = scale * [np.vdot(root @ self.noise, root), np.vdot(root, root), by_axis]
        return traces

    def columns(self, members: Ints) -> Sparse:
        """What displacements of some members (m,) do to the differences: C (3t, 3m)."""
        chosen = self.from_members[:, members]
        return scipy.sparse.csc_array(scipy.sparse.kron(chosen, np.eye(3), format='csc'))

    def blocks(self, matrix: Floats) -> Floats:
        """Blocks (s, 3, 3) of C'M C of each member with itself, for M (3t, 3t)."""
        firsts, seconds, members, values = self.pairs
        count = len(self.tracks)
        gathered = matrix.reshape(count, 3, count, 3)[firsts, :, seconds, :]
        blocks = np.zeros((self.from_members.shape[1], 3, 3))
        np.add.at(blocks, members, values[:, None, None] * gathered)
        return blocks

    def by_member(self, rows: Floats) -> Floats:
        """C'R' (s, 3, u) of some rows R (u, 3t)."""
        tracks, members = self.from_members.shape
        found = self.from_members.T @ rows.T.reshape(tracks, 3 * len(rows))
        return np.asarray(found).reshape(members, 3, len(rows))

    def scores(self, weighted: Floats) -> Floats:
        """C'P w (s, 3)."""
        return np.asarray(self.from_members.T @ weighted.reshape(-1, 3))

    def blind_to(self, members: Ints) -> Contrasts:
        """The same differences, displacements of some members explained like frames."""
        if not len(members):
            return self
        both = np.column_stack([self.frames, self.columns(members).toarray()])
        return replace(self, frames=np.linalg.qr(both)[0])

    def thinned(self, at_most: int) -> Contrasts:
        """Contrasts of every n-th track only."""
        rows = spread_over(self.tracks, at_most, NOBODY)
        if len(rows) == len(self.tracks):
            return self
        at = coordinates(rows)
        helmert = self.from_members[rows]
        return Contrasts(
            helmert,
            self.tracks[rows],
            np.where(np.isin(self.owners, self.tracks[rows]), self.owners, -1),
            self.differences[at],
            self.noise[np.ix_(at, at)],
            self.smooth[np.ix_(rows, rows)],
            np.linalg.qr(self.frames[at])[0],
            self.unit,
            self.radius,
            same_member_pairs(helmert),
        )


def contrasts(merge: Quadratic, at_most: int, suspects: Ints = NOBODY) -> Contrasts:
    """
    Contrasts of a merge, of every n-th track if there are more than `at_most`.

    Of a large fleet, within some maps that hang together: spread over all of them, a few members
    of each would be explained by its frame.

    Tracks of the members `suspects` (m,) are always in: whether they moved must not go unasked.

    Raises
    ------
    DegenerateGeometry
        A landmark is not determined within its sub-map.

    """
    members = merge.members
    helmert, tracks = _helmert(members.tracks, merge.views)
    near = within_some_maps(members, at_most // LEAST_OF_A_MAP, suspects)
    rows = np.flatnonzero(near[tracks])
    rows = rows[spread_over(tracks[rows], at_most, members.tracks[suspects])]
    helmert, tracks = helmert[rows], tracks[rows]
    count = 3 * len(tracks)
    radius = scene_radius(merge.points)
    differences, noise = np.zeros(count), np.zeros((count, count))
    smooth, frames = np.zeros((len(tracks), len(tracks))), []
    for k, information in enumerate(merge.information):
        part, basis = members.of_map(k), merge.frames(k)
        own = helmert[:, part]
        rows = np.flatnonzero(np.diff(own.indptr))
        if not len(rows):
            continue
        own = own[rows]
        spread = scipy.sparse.kron(own, np.eye(3), format='csr')
        at = coordinates(rows)
        covariance = shape_covariance(information, basis)
        differences[at] -= spread @ (covariance @ merge.gradient[part].ravel())
        noise[np.ix_(at, at)] += between(spread, covariance)
        field = matern(merge.points[members.tracks[part]], SMOOTH_RADII * radius)
        smooth[np.ix_(rows, rows)] += between(own, field)
        explained = np.zeros((count, basis.shape[1]))
        explained[at] = spread @ basis
        frames.append(explained)
    left, sizes, _ = np.linalg.svd(np.column_stack(frames), full_matrices=False)
    # All maps together can move as one; parts of a sample that do not hang together, each alone.
    rank = sum(map(int, merge.gauges)) - int(merge.gauge)
    left = left[:, : rank if near.all() else int((sizes > 1e-9 * sizes[0]).sum())]
    unit = float(np.sqrt(np.median(np.diag(noise))))
    return Contrasts(
        from_members=helmert,
        tracks=tracks,
        owners=np.where(np.isin(members.tracks, tracks), members.tracks, -1),
        differences=differences,
        noise=noise,
        smooth=smooth,
        frames=left,
        unit=unit,
        radius=radius,
        pairs=same_member_pairs(helmert),
    )


def _axes(rows: Floats) -> Floats:
    """Rows (u, 3t) by axis, (3, u, t)."""
    return np.ascontiguousarray(rows.reshape(len(rows), -1, 3).transpose(2, 0, 1))


def matern(points: Floats, length: float) -> Floats:
    """Matérn 3/2 correlation (n, n) of a field at `points` (n, 3): once differentiable."""
    scaled = np.sqrt(3.0) / length * scipy.spatial.distance.cdist(points, points)
    correlation: Floats = (1.0 + scaled) * np.exp(-scaled)
    return correlation


def shape_covariance(information: Floats, basis: Floats) -> Floats:
    """
    Inverse of the information of a sub-map that cannot see `basis`, its frame held loosely.

    How loosely does not matter, the likelihood is blind to frames; held it must be, or the last
    digits decide whether the matrix is definite.
    """
    weight = float(np.diag(information).mean())
    try:
        return inverse_of_positive(information + weight * basis @ basis.T)
    except np.linalg.LinAlgError:
        raise DegenerateGeometry('a landmark is not determined within its sub-map') from None


def _helmert(tracks: Ints, views: Ints) -> tuple[scipy.sparse.csr_array, Ints]:
    """Contrast a of a track: the mean of its first a members less the next one, a = 1 … i-1."""
    order = np.argsort(tracks, kind='stable')
    position = np.arange(len(tracks)) - np.repeat(np.cumsum(views) - views, views)
    later = np.flatnonzero(position > 0)
    lengths = position[later] + 1
    rows = np.repeat(np.arange(len(later)), lengths)
    inside = np.arange(len(rows)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    columns = order[np.repeat(later - position[later], lengths) + inside]
    before = np.repeat(position[later], lengths)
    values = np.where(inside < before, 1.0, -before) / np.sqrt(before * (before + 1.0))
    matrix = scipy.sparse.csr_array((values, (rows, columns)), shape=(len(later), len(tracks)))
    return matrix, tracks[order][later]


def same_member_pairs(helmert: scipy.sparse.csr_array) -> tuple[Ints, Ints, Ints, Floats]:
    """`Contrasts.pairs` of some contrasts."""
    by_member = helmert.tocsc()
    counts = np.diff(by_member.indptr)
    firsts = np.repeat(np.arange(by_member.nnz), np.repeat(counts, counts))
    starts = np.repeat(by_member.indptr[:-1], counts**2)
    sizes = np.repeat(counts, counts**2)
    inside = np.arange(len(firsts)) - np.repeat(np.cumsum(counts**2) - counts**2, counts**2)
    seconds = starts + inside % np.maximum(sizes, 1)
    return (
        by_member.indices[firsts].astype(np.int64),
        by_member.indices[seconds].astype(np.int64),
        np.repeat(np.arange(len(counts)), counts**2),
        by_member.data[firsts] * by_member.data[seconds],
    )


def between(rows: scipy.sparse.csr_array, covariance: Floats) -> Floats:
    """Covariance of some combinations (`rows`) of what has a covariance."""
    half = np.asarray(rows @ covariance)
    return np.asarray(rows @ half.T)
