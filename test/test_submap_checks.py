# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Sub-maps that keep the shape of the message and still cannot be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from submaps import small_submap

from mapmerge_ros.errors import InvalidValue


@pytest.mark.parametrize(
    ('rows', 'reason'),
    [
        ([-1.0, 0, 0, 1, 0, 1], 'a variance of -1 is negative'),
        ([1.0, 0, 0, -1e-3, 0, 1], 'is negative'),
        ([1.0, 1.5, 0, 1, 0, 1], 'a correlation above 1'),
        ([1.0, 0, 0, 1, -2.0, 1], 'a correlation above 1'),
    ],
)
def test_what_is_no_covariance_is_refused(rows: list[float], reason: str) -> None:
    submap = small_submap()
    covariances = np.tile([1.0, 0, 0, 1, 0, 1], (len(submap.points), 1))
    assert replace(submap, covariances=covariances).covariances is not None
    covariances[1] = rows
    with pytest.raises(InvalidValue, match=reason):
        replace(submap, covariances=covariances)


def test_an_offset_beyond_all_of_the_map_is_refused() -> None:
    submap = small_submap()
    with pytest.raises(InvalidValue, match='c: its norm is 1e\\+09 px'):
        replace(submap, c=np.full(len(submap.c), 1e9 / np.sqrt(len(submap.c))))


def test_more_residuals_than_anybody_has_are_refused() -> None:
    """-1 in an unsigned field: the sum of the fleet would not fit, and no merge go out."""
    with pytest.raises(InvalidValue, match=r'residual_count: \d+ is above 2\^48'):
        replace(small_submap(), residual_count=2**64 - 1)
    assert replace(small_submap(), residual_count=2**40).residual_count == 2**40
