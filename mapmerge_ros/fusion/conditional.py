# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Local tests where some members are known to be off: a wrong member blames its partners too."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.distributions import tail
from mapmerge_ros.fusion.element import coordinates
from mapmerge_ros.fusion.local import LocalTests, Sensitivity

T = TypeVar('T', bound=np.generic)


def conditional_tests(state: Sensitivity, off: Ints) -> LocalTests:
    """
    Test every member given that those which are `off` are unlocked, and those given each other.

    The partner of one that is off, in a track of two, has nothing left to be tested against.
    """
    if not len(off):
        return state.tests()
    tests = state.unlock(off).tests()
    displacement, covariance = _joint_displacement(state, off)
    statistic = np.einsum(
        'mi,mi->m', displacement, np.linalg.solve(covariance, displacement[..., None])[..., 0]
    )
    return replace(
        tests,
        testable=_with(tests.testable, off, np.ones(len(off), bool)),
        distinct=_with(tests.distinct, off, np.ones(len(off), bool)),
        statistic=_with(tests.statistic, off, statistic),
        p_value=_with(tests.p_value, off, tail(statistic, 3, state.redundancy)),
        displacement=_with(tests.displacement, off, displacement),
        covariance=_with(tests.covariance, off, covariance),
    )


def _joint_displacement(state: Sensitivity, off: Ints) -> tuple[Floats, Floats]:
    """Displacements (m, 3) of members unlocked together, and the covariance (m, 3, 3) of each."""
    joint = np.linalg.inv(state.columns(off)[coordinates(off)])
    every = np.arange(len(off))
    blocks = joint.reshape(len(off), 3, len(off), 3)[every, :, every, :]
    return (joint @ state.score[off].ravel()).reshape(-1, 3), blocks


def _with(values: npt.NDArray[T], rows: Ints, new: npt.NDArray[T]) -> npt.NDArray[T]:
    changed = values.copy()
    changed[rows] = new
    return changed
