# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A merge examined again, with the errors that it had before something was taken out."""

import numpy as np
import pytest
from gaussian_merges import merged, noise, scene

from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.fusion import honest
from mapmerge_ros.fusion.contrasts import contrasts
from mapmerge_ros.fusion.covariance_model import fit_model
from mapmerge_ros.fusion.honest import MAX_CONTRASTS, examine
from mapmerge_ros.fusion.local import local_tests
from mapmerge_ros.fusion.objects import MIN_MEMBERS
from mapmerge_ros.fusion.plausible import largest_variances, p_plausible
from mapmerge_ros.fusion.quadratic import Members

NOBODY = np.zeros(0, np.int64)


def test_what_moved_is_looked_for_among_all_tracks_where_a_sample_is_tested():
    """710 contrasts, of which every second is tested: half of six landmarks would be no object."""
    rng = np.random.default_rng(1)
    points, members, matrices = scene(rng, maps=3, landmarks=355, views=(3, 3))
    errors = np.sqrt(1.5) * noise(rng, points, members, matrices)
    some = contrasts(merged(points, members, matrices, errors), 150)
    known = fit_model(some, largest_variances(some), NOBODY).model
    own = np.flatnonzero(members.maps == 1)
    near = np.argsort(np.linalg.norm(points[members.tracks[own]] - points[0], axis=1))
    moved = np.sort(own[near[:12:2]])
    errors[moved] += [2.0, 0.0, 2.5]
    merge = merged(points, members, matrices, errors)
    assert len(members) - len(points) > MAX_CONTRASTS
    tested = contrasts(merge, MAX_CONTRASTS).owners
    assert np.isin(members.tracks[moved], tested).sum() < MIN_MEMBERS
    found = examine(merge, np.inf, certain=True, known=known)
    assert [each.members.tolist() for each in found.objects] == [moved.tolist()]


@pytest.mark.parametrize('fails', [False, True])
def test_what_moved_is_told_though_the_known_errors_are_not_believed(monkeypatch, fails):
    """The geometry is not certain, or no covariance describes the merge: as without a model."""
    rng = np.random.default_rng(6)
    points, members, matrices = scene(rng, landmarks=120, views=(3, 4))
    errors = np.sqrt(2.0) * noise(rng, points, members, matrices)
    known = examine(merged(points, members, matrices, errors), np.inf, certain=True).model
    assert not known.is_textbook
    own = np.flatnonzero(members.maps == 2)
    near = np.argsort(np.linalg.norm(points[members.tracks[own]] - points[0], axis=1))
    errors[own[near[:12]]] += [2.0, 0.0, 2.5]
    merge = merged(points, members, matrices, errors)

    def failing(*_):
        raise DegenerateGeometry('no definite covariance')

    if fails:
        monkeypatch.setattr(honest, '_under_model', failing)
    expected, found = (
        [each.members.tolist() for each in examine(merge, np.inf, certain=fails, known=x).objects]
        for x in (None, known)
    )
    assert len(expected[0]) >= 11
    assert found == expected


def without(points, members, matrices, errors, tracks):
    """The same sub-maps with some landmarks unmatched: marginalised, each for itself."""
    kept_tracks = np.setdiff1d(np.arange(len(points)), tracks)
    kept = np.isin(members.tracks, kept_tracks)
    left = []
    for k, matrix in enumerate(matrices):
        inside = np.repeat(kept[members.of_map(k)], 3)
        across = matrix[np.ix_(inside, ~inside)]
        own = matrix[np.ix_(~inside, ~inside)]
        left.append(matrix[np.ix_(inside, inside)] - across @ np.linalg.solve(own, across.T))
    counts = [int(kept[members.of_map(k)].sum()) for k in range(len(matrices))]
    rest = Members(
        members.maps[kept],
        np.concatenate([np.arange(count) for count in counts]),
        np.searchsorted(kept_tracks, members.tracks[kept]),
    )
    return merged(points[kept_tracks], rest, left, errors[kept])


def test_who_is_left_is_judged_by_the_errors_of_all():
    """Without the worst landmarks a fit sees thin tails, and takes the next worst for wrong."""
    rng, afresh, judged = np.random.default_rng(10), 0, 0
    for _ in range(4):
        points, members, matrices = scene(rng, landmarks=100)
        errors = noise(rng, points, members, matrices)
        errors *= 1.0 / np.sqrt(rng.chisquare(3, len(members)) / 3.0)[:, None]
        found = examine(merged(points, members, matrices, errors), np.inf, certain=True)
        rest = without(points, members, matrices, errors, members.tracks[found.aside])
        again = examine(rest, np.inf, certain=True)
        known = examine(rest, np.inf, certain=True, known=found.model)
        assert found.model is not None
        assert known.model.tails == found.model.tails
        assert known.p_value > 0.01
        afresh += len(again.aside)
        judged += len(known.aside)
    assert judged < 0.5 * afresh


@pytest.mark.parametrize('most', [MAX_CONTRASTS, 150])
def test_what_was_taken_out_since_it_did_not_fit_has_still_to_be_believed(monkeypatch, most):
    """22 % of the landmarks far off, and twice the variance: not plausible, in no round."""
    shares = []

    def plausible(phi, omega_radii, aside, count):
        shares.append(aside / count)
        return p_plausible(phi, omega_radii, aside, count)

    monkeypatch.setattr(honest, 'p_plausible', plausible)
    monkeypatch.setattr(honest, 'MAX_CONTRASTS', most)
    rng = np.random.default_rng(12)
    points, members, matrices = scene(rng, landmarks=300, views=(2, 2))
    errors = np.sqrt(2.0) * noise(rng, points, members, matrices)
    spread = local_tests(merged(points, members, matrices, errors)).covariance
    _, firsts = np.unique(members.tracks, return_index=True)
    wrong = rng.choice(firsts, 66, replace=False)
    sizes = np.sqrt(np.trace(spread[wrong], axis1=1, axis2=2))
    errors[wrong] += 10.0 * sizes[:, None] * rng.normal(size=(66, 3))
    found = examine(merged(points, members, matrices, errors), np.inf, certain=True)
    gone = members.tracks[found.aside]
    rest = without(points, members, matrices, errors, gone)
    again = examine(rest, np.inf, certain=True, known=found.model, taken_out=len(gone))
    assert found.p_value < 0.01
    assert again.p_value < 0.01
    # Of a sample, what is left in the other tracks is as wrong as its own was.
    np.testing.assert_allclose(shares, 0.22, atol=0.035)
    assert examine(rest, np.inf, certain=True, known=found.model).p_value > 0.01
