# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""No data counts twice, whatever is recorded or heard together; and one name is one robot's."""

from dataclasses import replace

import numpy as np
import pytest
from ros_processes import SHIPPED

from mapmerge_ros.fusion import FusionEngine, State, fuse
from mapmerge_ros.fusion.accumulate import without_duplicates
from mapmerge_ros.io import read_submaps


@pytest.fixture(scope='module')
def submaps():
    newest = {item.submap.map_id: item.submap for item in read_submaps(SHIPPED)}
    return tuple(newest[name] for name in sorted(newest))


def names(submaps):
    return [submap.map_id for submap in submaps]


@pytest.fixture(scope='module')
def whole(submaps):
    """All of them merged by another fusion."""
    return replace(fuse(submaps).components[0].submap, map_id='other/global', robot_id='other')


def test_what_is_merged_from_maps_that_are_here_adds_nothing(submaps, whole):
    kept, refused = without_duplicates([whole, *submaps])
    assert names(kept) == names(submaps)
    assert [refusal.map_id for refusal in refused] == ['other/global']
    assert 'all it is merged from (4 sub-maps) is here itself' in refused[0].reason
    fusion, alone = fuse([whole, *submaps]), fuse(submaps)
    assert len(fusion.in_state(State.MERGED)) == 4
    np.testing.assert_array_equal(
        fusion.components[0].landmarks.points_global, alone.components[0].landmarks.points_global
    )


def test_what_knows_more_than_is_here_stays(submaps, whole):
    kept, refused = without_duplicates([whole, *submaps[1:]])
    assert names(kept) == ['other/global']
    assert {refusal.map_id for refusal in refused} == set(names(submaps[1:]))


def test_what_knows_something_newer_stays(submaps, whole):
    sources = tuple(
        replace(source, revision=source.revision + (k == 2))
        for k, source in enumerate(whole.sources)
    )
    kept, _ = without_duplicates([replace(whole, sources=sources), *submaps])
    assert names(kept) == ['other/global']


def test_two_robots_may_not_have_one_map_id(submaps):
    engine = FusionEngine()
    assert engine.add(submaps[0]).accepted
    thief = replace(submaps[1], map_id=submaps[0].map_id, revision=submaps[0].revision + 1)
    receipt = engine.add(thief)
    assert not receipt.accepted
    assert receipt.conflict
    assert receipt.reason == (
        "map_id drone0/0001 belongs to robot 'drone0': robot 'drone1' needs one of its own"
    )
    assert engine.state().submaps == (submaps[0],)
    engine.remove([submaps[0].map_id])
    assert engine.add(thief).accepted


def test_a_map_that_changed_without_a_new_revision_is_news_that_is_left_out(submaps):
    engine = FusionEngine()
    assert engine.add(submaps[0]).accepted
    again = engine.add(submaps[0])
    assert (again.accepted, again.conflict) == (False, False)
    changed = replace(submaps[0], points=submaps[0].points + 1.0)
    receipt = engine.add(changed)
    assert (receipt.accepted, receipt.conflict) == (False, True)
    assert 'its landmarks are others' in receipt.reason
