# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Small blocks between neighbours, solved by their band."""

import numpy as np
import pytest

from mapmerge_ros.fusion.joint.banded import Banded


def test_a_band_is_solved_as_the_dense_matrix_is():
    rng = np.random.default_rng(0)
    count, width = 30, 7
    ring = np.arange(count)
    rows = np.concatenate([ring, ring, (ring + 1) % count])
    columns = np.concatenate([ring, (ring + 1) % count, ring])
    below = 0.3 * rng.normal(size=(count, width, width))
    own = rng.normal(size=(count, width, width))
    own = own @ own.transpose(0, 2, 1) + 5.0 * np.eye(width)
    blocks = np.concatenate([0.5 * own, below, below.transpose(0, 2, 1)])
    # What is given twice is summed.
    rows, columns = np.append(rows, ring), np.append(columns, ring)
    blocks = np.concatenate([blocks, 0.5 * own])
    dense = np.zeros((count, width, count, width))
    for row, column, block in zip(rows, columns, blocks, strict=True):
        dense[row, :, column, :] += block
    dense = dense.reshape(count * width, -1)
    right = rng.normal(size=(count, width))
    banded = Banded.of(rows, columns, blocks, count)
    np.testing.assert_allclose(dense @ banded.solve(right).ravel(), right.ravel(), atol=1e-10)
    assert len(banded.factor) < 0.5 * len(dense), 'no band'
    grown = Banded.of(rows, columns, blocks, count, growth=0.5).solve(right).ravel()
    heavier = dense + 0.5 * np.diag(np.diag(dense))
    np.testing.assert_allclose(heavier @ grown, right.ravel(), atol=1e-10)


def test_what_is_not_positive_definite_is_refused():
    with pytest.raises(np.linalg.LinAlgError):
        Banded.of(np.arange(2), np.arange(2), np.zeros((2, 7, 7)), 2)
