# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The fast merge against its plain form: stacked cost, fronts, selected inverse, many links."""

from dataclasses import replace

import numpy as np
import pytest
from joint_cases import CASES, CONFIG, GAUGES, IDS, at_optimum, case, made_fleets, merged
from test_geometry import random_similarity

pytest.importorskip('pycolmap', reason='simulated maps are bundled by Ceres: pip install pycolmap')

from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.fusion.associate import associate_by_id
from mapmerge_ros.fusion.compress import frame_covariance, normal_equations
from mapmerge_ros.fusion.element import coordinates
from mapmerge_ros.fusion.informations import informations
from mapmerge_ros.fusion.joint.cost import JointCost
from mapmerge_ros.fusion.joint.covariance import schur_complement, uncertainty
from mapmerge_ros.fusion.joint.derivatives import gradient as gradient_of
from mapmerge_ros.fusion.joint.factor import Carried
from mapmerge_ros.fusion.joint.factorise import factorise
from mapmerge_ros.fusion.joint.minimise import gauss_newton, minimise, plan
from mapmerge_ros.fusion.links import find_links
from mapmerge_ros.fusion.merge import assemble, merge
from mapmerge_ros.fusion.overlap import link_pair
from mapmerge_ros.geometry import (
    Gauge,
    Segments,
    align,
    align_robustly,
    align_segments,
    align_segments_robustly,
    gauge_basis,
)
from mapmerge_ros.submap import alignment_weights, pack


@pytest.fixture(scope='module')
def fleets():
    return made_fleets()


@pytest.mark.parametrize('gauges', CASES, ids=IDS)
def test_the_stacked_cost_is_that_of_the_elements(fleets, gauges):
    submaps, association, elements, cost = case(fleets, gauges)
    points = merged(submaps, association, cost).points
    rng = np.random.default_rng(0)
    points = cost.recover_private(points, association.count)
    points += 0.01 * np.abs(points).max() * rng.normal(size=points.shape)
    state = cost.evaluate(points)
    placements = [element.place(points) for element in elements]
    plain = sum(np.sum(e.residuals(p) ** 2) for e, p in zip(elements, placements, strict=True))
    assert state.cost == pytest.approx(plain, rel=1e-12)
    _, gradient = assemble(elements, placements, points.size)
    np.testing.assert_allclose(
        gradient_of(cost, state).ravel(), gradient, atol=1e-10 * np.abs(gradient).max()
    )
    own = gauss_newton(cost, state)
    for k, (element, placement) in enumerate(zip(elements, placements, strict=True)):
        wanted = element.derivatives(placement)[0]
        order = rng.permutation(len(element.tracks))
        found = np.zeros(wanted.shape, order='F')
        own(k, order, found)
        at = coordinates(order)
        np.testing.assert_allclose(
            found, np.tril(wanted[np.ix_(at, at)]), atol=1e-10 * np.abs(wanted).max()
        )


@pytest.mark.parametrize('gauges', CASES, ids=IDS)
def test_the_fast_merge_is_the_plain_merge(fleets, gauges):
    submaps, association, elements, cost = case(fleets, gauges)
    found, state = at_optimum(submaps, association, cost)
    slots = np.cumsum(association.views > 1) - 1
    reduced = [element.reduced() for element in elements]
    reduced = [replace(element, tracks=slots[element.tracks]) for element in reduced]
    gauge = Gauge(int(cost.gauges.min()))
    start = found.points + 1e-3 * np.random.default_rng(1).normal(size=found.points.shape)
    plain = merge(reduced, start, gauge, CONFIG)
    assert found.cost == pytest.approx(plain.cost, rel=1e-9)
    moved = align(plain.points, found.points, gauge=gauge).S_target_source.apply(found.points)
    # Both end at 1e-6 standard deviations of everything together.
    blocks = uncertainty(cost, state, gauge, 0.5).landmarks[association.views > 1]
    stds = np.sqrt(np.einsum('nii->n', blocks))
    assert (np.linalg.norm(moved - plain.points, axis=1) < 1e-5 * stds).all()


