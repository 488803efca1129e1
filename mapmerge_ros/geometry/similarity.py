# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Similarity transforms of 3-space as immutable values."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from mapmerge_ros.arrays import Floats, frozen
from mapmerge_ros.errors import InvalidValue
from mapmerge_ros.geometry.rotations import as_rotation


@dataclass(frozen=True, slots=True, eq=False)
class Similarity:
    """
    x_target = scale * rotation @ x_source + translation, named `S_target_source`.

    A rigid motion is the case scale = 1, a yaw and translation one that keeps the z axis.
    """

    scale: float
    rotation: Floats
    """(3, 3)"""
    translation: Floats
    """(3,), target units"""

    def __post_init__(self) -> None:
        object.__setattr__(self, 'scale', float(self.scale))
        object.__setattr__(self, 'rotation', frozen('rotation', self.rotation, float, (3, 3)))
        object.__setattr__(
            self, 'translation', frozen('translation', self.translation, float, (3,))
        )
        if not (np.isfinite(self.scale) and self.scale > 0.0):
            raise InvalidValue(f'scale: {self.scale} is not positive')

    @classmethod
    def identity(cls) -> Similarity:
        """Return the neutral element."""
        return cls(1.0, np.eye(3), np.zeros(3))

    @classmethod
    def exp(cls, tangent: Floats) -> Similarity:
        """Group element of a tangent (7,): rotation vector [rad], translation, log scale."""
        scale, rotation = np.exp(tangent[6]), Rotation.from_rotvec(tangent[:3]).as_matrix()
        return cls(scale, rotation, _mixing(tangent[:3], tangent[6]) @ tangent[3:6])

    def log(self) -> Floats:
        """Tangent (7,) whose `exp` this is: rotation vector [rad], translation, log scale."""
        rotvec, log_scale = as_rotation(self.rotation).as_rotvec(), np.log(self.scale)
        translation = np.linalg.solve(_mixing(rotvec, log_scale), self.translation)
        return np.concatenate([rotvec, translation, [log_scale]])

    def apply(self, points: Floats) -> Floats:
        """Points (..., 3) of the source frame into the target frame."""
        return self.scale * points @ self.rotation.T + self.translation

    def rotate(self, vectors: Floats) -> Floats:
        """Displacements (..., 3) of the source frame into the target frame."""
        return self.scale * vectors @ self.rotation.T

    def inverse(self) -> Similarity:
        """Return the transform in the other direction."""
        inverse_rotation = self.rotation.T / self.scale
        return Similarity(1.0 / self.scale, self.rotation.T, -inverse_rotation @ self.translation)

    def __matmul__(self, other: Similarity) -> Similarity:
        """S_a_b @ S_b_c = S_a_c."""
        return Similarity(
            self.scale * other.scale,
            self.rotation @ other.rotation,
            self.apply(other.translation),
        )

    def adjoint(self) -> Floats:
        """(7, 7) with S exp(x) S^-1 = exp(adjoint @ x), order as in `exp`."""
        matrix = np.zeros((7, 7))
        matrix[:3, :3] = self.rotation
        matrix[3:6, :3] = skew(self.translation) @ self.rotation
        matrix[3:6, 3:6] = self.scale * self.rotation
        matrix[3:6, 6] = -self.translation
        matrix[6, 6] = 1.0
        return matrix


def skew(vector: Floats) -> Floats:
    """Cross product matrix (..., 3, 3) of vectors (..., 3)."""
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    zero = np.zeros_like(x)
    rows = [zero, -z, y, z, zero, -x, -y, x, zero]
    return np.stack(rows, axis=-1).reshape(*vector.shape, 3)


def _mixing(rotvec: Floats, log_scale: float) -> Floats:
    """V with translation = V @ tangent translation: the integral of exp(t (skew + scale I))."""
    generator = skew(rotvec) + log_scale * np.eye(3)
    terms, power = np.eye(3), np.eye(3)
    # The series converges for every argument; rotations stay below pi, so 40 terms reach 1e-16.
    for n in range(2, 40):
        power = power @ generator / n
        terms = terms + power
    return terms
