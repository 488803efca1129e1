# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Whom a merge that is not believed suspects, and what is held to find out."""

from __future__ import annotations

import gc
from dataclasses import replace

import numpy as np
import pytest
from damaged_maps import bent, metric_drones, shaken, six_drones, with_one

from mapmerge_ros.association import associate
from mapmerge_ros.fusion import FusionConfig, component, fuse, groups, verify
from mapmerge_ros.fusion.associate import of_compressed
from mapmerge_ros.fusion.component import merge_component
from mapmerge_ros.fusion.links import find_links
from mapmerge_ros.fusion.misfit import worst_map
from mapmerge_ros.fusion.quarantine import Trial
from mapmerge_ros.fusion.solution import Solution
from mapmerge_ros.fusion.stopwatch import Stopwatch
from mapmerge_ros.fusion.warm import Warm
from mapmerge_ros.submap import SubMap

pytest.importorskip('pycolmap', reason='simulated maps are bundled by Ceres: pip install pycolmap')

from mapmerge_ros.simulation import FleetConfig, simulate_fleet


@pytest.fixture(scope='module')
def submaps() -> list[SubMap]:
    return six_drones()


@pytest.fixture(scope='module')
def metric() -> list[SubMap]:
    return metric_drones()


def solutions():
    """All that are alive, 7 MB each for eight drones."""
    gc.collect()
    return sum(isinstance(each, Solution) for each in gc.get_objects())


def test_of_what_is_not_believed_only_the_whole_is_held_and_only_while_culprits_are_sought(
    submaps, monkeypatch
):
    alive = []

    def counted(*args):
        alive.append(solutions())
        return merge_component(*args)

    monkeypatch.setattr(groups, 'merge_component', counted)
    # Others are tried as well: with the wrong one in they are not believed.
    monkeypatch.setattr(Trial, 'explains_all', False)
    warm = Warm()
    fusion = fuse(with_one(submaps, 3, bent(submaps[3], 0.1)), warm=warm)
    assert len(fusion.quarantined) == 1
    assert len(alive) == 5  # the whole, and without one of four
    assert alive == [0] + [1] * (len(alive) - 1)
    assert solutions() == 0


def merge_all(submaps, config, stopwatch):
    association = of_compressed(submaps, associate(submaps).tracks)
    links = find_links(submaps, association, config, Warm())
    return merge_component(submaps, association, links, None, config, 1, stopwatch, Warm())


def test_how_badly_a_map_fits_is_asked_in_the_time_of_the_tests(submaps):
    damaged = with_one(submaps, 3, bent(submaps[3], 0.1))
    stopwatch = Stopwatch()
    merged, misfits = merge_all(damaged, FusionConfig(unlock=False), stopwatch)
    assert not merged.component.verdict.accepted
    before = stopwatch['test']
    assert np.argmax(misfits(range(6))) == 3
    assert stopwatch['test'] > before


def test_a_map_of_which_too_much_is_off_is_the_reason_not_the_price_of_all(submaps):
    damaged = with_one(submaps, 3, bent(submaps[3], 0.1))
    verdict = merge_all(damaged, FusionConfig(), Stopwatch())[0].component.verdict
    assert not verdict.accepted
    assert verdict.suspect == damaged[3].map_id
    assert verdict.reason == f'more of {damaged[3].map_id} is off than can be left out'


def test_of_two_maps_none_is_the_reason(submaps, monkeypatch):
    asked = []

    def everybody(taken_out, rows):
        asked.append(len(rows))
        return np.array([1, 0])

    monkeypatch.setattr(component, 'too_much', everybody)
    points = submaps[1].points.copy()
    apart = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    points[np.argsort(apart)[:30], 2] += 0.1 * np.median(apart)
    pair = [submaps[0], replace(submaps[1], points=points)]
    verdict = merge_all(pair, FusionConfig(), Stopwatch())[0].component.verdict
    assert asked == [2]
    assert not verdict.accepted
    assert verdict.reason.startswith('the merge costs')


def test_a_wrong_scale_is_told_where_too_much_is_off_as_well(metric):
    damaged = with_one(metric, 0, bent(metric[0], 0.05))
    damaged[2] = replace(metric[2], points=1.03 * metric[2].points)
    verdict = merge_all(damaged, FusionConfig(), Stopwatch())[0].component.verdict
    assert not verdict.accepted
    assert verdict.suspect == damaged[2].map_id
    assert 'larger than the others have it' in verdict.reason


def test_whether_one_map_is_wrong_is_asked_when_what_moved_is_out(monkeypatch):
    """An object of one map, and the noise of another 2.5 times what it claims."""
    submaps = list(simulate_fleet(FleetConfig(moved=1), 1).submaps(catalogue=False))
    damaged, asked = with_one(submaps, 0, shaken(submaps[0], 2.5, 0)), []

    def counted(merge):
        asked.append(merge)
        return worst_map(merge)

    monkeypatch.setattr(verify, 'worst_map', counted)
    merged, _ = merge_all(damaged, FusionConfig(), Stopwatch())
    verdict = merged.component.verdict
    assert not verdict.accepted
    assert verdict.suspect == damaged[0].map_id
    assert verdict.reason.startswith(f'{damaged[0].map_id} alone differs')
    out = [change for change in merged.component.changes if not change.merged]
    assert len(out) == verdict.moved >= 5
    # Once, and of the rest: a landmark that two maps had is in no merge of the rest at all.
    shared = np.bincount(np.concatenate(merged.component.association.tracks))
    assert [len(merge.members) for merge in asked] == [shared[shared > 1].sum()]
