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
    """Differences of landmarks, of gradients, and of the steps -M⁻¹ g, newest last."""

    def __init__(self) -> None:
        self._last: tuple[Floats, Floats, Floats] | None = None
        self._differences: list[tuple[Floats, Floats, Floats]] = []

    def forget(self) -> None:
        """M has changed."""
        self._last = None
        self._differences = []

    def improved(self, points: Floats, gradient: Floats, step: Floats) -> Floats:
        """Better step than `step` = -M⁻¹ gradient at `points`, all of one shape."""
        current = (points, gradient, step)
        if self._last is not None:
            moved, bent, changed = (a - b for a, b in zip(current, self._last, strict=True))
            self._differences = [*self._differences[1 - MEMORY :], (moved, bent, changed)]
        self._last = current
        if not self._differences:
            return step
        # In the norm of M: M applied to a change of steps is minus the change of gradients.
        inner = [[-np.sum(a[2] * b[1]) for b in self._differences] for a in self._differences]
        right = [-np.sum(a[2] * gradient) for a in self._differences]
        shares = np.linalg.lstsq(np.array(inner), np.array(right), rcond=1e-10)[0]
        ways = np.array([moved + changed for moved, _, changed in self._differences])
        improved: Floats = step - np.tensordot(shares, ways, axes=1)
        return improved