@pytest.mark.parametrize('gauges', CASES, ids=IDS)
def test_what_it_knows_is_what_the_dense_inverse_says(fleets, gauges):
    submaps, association, elements, cost = case(fleets, gauges)
    _, state = at_optimum(submaps, association, cost)
    gauge = Gauge(int(cost.gauges.min()))
    placements = [element.place(state.points) for element in elements]
    normal = normal_equations(elements, state.points, placements, gauge)
    covariance = normal.covariance(0.5)
    found = uncertainty(cost, state, gauge, 0.5)
    every = np.arange(len(state.points))
    blocks = covariance.reshape(len(every), 3, len(every), 3)[every, :, every, :]
    scale = np.abs(blocks).max(axis=(1, 2))[:, None, None]
    np.testing.assert_allclose(found.landmarks / scale, blocks / scale, atol=1e-6)
    for k, (element, placement) in enumerate(zip(elements, placements, strict=True)):
        wanted = frame_covariance(element, placement, covariance)
        tolerance = 1e-6 * max(np.abs(wanted).max(), 1e-30)
        np.testing.assert_allclose(found.frames[k], wanted, atol=tolerance)
    keep = np.random.default_rng(2).random(len(every)) < 0.3
    left, wanted = schur_complement(cost, state, keep, gauge), normal.without(~keep)
    size = np.abs(wanted.information).max()
    np.testing.assert_allclose(left.information / size, wanted.information / size, atol=1e-10)
    (r, c), (plain_r, plain_c) = left.triangle(), wanted.triangle()
    np.testing.assert_allclose(r.T @ r / size, plain_r.T @ plain_r / size, atol=1e-9)
    np.testing.assert_allclose(np.abs(c), np.abs(plain_c), atol=1e-4)


@pytest.mark.parametrize('gauges', CASES, ids=IDS)
def test_the_factor_that_is_kept_is_the_matrix_of_the_shared_landmarks(fleets, gauges):
    """Of all landmarks, in float32: restricted to the shared ones it inverts their plain sum."""
    submaps, association, elements, cost = case(fleets, gauges)
    found, state = at_optimum(submaps, association, cost)
    gauge = Gauge(int(cost.gauges.min()))
    shared = np.flatnonzero(association.views > 1)
    points, slots = found.points, np.cumsum(association.views > 1) - 1
    matrix = np.zeros((points.size, points.size))
    for element in elements:
        reduced = element.reduced()
        reduced = replace(reduced, tracks=slots[reduced.tracks])
        at = coordinates(reduced.tracks)
        matrix[np.ix_(at, at)] += reduced.derivatives(reduced.place(points))[0]
    # The whole is held in the factor, so what would move it has no answer.
    null = gauge_basis(points, gauge)
    wanted = np.random.default_rng(3).normal(size=points.size)
    wanted -= null @ (null.T @ wanted)
    carried = Carried(uncertainty(cost, state, gauge, 0.5).factor, shared)
    solved = carried.solve(matrix @ wanted)
    solved -= null @ (null.T @ solved)
    assert carried.factor.storage.dtype == np.float32
    np.testing.assert_allclose(solved, wanted, atol=0.02 * np.abs(wanted).max())


@pytest.mark.parametrize('gauges', CASES, ids=IDS)
def test_a_state_in_another_frame_is_that_of_the_moved_landmarks(fleets, gauges):
    submaps, association, _, cost = case(fleets, gauges)
    points = cost.recover_private(merged(submaps, association, cost).points, association.count)
    gauge = min(submap.gauge for submap in submaps)
    S_new_global = random_similarity(np.random.default_rng(4), gauge)
    wanted, found = (
        cost.evaluate(S_new_global.apply(points)),
        cost.evaluate(points).after(S_new_global),
    )
    assert found.cost == pytest.approx(wanted.cost, rel=1e-7)
    for name in ('points', 'moved', 'moments', 'stretches', 'centres'):
        np.testing.assert_allclose(getattr(found, name), getattr(wanted, name), atol=1e-7)
    scale = np.abs(wanted.slopes).max()
    np.testing.assert_allclose(found.slopes, wanted.slopes, atol=1e-6 * scale)
    frames, others = found.S_map_globals, wanted.S_map_globals
    np.testing.assert_allclose(frames.linear(), others.linear(), atol=1e-8)
    np.testing.assert_allclose(frames.translations, others.translations, atol=1e-7)


def test_a_factor_kept_in_float32_still_is_one_of_a_positive_definite_matrix(fleets):
    """Kept in half the memory it answers alike, in the softest direction too."""
    submaps, association, _, cost = case(fleets, CASES[0])
    reduced = cost.reduced()
    state = reduced.evaluate(merged(submaps, association, cost).points)
    fronts, elements = plan(reduced, state.points), gauss_newton(reduced, state, Gauge.SIMILARITY)
    exact, rounded = (factorise(fronts, elements, dtype=kind) for kind in (np.float64, np.float32))
    assert rounded.storage.nbytes == exact.storage.nbytes // 2
    softest = np.random.default_rng(0).normal(size=fronts.size)
    for _ in range(5):
        softest = exact.solve(softest / np.linalg.norm(softest))
    right = softest / np.linalg.norm(softest)
    wanted, found = exact.solve(right), rounded.solve(right)
    assert np.linalg.norm(found - wanted) < 0.05 * np.linalg.norm(wanted)
    assert right @ found > 0.0


