# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What a merge claims to know, where its region is an ellipsoid and where it is bent."""

import numpy as np
import pytest

pytest.importorskip('pycolmap')

from mapmerge_ros.experiments.region import reported_p
from mapmerge_ros.experiments.room import SIGMA, WIDTHS, simulate_room, true_points
from mapmerge_ros.fusion import FusionConfig, fuse, valley
from mapmerge_ros.geometry import gauge_basis
from mapmerge_ros.submap import alignment_weights


def outgoing(run, scene):
    rng = np.random.default_rng([0, run, list(WIDTHS).index(scene)])
    fleet = simulate_room(rng, WIDTHS[scene])
    submaps = fleet.submaps(catalogue=False)
    merged = fuse(submaps).global_map
    return submaps, merged, true_points(fleet.truth.scene, merged.compressed_ids)


@pytest.fixture
def straight(monkeypatch):
    """Return what the same merge would say if its region were an ellipsoid."""

    def fused(submaps):
        with monkeypatch.context() as patch:
            patch.setattr(valley, 'LOOSE_TURN_RAD', np.inf)
            return fuse(submaps).global_map

    return fused


@pytest.mark.parametrize('run', [35, 40, 65])
def test_a_bent_region_holds_the_truth_that_its_ellipsoid_misses(run, straight):
    submaps, merged, truth = outgoing(run, 'narrow')
    assert reported_p(straight(submaps), truth, SIGMA) < 1e-4
    assert reported_p(merged, truth, SIGMA) > 0.01


def test_a_bent_region_moves_nothing_and_never_claims_more(straight):
    submaps, merged, _ = outgoing(35, 'narrow')
    before = straight(submaps)
    assert np.allclose(merged.points, before.points, atol=1e-12)
    wide, narrow = (m.triangle().T @ m.triangle() for m in (merged, before))
    least = np.linalg.eigvalsh(narrow - wide)[0]
    assert least > -1e-6 * np.linalg.eigvalsh(narrow)[-1]
    null = gauge_basis(merged.compressed_points, merged.gauge)
    assert np.abs(merged.triangle() @ null).max() < 1e-6 * np.abs(merged.triangle()).max()
    assert (alignment_weights(merged.triangle()) > 0.0).all()


def test_a_well_determined_merge_pays_nothing(straight):
    submaps, merged, truth = outgoing(0, 'wide')
    assert np.array_equal(merged.packed_r, straight(submaps).packed_r)
    assert reported_p(merged, truth, SIGMA) > 0.01


def test_a_refusal_says_whose_rotation_is_open() -> None:
    """A wrong basin from one start: what errors of real maps would explain is not asked."""
    room = simulate_room(np.random.default_rng([5, 27]), 0.1)
    verdict = fuse(room.submaps(), FusionConfig(max_starts=1)).verdict
    assert not verdict.accepted
    assert verdict.errors is None
    assert verdict.reason.endswith(
        'the rotation of map2, map3 and map4 among the others is known to no better than '
        '0.1 rad, so a wrong place is not told from errors of the maps'
    )
