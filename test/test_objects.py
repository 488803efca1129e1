# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Objects that moved and turned, and single landmarks that are off."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.stats
from gaussian_merges import draw, merged, noise, scene
from scipy.spatial.transform import Rotation

from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.fusion.confirm import BORDER, members_of
from mapmerge_ros.fusion.contrasts import contrasts
from mapmerge_ros.fusion.honest import examine
from mapmerge_ros.fusion.local import local_tests, sensitivity
from mapmerge_ros.fusion.motion import rigid_motion
from mapmerge_ros.fusion.objects import (
    LEAST_STATISTIC,
    MIN_MEMBERS,
    common_motion,
    find_objects,
    released,
)
from mapmerge_ros.fusion.patches import RIGID, TRANSLATION, Patch


def neighbours(rng, points, members, k, count):
    """Members of sub-map k about one of its landmarks that is not at the edge."""
    own = np.flatnonzero(members.maps == k)
    here = points[members.tracks[own]]
    centre = here[rng.choice(np.flatnonzero(np.linalg.norm(here / [30, 20, 2], axis=1) < 1.0))]
    return np.sort(own[np.argsort(np.linalg.norm(here - centre, axis=1))[:count]])


def with_object(rng, size, turn_rad, landmarks=120, count=10):
    """A merge in which ten neighbours of map 2 moved by `size` typical deviations and turned."""
    points, members, matrices = scene(rng, landmarks=landmarks, views=(3, 4))
    errors = noise(rng, points, members, matrices)
    unit = contrasts(merged(points, members, matrices, errors), 600).unit
    moved = neighbours(rng, points, members, 2, count)
    axis, shift = rng.normal(size=(2, 3))
    shift *= size * unit / np.linalg.norm(shift)
    turn = Rotation.from_rotvec(turn_rad * axis / np.linalg.norm(axis))
    before = points[members.tracks[moved]]
    centre = before.mean(axis=0)
    errors[moved] += turn.apply(before - centre) + centre + shift - before
    return merged(points, members, matrices, errors), moved, (centre, turn, shift)


def chi2_of(motion, truth):
    """Square of the motion's error over its own covariance, 6 degrees of freedom."""
    centre, turn, shift = truth
    at_centre = turn.apply(motion.centre - centre) + centre + shift - motion.centre
    turned = turn * Rotation.from_rotvec(motion.rotation_vector).inv()
    error = np.concatenate([turned.as_rotvec(), at_centre - motion.translation])
    return float(error @ np.linalg.solve(motion.covariance, error))


@pytest.mark.parametrize('motion', [TRANSLATION, RIGID])
def test_trials_at_once_are_those_one_by_one(motion):
    merge = draw(1, landmarks=60, views=(3, 4))
    state = sensitivity(merge)
    patch = Patch.of_map(state, merge.points, 1)
    inside, outside = np.arange(4, 12), np.array([1, 20, 30])
    more = patch.with_one_more(inside, outside, motion)
    less = patch.with_one_less(inside, motion)
    free = patch.with_one_free(inside, motion)
    for value, row in zip(more, outside, strict=True):
        assert value == pytest.approx(patch.statistic(np.append(inside, row), motion), rel=1e-6)
    for at, row in enumerate(inside):
        others = np.delete(inside, at)
        assert less[at] == pytest.approx(patch.statistic(others, motion), rel=1e-6)
        rest = state.unlock(patch.members[[row]])
        again = Patch.of_map(rest, merge.points, 1)
        rows = again.rows(patch.members[others])
        assert free[at] == pytest.approx(again.statistic(rows, motion), rel=1e-5)


@pytest.mark.parametrize('motion', [TRANSLATION, RIGID])
def test_who_does_not_take_part_does_not_matter(motion):
    """Some rows of a patch alone, members free or not: what the whole patch says of them."""
    merge = draw(1, landmarks=60, views=(3, 4))
    patch = Patch.of_map(sensitivity(merge), merge.points, 1)
    inside = np.array([2, 3, 5, 8, 13, 21, 30, 34])
    alone, everyone = patch.only(inside), np.arange(len(inside))
    for name in ('statistic', 'with_one_less', 'with_one_free', 'without_loudest'):
        whole = getattr(patch, name)(inside, motion)
        np.testing.assert_allclose(getattr(alone, name)(everyone, motion), whole, rtol=1e-9)


