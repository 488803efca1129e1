# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A sub-map that is not used, and why."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Quarantine:
    """A sub-map that is wrong as a whole: the others agree, with it they do not."""

    contradicts: tuple[str, ...]
    """map_ids of sub-maps that it shares most landmarks with"""
    price_ratio: float
    """What it adds to the price of merging, over what noise as large as the others' would add"""
    p_value: float
    """Of so high an addition"""
    distance: float
    """Median distance of its landmarks from where the others have them, global map units"""
    distance_ratio: float
    """The same, of the scene radius"""


@dataclass(frozen=True, slots=True)
class Refusal:
    """A sub-map that is not used, and why."""

    map_id: str
    reason: str
    quarantine: Quarantine | None = None


def listed(names: Sequence[str]) -> str:
    """Names as a sentence has them: a, b and c."""
    return ' and '.join(filter(None, [', '.join(names[:-1]), *names[-1:]]))
