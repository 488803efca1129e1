# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What moved is found among a thousand shared landmarks as it is among a hundred."""

import numpy as np
import pytest

pytest.importorskip('pycolmap', reason='simulated maps are bundled by Ceres: pip install pycolmap')

from mapmerge_ros.fusion import Kind, fuse
from mapmerge_ros.fusion.honest import MAX_TRACKS, is_large
from mapmerge_ros.simulation import FleetConfig, simulate_fleet


def test_an_object_is_found_in_a_merge_beyond_dense_algebra():
    fleet = simulate_fleet(FleetConfig(drones=9, landmarks=300, keyframes=24, moved=1), 500)
    fusion = fuse(fleet.submaps(catalogue=False))
    component = fusion.components[0]
    views = np.bincount(component.landmarks.member_rows)
    assert (views > 1).sum() > MAX_TRACKS
    assert component.verdict.accepted
    moved = [change for change in fusion.changes if change.kind is Kind.MOVED]
    assert {change.object_id for change in moved} == {1}
    assert {change.landmark_id for change in moved} == set(
        fleet.truth.moved[0].landmark_ids.tolist()
    )
    tests = component.examination.textbook_tests
    assert tests is not None
    assert tests.distinct.sum() > MAX_TRACKS


def test_fleets_that_share_borders_are_tested_and_thousands_in_common_are_not():
    assert not is_large(np.full(256, 93), 12_000)
    assert not is_large(np.full(4, 700), MAX_TRACKS)
    assert is_large(np.full(4, 900), 1000)