@pytest.mark.parametrize('motion', [TRANSLATION, RIGID])
def test_the_loudest_are_freed_as_if_one_by_one(motion):
    merge = draw(1, landmarks=60, views=(3, 4))
    state = sensitivity(merge)
    patch = Patch.of_map(state, merge.points, 1)
    inside = np.array([2, 3, 5, 8, 13, 21, 30, 34])
    found = patch.without_loudest(inside, motion)
    members = patch.members[inside]
    for _ in range(2):
        free = patch.with_one_free(patch.rows(members), motion)
        loudest = int(np.argmin(free))
        state = state.unlock(members[[loudest]])
        members = np.delete(members, loudest)
        patch = Patch.of_map(state, merge.points, 1)
    assert found == pytest.approx(patch.statistic(patch.rows(members), motion), rel=1e-5)


def test_a_motion_that_nothing_holds_is_refused():
    merge = draw(1, landmarks=60, views=(3, 4))
    patch = Patch.of_map(sensitivity(merge), merge.points, 1)
    loose = replace(patch, information=np.zeros_like(patch.information))
    with pytest.raises(np.linalg.LinAlgError):
        loose.statistic(np.arange(8), TRANSLATION)


def test_all_neighbourhoods_at_once_are_those_one_by_one():
    merge = draw(1, landmarks=60, views=(3, 4))
    patch = Patch.of_map(sensitivity(merge), merge.points, 1)
    motions = (TRANSLATION, RIGID)
    statistics, rows = patch.neighbourhoods(8, motions)
    for motion, each in zip(motions, statistics, strict=True):
        for at in range(0, len(patch), 7):
            assert rows[at, 0] == at
            alone = patch.with_one_free(np.sort(rows[at]), motion).min()
            assert each[at] == pytest.approx(alone, rel=1e-6)


def test_one_gross_error_is_no_object_of_those_that_it_pulls_along():
    rng = np.random.default_rng(8)
    points, members, matrices = scene(rng, landmarks=120, views=(2, 2))
    errors = noise(rng, points, members, matrices)
    unit = contrasts(merged(points, members, matrices, errors), 600).unit
    wrong = int(rng.choice(len(members)))
    errors[wrong] += 200.0 * unit * np.array([0.6, 0.8, 0.0])
    merge = merged(points, members, matrices, errors)
    state = sensitivity(merge)
    assert not find_objects(state, merge.points, LEAST_STATISTIC)
    assert np.max(state.tests().statistic) > 1000.0


@pytest.mark.parametrize(('seed', 'size'), [(1, 300.0), (4, 30.0), (8, 300.0)])
def test_what_nothing_else_would_hold_is_no_object(seed, size):
    """A map of which all is wrong: the search ends where the rest would hang in the air."""
    rng = np.random.default_rng(seed)
    points, members, matrices = scene(rng, landmarks=24, views=(2, 2))
    errors = noise(rng, points, members, matrices)
    unit = contrasts(merged(points, members, matrices, errors), 600).unit
    all_of_one = members.maps == 1
    errors[all_of_one] += size * unit * rng.normal(size=(all_of_one.sum(), 3))
    merge = merged(points, members, matrices, errors)
    state = sensitivity(merge)
    found = find_objects(state, merge.points, LEAST_STATISTIC)
    state.unlock(members_of(found))  # determined
    with pytest.raises(DegenerateGeometry):
        state.unlock(np.flatnonzero(all_of_one))


@pytest.mark.parametrize('motion', [TRANSLATION, RIGID])
def test_a_common_motion_of_nobody_is_chi_square(motion):
    rng, values = np.random.default_rng(2), []
    for _ in range(60):
        points, members, matrices = scene(rng, landmarks=40, views=(3, 4))
        errors = noise(rng, points, members, matrices)
        merge = merged(points, members, matrices, errors)
        patch = Patch.of_map(sensitivity(merge), points, 0)
        values += [patch.statistic(np.arange(at, at + 8), motion) for at in (0, 15)]
    assert scipy.stats.kstest(values, scipy.stats.chi2(motion).cdf).pvalue > 0.01


def test_an_object_that_moved_and_turned_is_recovered_within_its_own_claim():
    rng, inside, whole, squares = np.random.default_rng(3), 0, 0, []
    for _ in range(20):
        merge, moved, truth = with_object(rng, 10.0, 0.05)
        found = examine(merge, np.inf, certain=True)
        members = [each.members for each in found.objects]
        if len(members) == 1 and np.isin(moved, members[0]).all():
            whole += 1
            squares.append(chi2_of(found.objects[0].motion, truth))
            inside += squares[-1] <= scipy.stats.chi2.isf(2.7e-3, 6)
        assert not np.isin(found.doubtful, moved).any() or len(members) == 0
    assert whole >= 19
    assert inside >= whole - 1
    assert 3.0 < np.median(squares) < 9.0


