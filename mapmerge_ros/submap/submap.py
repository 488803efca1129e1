# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The compressed sub-map: all that a bundle knows about the landmarks it shares."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mapmerge_ros.arrays import Floats, Ids, frozen
from mapmerge_ros.errors import InvalidValue
from mapmerge_ros.geometry import Gauge, Similarity
from mapmerge_ros.submap.descriptors import Descriptors
from mapmerge_ros.submap.triangle import pack, packed_size, triangulate, unpack

LARGEST = 1e15
"""Of any number in a sub-map: its square still leaves room in float64 and float32."""

LEAST_OFFSET = 1e4
"""Norm of `c` [px] below which nobody asks whether it can be."""

ROUNDING = 1e-4
"""Relative error of a covariance that was computed in float32."""


MOST_RESIDUALS = 2**48
"""So many no bundle has; -1 in an unsigned field is more, and the sum of a fleet has to fit."""


@dataclass(frozen=True, slots=True, order=True)
class Source:
    """One leaf inside a map: the revision of a robot's own sub-map."""

    map_id: str
    revision: int


@dataclass(frozen=True, slots=True, eq=False)
class SubMap:
    """
    Sum of squares r'r ≈ a² + |R (q - q°) + c|² over the landmarks q, in pixels².

    The first `compressed_count` (m) landmarks are q°; the others are the catalogue: position
    and descriptor only. R is the upper trapezoid (3m - gauge, 3m), packed row by row.
    """

    map_id: str
    robot_id: str
    revision: int
    stamp_ns: int
    """Newest measurement inside."""
    frame_id: str
    sources: tuple[Source, ...]
    gauge: Gauge
    id_space: str
    landmark_ids: Ids
    """(n,) unique"""
    points: Floats
    """(n, 3) in frame_id"""
    covariances: Floats | None
    """(n, 6) xx xy xz yy yz zz [map units²] with the cameras held fixed; None = unknown"""
    compressed_count: int
    a: float
    """[px]"""
    packed_r: Floats
    """[px / map unit], float32 as on the wire or float64"""
    c: Floats
    """(3m - gauge,) [px]; zeros where the map is at its optimum"""
    residual_count: int
    dof: int
    sigma: float
    """Noise of one residual [px]; 0 = to be estimated from a, residual_count and dof"""
    descriptors: Descriptors

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        count = len(self.landmark_ids)
        set_(self, 'landmark_ids', frozen('landmark_ids', self.landmark_ids, np.uint64, (None,)))
        set_(self, 'points', frozen('points', self.points, np.float64, (count, 3)))
        if self.covariances is not None:
            shape = (count, 6)
            set_(self, 'covariances', frozen('covariances', self.covariances, np.float32, shape))
        kind = np.float32 if np.asarray(self.packed_r).dtype == np.float32 else np.float64
        set_(self, 'packed_r', frozen('r', self.packed_r, kind, (None,)))
        set_(self, 'c', frozen('c', self.c, np.float64, (None,)))
        self._check_identity()
        self._check_information()

    def _check_identity(self) -> None:
        if not self.map_id:
            raise InvalidValue('map_id: empty')
        if not self.frame_id:
            raise InvalidValue('frame_id: empty')
        if self.revision < 0:
            raise InvalidValue(f'revision: {self.revision} is negative')
        if not self.sources:
            raise InvalidValue('sources: empty; a leaf lists itself')
        if len({source.map_id for source in self.sources}) != len(self.sources):
            raise InvalidValue('sources: a map_id appears twice')
        if len(self.landmark_ids) == 0:
            raise InvalidValue('landmark_ids: a sub-map without landmarks')
        ordered = np.sort(self.landmark_ids)
        repeated = ordered[1:] == ordered[:-1]
        if repeated.any():
            raise InvalidValue(f'landmark_ids: id {ordered[1:][repeated][0]} appears twice')
        if len(self.descriptors) != len(self.landmark_ids):
            raise InvalidValue(
                f'descriptors: {len(self.descriptors)} rows for {len(self.landmark_ids)} landmarks'
            )

    def _check_information(self) -> None:
        count = self.compressed_count
        if not 0 <= count <= len(self.landmark_ids):
            raise InvalidValue(f'compressed_count: {count} of {len(self.landmark_ids)} landmarks')
        if count and 3 * count <= int(self.gauge):
            raise InvalidValue(
                f'compressed_count: {count} landmarks cannot carry a gauge of {int(self.gauge)}'
            )
        wanted = packed_size(self.rank, 3 * count)
        if len(self.packed_r) != wanted:
            raise InvalidValue(
                f'r: expected {wanted} values for {count} landmarks and gauge '
                f'{int(self.gauge)}, got {len(self.packed_r)}'
            )
        if len(self.c) != self.rank:
            raise InvalidValue(f'c: expected {self.rank} values, got {len(self.c)}')
        if not 0.0 <= self.a <= LARGEST:
            raise InvalidValue(f'a: {self.a} is not between 0 and {LARGEST:g}')
        if self.sigma != 0.0 and not 1.0 / LARGEST <= self.sigma <= LARGEST:
            raise InvalidValue(
                f'sigma: {self.sigma:g} is neither 0 nor from {1 / LARGEST:g} to {LARGEST:g}'
            )
        self._check_covariances()
        if _largest(self.points) > LARGEST:
            raise InvalidValue(f'points: a coordinate above {LARGEST:g}')
        if count and not 0.0 < _largest(self.packed_r) <= LARGEST:
            raise InvalidValue(f'r: all zero, or above {LARGEST:g}: nothing is known, or too much')
        if count and self.residual_count <= 0:
            raise InvalidValue('residual_count: zero, but landmarks are compressed')
        if count and self.dof <= 0:
            raise InvalidValue('dof: zero, but landmarks are compressed')
        if self.residual_count > MOST_RESIDUALS:
            raise InvalidValue(f'residual_count: {self.residual_count} is above 2^48')
        if self.dof > self.residual_count:
            raise InvalidValue(f'dof: {self.dof} parameters for {self.residual_count} residuals')
        if count and self.dof == self.residual_count and self.sigma == 0.0:
            raise InvalidValue('sigma: 0, and there is no redundancy to estimate it from')
        if self.c.any():
            self._check_offset()

    def _check_covariances(self) -> None:
        if self.covariances is None:
            return
        xx, xy, xz, yy, yz, zz = self.covariances.astype(np.float64).T
        least = min(xx.min(), yy.min(), zz.min())
        if least < 0.0:
            raise InvalidValue(f'covariances: a variance of {least:g} is negative')
        for first, second, both in ((xx, yy, xy), (xx, zz, xz), (yy, zz, yz)):
            rounding = (ROUNDING * np.maximum(first, second)) ** 2
            if (both**2 > (1.0 + ROUNDING) * first * second + rounding).any():
                raise InvalidValue('covariances: a correlation above 1')

    def _check_offset(self) -> None:
        """`c` says where the optimum is: |c| = |R d| with d no larger than the map."""
        offset, information = (
            float(np.linalg.norm(part.astype(np.float64))) for part in (self.c, self.packed_r)
        )
        size = float(np.linalg.norm(np.std(self.compressed_points, axis=0)))
        if offset > max(information * size, LEAST_OFFSET):
            raise InvalidValue(
                f'c: its norm is {offset:.2g} px, but {information * size:.2g} px would move all '
                'landmarks by the size of the map'
            )

    @property
    def rank(self) -> int:
        """Rows of R."""
        return max(3 * self.compressed_count - int(self.gauge), 0)

    @property
    def redundancy(self) -> int:
        """Residuals minus parameters of the bundle."""
        return self.residual_count - self.dof

    @property
    def compressed_ids(self) -> Ids:
        """(m,) ids of the landmarks that R is about."""
        return self.landmark_ids[: self.compressed_count]

    @property
    def compressed_points(self) -> Floats:
        """(m, 3) working point q°."""
        return self.points[: self.compressed_count]

    def triangle(self, dtype: type[np.floating[Any]] = np.float64) -> Floats:
        """R as a dense (3m - gauge, 3m) matrix."""
        return unpack(self.packed_r, 3 * self.compressed_count, self.rank, dtype)

    def transformed(self, S_new_old: Similarity, frame_id: str | None = None) -> SubMap:
        """
        Return the same knowledge in another frame and scale.

        The transform has to lie in the group of this map's gauge if other maps shall see the
        same physical frame conventions (metric scale, z up).
        """
        inverse = S_new_old.inverse()
        shape = self.rank, self.compressed_count, 3
        blocks = self.triangle().reshape(shape) @ (inverse.scale * inverse.rotation)
        r, c = triangulate(blocks.reshape(self.rank, 3 * self.compressed_count), self.c)
        return replace(
            self,
            frame_id=self.frame_id if frame_id is None else frame_id,
            points=S_new_old.apply(self.points),
            covariances=_rotate_covariances(S_new_old, self.covariances),
            packed_r=pack(r).astype(self.packed_r.dtype),
            c=c,
        )


def _largest(values: Floats) -> float:
    """Largest absolute value; as |values| would be a copy, of its two ends."""
    return max(float(values.max()), -float(values.min()))


def symmetric_from_upper(upper: Floats) -> Floats:
    """(n, 6) xx xy xz yy yz zz to (n, 3, 3)."""
    return upper[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3).astype(np.float64)


def upper_from_symmetric(matrices: Floats) -> Floats:
    """(n, 3, 3) to (n, 6) xx xy xz yy yz zz."""
    return matrices.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]]


def _rotate_covariances(S_new_old: Similarity, upper: Floats | None) -> Floats | None:
    if upper is None:
        return None
    linear = S_new_old.scale * S_new_old.rotation
    return upper_from_symmetric(linear @ symmetric_from_upper(upper) @ linear.T)
