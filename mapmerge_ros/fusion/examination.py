# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What an examination of a merge found (`honest.examine`)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mapmerge_ros.arrays import Ints
from mapmerge_ros.distributions import tail
from mapmerge_ros.fusion.covariance_model import CovarianceModel
from mapmerge_ros.fusion.local import LocalTests
from mapmerge_ros.fusion.objects import MovedObject
from mapmerge_ros.fusion.sample import NOBODY
from mapmerge_ros.fusion.scales import ScaleTest


@dataclass(frozen=True, slots=True, eq=False)
class Examination:
    """What is wrong with a merge, and whether the rest can be believed."""

    price: float
    """Of what is neither an object nor aside, under the model"""
    dof: int
    p_value: float
    """
    Of that price and all that had to be believed for it, of so many bad landmarks and of the
    worst: thrice the least of the three.
    """
    model: CovarianceModel | None = None
    """None: the textbook holds, or nothing else may be believed"""
    objects: tuple[MovedObject, ...] = ()
    p_objects: float = 1.0
    """That objects as strong as these are errors under the model; 1 without any"""
    aside: Ints = field(default_factory=NOBODY.copy)
    """Members beyond all else, one of a track at most"""
    tests: LocalTests | None = None
    """
    Of every member, p-values under the model, given that objects and what is aside are off.

    None in a very large merge.
    """
    textbook_tests: LocalTests | None = None
    """Every sub-map believed to the letter, all members locked"""
    doubtful: Ints = field(default_factory=NOBODY.copy)
    """
    Single members that are off, under false-discovery control, none of them in an object.

    Nobody where the geometry is not certain, or in a very large merge.
    """
    wrong_scale: ScaleTest | None = None
    """Metric sub-map that is larger or smaller than the others have it"""


def by_textbook(price: float, dof: int, redundancy: float) -> Examination:
    """Examination that looks at the price alone, in units of σ²."""
    p_value = float(tail(np.array(price), dof, redundancy)) if dof > 0 else 1.0
    return Examination(price, dof, p_value)