def test_every_member_of_an_object_has_its_own_displacement_and_covariance():
    rng, squares, spread = np.random.default_rng(11), [], []
    for _ in range(30):
        merge, moved, (centre, turn, shift) = with_object(rng, 10.0, 0.05)
        state = sensitivity(merge)
        displacements, covariances = rigid_motion(state, merge.points, moved).of_members()
        before = merge.points[merge.members.tracks[moved]] - centre
        errors = displacements - (turn.apply(before) - before + shift)
        squares.append(
            np.einsum('mi,mi->m', errors, np.linalg.solve(covariances, errors[..., None])[..., 0])
        )
        spread.append(np.ptp(np.trace(covariances, axis1=1, axis2=2)))
    assert min(spread) > 0.0
    assert 2.5 < np.mean(squares) < 3.6


def test_a_turn_that_displaces_nothing_on_average_is_found():
    rng, found = np.random.default_rng(4), 0
    for _ in range(8):
        merge, moved, _ = with_object(rng, 0.0, 0.3, count=12)
        objects = examine(merge, np.inf, certain=True).objects
        found += len(objects) == 1 and np.isin(moved, objects[0].members).mean() > 0.6
    assert found >= 7


def test_large_turns_are_not_linearised():
    """The exact motion of noise-free landmarks, turned by half a radian."""
    rng = np.random.default_rng(5)
    points, members, matrices = scene(rng, landmarks=60, views=(3, 4))
    moved = neighbours(rng, points, members, 1, 8)
    before = points[members.tracks[moved]]
    turn, shift = Rotation.from_rotvec([0.3, -0.4, 0.1]), np.array([0.5, 0.2, -0.1])
    errors = np.zeros((len(members), 3))
    errors[moved] = turn.apply(before - before.mean(axis=0)) + before.mean(axis=0) + shift - before
    merge = merged(points, members, matrices, errors)
    # the optimum, not the truth, is what a merge knows
    motion = rigid_motion(sensitivity(merge), points, moved)
    assert motion.is_turned
    np.testing.assert_allclose(motion.rotation_vector, turn.as_rotvec(), atol=0.05)


def test_few_landmarks_have_a_translation_only():
    merge, moved, _ = with_object(np.random.default_rng(6), 20.0, 0.0)
    motion = common_motion(sensitivity(merge), merge.points, moved[:3]).motion
    assert not motion.is_turned
    assert not motion.rotation_vector.any()
    assert (np.diag(motion.covariance)[3:] > 0.0).all()


def test_an_object_of_two_maps_is_ambiguous():
    rng = np.random.default_rng(7)
    points, members, matrices = scene(rng, maps=2, landmarks=100, views=(2, 2))
    errors = noise(rng, points, members, matrices)
    moved = neighbours(rng, points, members, 1, 12)
    unit = contrasts(merged(points, members, matrices, errors), 600).unit
    errors[moved] += [12.0 * unit, 0.0, 0.0]
    found = examine(merged(points, members, matrices, errors), np.inf, certain=True)
    assert [each.ambiguous for each in found.objects] == [True]
    named = members.tracks[found.objects[0].members]
    assert np.isin(members.tracks[moved], named).mean() > 0.9


def test_single_landmarks_are_doubtful_and_hardly_any_other():
    """3 of 30 landmarks of one map moved by 6 standard deviations, Gaussian noise, 40 merges."""
    rng, found, false = np.random.default_rng(8), 0, 0
    for _ in range(40):
        points, members, matrices = scene(rng, landmarks=30, views=(2, 4))
        errors = noise(rng, points, members, matrices)
        tests = local_tests(merged(points, members, matrices, errors))
        moved = rng.choice(np.flatnonzero((members.maps == 1) & tests.testable), 3, replace=False)
        direction = rng.normal(size=(3, 3))
        direction /= np.linalg.norm(direction, axis=1)[:, None]
        roots = np.linalg.cholesky(tests.covariance[moved])
        errors[moved] += 6.0 * np.einsum('sij,sj->si', roots, direction)
        result = examine(merged(points, members, matrices, errors), np.inf, certain=True)
        named = [result.doubtful, *(each.members for each in result.objects)]
        tracks = members.tracks[np.concatenate(named)]
        found += np.isin(members.tracks[moved], tracks).sum()
        false += (~np.isin(tracks, members.tracks[moved])).sum()
    assert found >= 0.95 * 120
    assert false <= 0.01 * 40 * 27


