# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Axioms of the transform group, near the identity too, and alignments that recover the truth."""

import numpy as np
import pytest

from mapmerge_ros.errors import DegenerateGeometry, InvalidValue
from mapmerge_ros.geometry import (
    Gauge,
    Similarity,
    align,
    align_robustly,
    gauge_basis,
    generators,
)


def random_similarity(rng, gauge=Gauge.SIMILARITY, size=1.0):
    tangent = size * rng.normal(size=7)
    if gauge < Gauge.SIMILARITY:
        tangent[6] = 0.0
    if gauge < Gauge.RIGID:
        tangent[:2] = 0.0
    if gauge is Gauge.NONE:
        tangent[:] = 0.0
    return Similarity.exp(tangent)


def assert_equal(S, other, atol=1e-12):
    np.testing.assert_allclose(S.scale, other.scale, atol=atol)
    np.testing.assert_allclose(S.rotation, other.rotation, atol=atol)
    np.testing.assert_allclose(S.translation, other.translation, atol=atol)


@pytest.mark.parametrize('size', [1.0, 1e-3, 1e-9])
def test_group_axioms(size):
    rng = np.random.default_rng(1)
    a, b, c = (random_similarity(rng, size=size) for _ in range(3))
    points = rng.normal(size=(4, 5, 3))
    assert_equal((a @ b) @ c, a @ (b @ c))
    assert_equal(a @ a.inverse(), Similarity.identity())
    np.testing.assert_allclose((a @ b).apply(points), a.apply(b.apply(points)), atol=1e-12)
    tangent = np.array(a.log())
    assert_equal(Similarity.exp(tangent), a)
    # A rotation is a matrix with ones in it: small turns are rounded as ones are.
    atol = 1e-12 * size + 2.0 * np.finfo(float).eps
    np.testing.assert_allclose(a.log(), Similarity.exp(a.log()).log(), atol=atol)


def test_adjoint_moves_a_tangent_through_a_transform():
    rng = np.random.default_rng(2)
    S, tangent = random_similarity(rng), 0.1 * rng.normal(size=7)
    left = S @ Similarity.exp(tangent) @ S.inverse()
    assert_equal(left, Similarity.exp(S.adjoint() @ tangent), atol=1e-11)


def test_generators_are_the_derivative_of_the_group_and_nested():
    points, step = np.random.default_rng(3).normal(size=(6, 3)), 1e-6
    columns = generators(points, Gauge.SIMILARITY)
    for column, slot in enumerate([3, 4, 5, 2, 0, 1, 6]):
        tangent = np.zeros(7)
        tangent[slot] = step
        numeric = (Similarity.exp(tangent).apply(points) - points) / step
        np.testing.assert_allclose(columns[..., column], numeric, atol=1e-5)
    for gauge in Gauge:
        np.testing.assert_array_equal(generators(points, gauge), columns[..., : int(gauge)])
        basis = gauge_basis(points, gauge)
        np.testing.assert_allclose(basis.T @ basis, np.eye(int(gauge)), atol=1e-12)


@pytest.mark.parametrize('gauge', Gauge)
@pytest.mark.parametrize('scale', ['least_squares', 'tangent'])
def test_alignment_recovers_a_known_transform(gauge, scale):
    rng = np.random.default_rng(4)
    source, S = rng.normal(size=(12, 3)), random_similarity(rng, gauge)
    found = align(
        S.apply(source), source, gauge=gauge, weights=rng.uniform(0.1, 9.0, 12), scale=scale
    )
    assert_equal(found.S_target_source, S, atol=1e-10)
    assert found.rms < 1e-10


def test_tangent_scale_satisfies_the_hard_gauge():
    rng = np.random.default_rng(5)
    source, weights = rng.normal(size=(9, 3)), rng.uniform(0.1, 5.0, 9)
    target = random_similarity(rng).apply(source) + 0.1 * rng.normal(size=(9, 3))
    S = align(target, source, weights=weights, scale='tangent').S_target_source
    centred = target - weights @ target / weights.sum()
    constraint = generators(centred, Gauge.SIMILARITY) * weights[:, None, None]
    moved = (S.apply(source) - target).ravel()
    np.testing.assert_allclose(constraint.reshape(-1, 7).T @ moved, 0.0, atol=1e-10)


def test_robust_alignment_ignores_a_third_of_wrong_pairs():
    rng = np.random.default_rng(6)
    source, S = rng.normal(size=(30, 3)), random_similarity(rng)
    target = S.apply(source)
    target[:10] = 3.0 * rng.normal(size=(10, 3))
    found = align_robustly(target, source, gauge=Gauge.SIMILARITY, weights=np.ones(30), steps=60)
    np.testing.assert_allclose(found.S_target_source.apply(source[10:]), target[10:], atol=1e-3)


def test_what_points_cannot_determine_is_refused():
    line = np.linspace(0.0, 1.0, 7)[:, None] * np.array([1.0, 2.0, 0.5])
    with pytest.raises(DegenerateGeometry, match='line'):
        align(line, line)
    with pytest.raises(DegenerateGeometry, match='2 points'):
        align(line[:2], line[:2])
    mast = np.linspace(0.0, 1.0, 7)[:, None] * np.array([0.0, 0.0, 1.0])
    with pytest.raises(DegenerateGeometry, match='vertical'):
        align(mast, mast, gauge=Gauge.YAW_TRANSLATION)


def test_a_transform_is_checked_and_read_only():
    with pytest.raises(InvalidValue, match='scale'):
        Similarity(0.0, np.eye(3), np.zeros(3))
    with pytest.raises(InvalidValue, match='rotation'):
        Similarity(1.0, np.full((3, 3), np.nan), np.zeros(3))
    with pytest.raises(ValueError, match='read-only'):
        Similarity.identity().translation[0] = 1.0
