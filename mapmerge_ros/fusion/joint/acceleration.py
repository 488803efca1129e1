# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
Steps of an old factor made better by what the last steps have shown (Anderson 1965).

With the matrix M of earlier landmarks, q - M⁻¹ g(q) converges linearly. The last steps and
gradients tell how the true matrix differs along them: on a quadratic cost this is GMRES.
"""

from __future__ import annotations

import numpy as np

from mapmerge_ros.arrays import Floats

MEMORY = 6
"""Differences that are kept: the modes in which M is too old are few, and each costs memory."""


class Acceleration:
    """Differences of gradients and of the steps -M⁻¹ g, and where these lead; the oldest go."""

    def __init__(self) -> None:
        self._last: tuple[Floats, Floats, Floats] | None = None
        self._bent = self._changed = self._ways = np.zeros((MEMORY, 0))
        self._count = 0

    def forget(self) -> None:
        """M has changed."""
        self._last, self._count = None, 0

    def improved(self, points: Floats, gradient: Floats, step: Floats) -> Floats:
        """Better step than `step` = -M⁻¹ gradient at `points`, all of one shape."""
        current = points.ravel(), gradient.ravel(), step.ravel()
        if self._last is not None:
            moved, bent, changed = (a - b for a, b in zip(current, self._last, strict=True))
            self._keep(bent, changed, moved + changed)
        self._last = current
        if not self._count:
            return step
        kept = min(self._count, MEMORY)
        changed, bent, ways = (x[:kept] for x in (self._changed, self._bent, self._ways))
        # In the norm of M: M applied to a change of steps is minus the change of gradients.
        shares = np.linalg.lstsq(-changed @ bent.T, -changed @ current[1], rcond=1e-10)[0]
        improved: Floats = step - (shares @ ways).reshape(step.shape)
        return improved

    def _keep(self, bent: Floats, changed: Floats, way: Floats) -> None:
        if self._bent.shape[1] != len(bent):
            self._bent, self._changed, self._ways = (
                np.empty((MEMORY, len(bent))) for _ in range(3)
            )
        slot = self._count % MEMORY
        self._bent[slot], self._changed[slot], self._ways[slot] = bent, changed, way
        self._count += 1