def test_nobody_is_doubtful_where_nothing_moved():
    reported = [
        len(examine(draw(200 + seed, landmarks=50), np.inf, certain=True).doubtful)
        for seed in range(40)
    ]
    assert np.mean(np.array(reported) > 0) <= 0.1


def quadratic_field(rng, here, size):
    """A random bend (n, 3), quadratic in the coordinates."""
    scaled = (here - here.mean(axis=0)) / here.std()
    first, second = np.triu_indices(3)
    return size * (scaled[:, first] * scaled[:, second]) @ rng.normal(size=(6, 3))


def test_a_bend_of_any_size_costs_nothing_where_bends_are_free():
    rng = np.random.default_rng(12)
    points, members, matrices = scene(rng, landmarks=60, views=(3, 4))
    errors = noise(rng, points, members, matrices)
    part = members.of_map(1)
    bend = np.zeros_like(errors)
    bend[part] = quadratic_field(rng, points[members.tracks[part]], 2.0)
    states = [
        sensitivity(merged(points, members, matrices, errors + added)) for added in (0.0, bend)
    ]
    plain, bent = (Patch.of_map(state, points, 1) for state in states)
    edge = np.argsort(plain.points[:, 0])[:10]
    for motion in (TRANSLATION, RIGID):
        assert bent.statistic(edge, motion) > 100.0 * plain.statistic(edge, motion)
        expected = plain.unbent().statistic(edge, motion)
        assert bent.unbent().statistic(edge, motion) == pytest.approx(expected, rel=1e-4)


def test_a_common_motion_of_nobody_is_chi_square_where_bends_are_free():
    rng, values = np.random.default_rng(13), []
    for _ in range(60):
        points, members, matrices = scene(rng, landmarks=40, views=(3, 4))
        errors = noise(rng, points, members, matrices)
        merge = merged(points, members, matrices, errors)
        patch = Patch.of_map(sensitivity(merge), points, 0).unbent()
        values += [patch.statistic(np.arange(at, at + 8), TRANSLATION) for at in (0, 15)]
    assert scipy.stats.kstest(values, scipy.stats.chi2(TRANSLATION).cdf).pvalue > 0.01


def test_what_moved_is_seen_where_bends_are_free():
    merge, moved, _ = with_object(np.random.default_rng(14), 20.0, 0.0)
    found = common_motion(sensitivity(merge), merge.points, moved)
    assert 40.0 < found.unbent <= found.without_loudest * 1.001


def test_neighbours_are_together_and_a_choice_of_landmarks_is_not():
    rng = np.random.default_rng(15)
    merge = draw(15, landmarks=120, views=(3, 4))
    patch, shares = Patch.of_map(sensitivity(merge), merge.points, 0), []
    for _ in range(20):
        centre = patch.points[rng.integers(len(patch))]
        near = np.argsort(np.linalg.norm(patch.points - centre, axis=1))[:12]
        shares.append(patch.togetherness(np.sort(near), 4))
        picked = np.sort(rng.choice(len(patch), len(patch) // 4, replace=False))
        assert patch.togetherness(picked, 4) < 0.5
    assert min(shares) > 0.5
    assert np.mean(np.array(shares) > 1.0 - BORDER / np.sqrt(12.0)) > 0.8


def test_a_bystander_of_a_small_object_is_given_back():
    for seed in range(5):
        merge, moved, _ = with_object(np.random.default_rng(seed), 20.0, 0.0, count=4)
        state = sensitivity(merge)
        own = np.flatnonzero(merge.members.maps == 2)
        still = np.setdiff1d(own, moved)[3]
        five = common_motion(state, merge.points, np.sort(np.append(moved, still)))
        assert len(five.members) == MIN_MEMBERS
        fewer = released(state, merge.points, five, 1.0)
        np.testing.assert_array_equal(fewer.members, moved)
        merge, moved, _ = with_object(np.random.default_rng(seed), 20.0, 0.0, count=5)
        whole = common_motion(sensitivity(merge), merge.points, moved)
        assert released(sensitivity(merge), merge.points, whole, 1.0) is whole
