# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What moved is told and taken out, and the rest of the map stays right."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from mapmerge_ros.fusion import Fusion, FusionConfig, Kind, fuse, solution, verify
from mapmerge_ros.fusion.honest import examine
from mapmerge_ros.fusion.merge import Estimate
from mapmerge_ros.fusion.search import search
from mapmerge_ros.geometry import Similarity, align
from mapmerge_ros.io.summary import summarise
from mapmerge_ros.io.wording import what_moved
from mapmerge_ros.submap import SubMap

pytest.importorskip('pycolmap', reason='simulated maps are bundled by Ceres: pip install pycolmap')

from mapmerge_ros.simulation import Fleet, FleetConfig, simulate_fleet

SEEDS = (1, 2, 3)


def moved_fleet(seed: int) -> Fleet:
    return simulate_fleet(FleetConfig(moved=1), seed)


def moved_in(fusion: Fusion) -> dict[str, set[int]]:
    found: dict[str, set[int]] = {}
    for change in fusion.changes:
        if change.kind is Kind.MOVED:
            found.setdefault(change.map_id, set()).add(change.landmark_id)
    return found


def errors_of(fusion: Fusion, fleet: Fleet, without: Sequence[int]) -> np.ndarray:
    landmarks = fusion.components[0].landmarks
    views = np.bincount(landmarks.member_rows, minlength=len(landmarks.ids))
    known = np.isin(landmarks.ids, fleet.truth.scene.ids) & (views > 1)
    known &= ~np.isin(landmarks.ids, np.asarray(without, np.uint64))
    truth = fleet.truth.points_world(landmarks.ids[known])
    points = landmarks.points_global[known]
    S = align(truth, points).S_target_source
    return np.linalg.norm(S.apply(points) - truth, axis=1)


@pytest.mark.parametrize('seed', SEEDS)
def test_an_object_is_told_with_its_members_only(seed):
    fleet = moved_fleet(seed)
    fusion = fuse(fleet.submaps())
    inside = set(map(int, fleet.truth.moved[0].landmark_ids))
    found = moved_in(fusion)
    assert len(found) == 1
    ((_, members),) = found.items()
    assert members <= inside
    assert len(members) >= 5
    assert fusion.verdict.accepted
    assert fusion.verdict.moved == len(members)
    assert 'moved together' in what_moved(fusion)


@pytest.mark.parametrize('seed', SEEDS)
def test_the_rest_of_the_map_is_as_if_the_object_had_not_been_matched(seed):
    fleet = moved_fleet(seed)
    inside = list(map(int, fleet.truth.moved[0].landmark_ids))
    submaps = fleet.submaps()
    ours = errors_of(fuse(submaps), fleet, inside)
    last = max(submaps, key=lambda submap: submap.stamp_ns)
    # The same map with the object's landmarks under ids that nobody else has.
    apart = []
    for k, submap in enumerate(submaps):
        ids = submap.landmark_ids.copy()
        hidden = np.isin(ids, np.array(inside, np.uint64))
        ids[hidden] += np.uint64(10**9 * (k + 1))
        apart.append(replace(submap, landmark_ids=ids))
    assert last.stamp_ns > 0
    without = errors_of(fuse(apart), fleet, inside)
    ratio = np.sqrt(np.mean(ours**2)) / np.sqrt(np.mean(without**2))
    assert 0.9 < ratio < 1.1


def test_displacements_are_those_of_the_scene():
    fleet = moved_fleet(1)
    fusion = fuse(fleet.submaps())
    landmarks = fusion.components[0].landmarks
    known = np.isin(landmarks.ids, fleet.truth.scene.ids)
    truth = fleet.truth.points_world(landmarks.ids[known])
    S_world_global = align(truth, landmarks.points_global[known]).S_target_source
    want = fleet.truth.moved[0].displacement_world
    for change in fusion.changes:
        if change.kind is Kind.MOVED:
            seen = S_world_global.scale * S_world_global.rotation @ change.displacement_global
            sign = np.sign(seen @ want)  # by the older map it is the way back
            std = S_world_global.scale * np.linalg.norm(change.std)
            assert np.linalg.norm(sign * seen - want) < 6.0 * std + 0.05


def test_the_frames_in_which_the_rounds_are_merged_do_not_matter(monkeypatch):
    rounds = []

    def turned(*args: object) -> Estimate:
        rounds.append(search(*args))
        tangent = len(rounds) * np.array([0.4, -0.9, 0.7, 3.0, -2.0, 1.0, 0.3])
        S_turned_found, state = Similarity.exp(tangent), rounds[-1].state
        return replace(
            rounds[-1],
            points=S_turned_found.apply(rounds[-1].points),
            matrix=None,
            state=state and state.after(S_turned_found),
        )

    submaps = moved_fleet(1).submaps()
    expected = fuse(submaps).changes
    monkeypatch.setattr(solution, 'search', turned)
    found = fuse(submaps).changes
    assert len(rounds) > 1
    for one, other in zip(found, expected, strict=True):
        assert one.landmark_id == other.landmark_id
        size = np.abs(other.covariance).max()
        np.testing.assert_allclose(one.covariance / size, other.covariance / size, atol=1e-4)
        np.testing.assert_allclose(
            one.displacement_global, other.displacement_global, atol=1e-3 * np.sqrt(size)
        )


