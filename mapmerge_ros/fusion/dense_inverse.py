# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Inverse of the matrix of a merge in its plain, dense form: oracle of the one by fronts."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mapmerge_ros.arrays import Floats
from mapmerge_ros.blas import inverse_of_positive
from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.fusion.element import coordinates
from mapmerge_ros.fusion.quadratic import Quadratic
from mapmerge_ros.geometry import gauge_basis


class DenseInverse:
    """`Inverse` of a merge, all landmarks at once: work grows with the cube of their number."""

    def __init__(self, merge: Quadratic) -> None:
        """
        Invert H = Σ L_k + gauge.

        Raises
        ------
        DegenerateGeometry
            The landmarks are not determined by the sub-maps together.

        """
        members = merge.members
        self._at = [
            coordinates(members.tracks[members.of_map(k)]) for k in range(len(merge.information))
        ]
        hessian = np.zeros((merge.points.size, merge.points.size))
        for own, rows in zip(merge.information, self._at, strict=True):
            hessian[np.ix_(rows, rows)] += own
        null = gauge_basis(merge.points, merge.gauge)
        hessian += np.diag(hessian).mean() * null @ null.T
        try:
            self._inverse = inverse_of_positive(hessian)
        except np.linalg.LinAlgError:
            raise DegenerateGeometry('a merged landmark is not determined') from None

    def solve(self, right: Floats) -> Floats:
        """Solve for right-hand sides (3n, m)."""
        return np.asarray(self._inverse @ right)

    def blocks(self) -> Iterator[tuple[int, Floats]]:
        """Each sub-map with its own block (3s_k, 3s_k)."""
        for k, rows in enumerate(self._at):
            yield k, self._inverse[np.ix_(rows, rows)]