def test_a_landmark_that_nothing_determines_is_said_so(fleets):
    submaps, association, _, cost = case(fleets, CASES[0])
    _, state = at_optimum(submaps, association, cost)
    blind = []
    for root in cost.roots:
        r = root.dense()
        r[:, :3] = 0.0
        blind.append(replace(root, packed=pack(r)))
    with pytest.raises(DegenerateGeometry):
        uncertainty(replace(cost, roots=tuple(blind)), state, Gauge.SIMILARITY, 0.5)


@pytest.mark.parametrize('gauge', GAUGES)
@pytest.mark.parametrize('scale', ['least_squares', 'tangent'])
def test_many_alignments_at_once_are_the_single_ones(gauge, scale):
    rng = np.random.default_rng(6)
    lengths = [4, 9, 25, 2]
    segments = Segments.of_lengths(lengths)
    source = rng.normal(size=(sum(lengths), 3))
    moves = [random_similarity(rng, gauge) for _ in lengths]
    target = np.concatenate(
        [S.apply(source[segments.rows(k)]) for k, S in enumerate(moves)]
    ) + 0.01 * rng.normal(size=source.shape)
    weights = rng.random(len(source)) + 0.1
    gauges = np.full(len(lengths), int(gauge))
    found = align_segments(target, source, segments, gauges, weights, scale)
    robust = align_segments_robustly(target, source, segments, gauges, weights)
    for k in range(len(lengths)):
        rows = segments.rows(k)
        given = {'gauge': gauge, 'weights': weights[rows]}
        if lengths[k] < gauge.minimal_points:
            assert not found.determined[k]
            continue
        plain = align(target[rows], source[rows], scale=scale, **given).S_target_source
        np.testing.assert_allclose(found.S_target_source[k].log(), plain.log(), atol=1e-10)
        plain = align_robustly(target[rows], source[rows], **given).S_target_source
        np.testing.assert_allclose(robust.S_target_source[k].log(), plain.log(), atol=1e-9)


@pytest.mark.parametrize('gauges', CASES, ids=IDS)
def test_all_links_at_once_are_the_single_links(fleets, gauges):
    submaps, association, _, _ = case(fleets, gauges)
    weights = [alignment_weights(submap.triangle()) for submap in submaps]
    links = find_links(submaps, association, CONFIG)
    assert len(links) > 6
    for link in links:
        plain = link_pair(submaps, association, weights, (link.a, link.b), CONFIG)
        assert (link.shared, link.reason) == (plain.shared, plain.reason)
        np.testing.assert_array_equal(link.contradicting, plain.contradicting)
        if plain.S_a_b is not None:
            # One stops when it has settled, which leaves a share of the landmarks' distance.
            points = submaps[link.b].compressed_points
            moved, expected = link.S_a_b.apply(points), plain.S_a_b.apply(points)
            across = plain.turn.std_rad * np.linalg.norm(np.std(expected, axis=0))
            assert np.median(np.linalg.norm(moved - expected, axis=1)) < 0.3 * across
            assert link.turn.std_rad == pytest.approx(plain.turn.std_rad, rel=0.3)
            assert abs(link.turn.axis_a @ plain.turn.axis_a) == pytest.approx(1.0, abs=1e-6)


def test_a_plan_holds_the_kept_landmarks_at_the_root(fleets):
    submaps, association, _, cost = case(fleets, CASES[0])
    points = cost.recover_private(merged(submaps, association, cost).points, association.count)
    keep = np.arange(len(points)) % 4 == 0
    root = plan(cost, points, keep).fronts[-1]
    kept = (3 * np.flatnonzero(keep)[:, None] + np.arange(3)).ravel()
    np.testing.assert_array_equal(np.sort(root.rows), kept)
    assert root.eliminated == len(kept)


@pytest.mark.parametrize('count', [1, 3])
def test_what_fits_exactly_is_known_to_fit(fleets, count):
    """Maps that agree but for rounding: nothing is left to gain, however long one looks."""
    one = fleets[Gauge.SIMILARITY][0]
    submaps = [replace(one, map_id=str(k), c=np.zeros_like(one.c)) for k in range(count)]
    association = associate_by_id(submaps)
    is_shared = np.ones(association.count, bool)
    cost = JointCost.of(
        submaps, association.tracks, is_shared, np.ones(count), informations(submaps)
    )
    rng = np.random.default_rng(5)
    start = random_similarity(rng).apply(one.compressed_points)
    found = minimise(cost, start, Gauge.SIMILARITY, CONFIG)
    assert found.converged
    assert found.iterations < 8