def test_a_moved_landmark_goes_on_as_two_and_the_newest_keeps_the_id():
    fleet = moved_fleet(1)
    submaps = {submap.map_id: submap for submap in fleet.submaps()}
    fusion = fuse(submaps.values())
    landmarks, ids = fusion.components[0].landmarks, fusion.components[0].landmarks.ids
    assert len(np.unique(ids)) == len(ids)
    members = landmarks.members()
    rows = {member: row for row, group in enumerate(members) for member in group}
    for change in fusion.changes:
        mine = rows[change.map_id, change.landmark_id]
        others = {
            row for (name, own), row in rows.items() if own == change.landmark_id and row != mine
        }
        assert members[mine] == [(change.map_id, change.landmark_id)]
        assert len(others) == 1
        rest = members[others.pop()]
        is_newest = submaps[change.map_id].stamp_ns > max(
            submaps[name].stamp_ns for name, _ in rest
        )
        keeper = mine if is_newest else rows[rest[0]]
        assert int(ids[keeper]) == change.landmark_id


@pytest.mark.parametrize('seed', range(4))
def test_an_unchanged_scene_has_no_object(seed):
    fusion = fuse(simulate_fleet(FleetConfig(), seed).submaps())
    assert not moved_in(fusion)
    assert fusion.verdict.moved == 0


def test_a_map_that_is_wrong_as_a_whole_is_not_explained_away():
    submaps = list(simulate_fleet(FleetConfig(), 3).submaps())
    rng = np.random.default_rng(0)
    points = submaps[1].points.copy()
    extent = np.std(points, axis=0).max()
    points[: submaps[1].compressed_count] += (
        0.05 * extent * rng.normal(size=(submaps[1].compressed_count, 3))
    )
    submaps[1] = replace(submaps[1], points=points)
    fusion = fuse(submaps)
    assert [item.submap.map_id for item in fusion.quarantined] == [submaps[1].map_id]
    assert not fuse(submaps, FusionConfig(unlock=False)).verdict.accepted


def test_the_summary_lists_changes():
    fusion = fuse(moved_fleet(1).submaps())
    summary = summarise(fusion)
    assert len(summary['changes']) == len(fusion.changes) > 0
    row = summary['changes'][0]
    assert row['kind'] in ('moved', 'doubtful')
    assert len(row['displacement']) == len(row['std']) == 3
    assert 0.0 <= row['p_value'] <= 1.0


def test_without_unlocking_the_merge_is_refused():
    fusion = fuse(moved_fleet(1).submaps(), FusionConfig(unlock=False))
    assert not fusion.verdict.accepted
    assert fusion.changes == ()


@pytest.mark.parametrize(('size', 'stays'), [(7.0, True), (30.0, False)])
def test_a_single_landmark_is_told_whether_it_is_taken_out_or_not(size, stays):
    submaps = list(simulate_fleet(FleetConfig(), 4).submaps(catalogue=False))
    fusion, k = fuse(submaps), 1
    association = fusion.components[0].association
    shared = np.flatnonzero((association.views > 1)[association.tracks[k]])
    row = int(shared[7])
    std = submaps[k].sigma / np.linalg.norm(submaps[k].triangle()[:, 3 * row])
    points = submaps[k].points.copy()
    points[row, 0] += size * std  # of this coordinate, all others known
    submaps[k] = replace(submaps[k], points=points)
    told = {change.landmark_id: change for change in fuse(submaps).changes}
    assert len(told) <= 2
    change = told[int(submaps[k].compressed_ids[row])]
    assert (change.kind, change.object_id) == (Kind.DOUBTFUL, 0)
    assert change.merged is stays
    moved = size * std * fusion.alignments[k].S_global_map.scale
    assert np.linalg.norm(change.displacement_global) == pytest.approx(moved, rel=0.5)
    assert change.p_value < 1e-3


@pytest.mark.parametrize(('seed', 'singles'), [(1, 0), (3, 1)])
def test_of_what_was_taken_out_singles_count_as_aside_and_objects_do_not(
    seed, singles, monkeypatch
):
    counts = []

    def counted(*args, taken_out, **settings):
        counts.append(taken_out)
        return examine(*args, taken_out=taken_out, **settings)

    monkeypatch.setattr(verify, 'examine', counted)
    fusion = fuse(moved_fleet(seed).submaps(catalogue=False))
    out = [change.kind for change in fusion.changes if not change.merged]
    assert out.count(Kind.MOVED) >= 5
    assert out.count(Kind.DOUBTFUL) == singles
    assert counts == [0] + [singles] * (len(counts) - 1)
    assert len(counts) > 1


def test_the_order_of_the_maps_changes_nothing():
    submaps: list[SubMap] = list(moved_fleet(2).submaps())
    one, other = fuse(submaps), fuse(submaps[::-1])
    assert [x.landmark_id for x in one.changes] == [x.landmark_id for x in other.changes]
    assert one.verdict == other.verdict
