# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
Memory for what fronts leave to their parents: two stacks, taken once.

Children are done right before their parent, so what they leave is on top of the stack of their
depth; that of even depths and that of odd ones never are in each other's way. Fresh pages cost
more than the sums that are made in them: hence one piece of memory, as small as it can be.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mapmerge_ros.arrays import Floats
from mapmerge_ros.fusion.joint.fronts import Fronts


@dataclass(slots=True, eq=False)
class Stacks:
    """Matrices (n, n) in Fortran order, with anything in them."""

    memory: tuple[Floats, Floats]
    _used: list[int] = field(default_factory=lambda: [0, 0])

    @classmethod
    def of(cls, fronts: Fronts) -> Stacks:
        """Stacks that are high enough."""
        used, highest = [0, 0], [0, 0]
        left = [len(front.boundary) for front in fronts.fronts]
        for front, size in zip(fronts.fronts, left, strict=True):
            own = front.depth % 2
            used[own] += size**2
            highest[own] = max(highest[own], used[own])
            used[1 - own] -= sum(left[child] ** 2 for child in front.children)
        return cls((np.empty(highest[0]), np.empty(highest[1])))

    def push(self, depth: int, size: int) -> Floats:
        """Matrix for what a front at that depth leaves."""
        own = depth % 2
        start = self._used[own]
        self._used[own] = start + size * size
        return self.memory[own][start : start + size * size].reshape((size, size), order='F')

    def pop(self, depth: int, sizes: list[int]) -> None:
        """Give back the topmost matrices of that depth."""
        self._used[depth % 2] -= sum(size * size for size in sizes)
