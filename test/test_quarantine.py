# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A sub-map that is wrong as a whole is named and kept out; the others stay merged."""

from __future__ import annotations

import gc
from dataclasses import replace

import numpy as np
import pytest
from gaussian_merges import merged, noise, scene

from mapmerge_ros.association import associate
from mapmerge_ros.fusion import (
    FusionConfig,
    FusionEngine,
    State,
    component,
    fuse,
    groups,
    misfit,
    verify,
)
from mapmerge_ros.fusion.associate import of_compressed
from mapmerge_ros.fusion.component import merge_component
from mapmerge_ros.fusion.contradiction import _in_words
from mapmerge_ros.fusion.contrasts import contrasts
from mapmerge_ros.fusion.likelihood import weigh
from mapmerge_ros.fusion.links import find_links
from mapmerge_ros.fusion.misfit import MapTest, misfits, without_map, worst_map
from mapmerge_ros.fusion.quarantine import MIN_RATIO, Search, Trial
from mapmerge_ros.fusion.refusal import Quarantine
from mapmerge_ros.fusion.solution import Solution
from mapmerge_ros.fusion.stopwatch import Stopwatch
from mapmerge_ros.fusion.warm import Warm
from mapmerge_ros.io.summary import summarise
from mapmerge_ros.submap import SubMap

pytest.importorskip('pycolmap', reason='simulated maps are bundled by Ceres: pip install pycolmap')

from mapmerge_ros.bundle.bundle import FramePrior
from mapmerge_ros.geometry import Gauge
from mapmerge_ros.simulation import FleetConfig, simulate_fleet
from mapmerge_ros.simulation.drones import Sensing


@pytest.fixture(scope='module')
def submaps() -> list[SubMap]:
    return list(simulate_fleet(FleetConfig(drones=6), 71).submaps(catalogue=False))


@pytest.fixture(scope='module')
def metric() -> list[SubMap]:
    sensing = Sensing(gauge=Gauge.RIGID, prior=FramePrior(scale_std_ratio=0.003))
    return list(simulate_fleet(FleetConfig(sensing=sensing), 70).submaps(catalogue=False))


def bent(submap: SubMap, share: float) -> SubMap:
    centred = submap.points - submap.points.mean(axis=0)
    axes = np.linalg.svd(centred, full_matrices=False)[2]
    along = centred @ axes[0]
    raised = np.outer(share * along**2 / np.abs(along).max(), axes[2])
    return replace(submap, points=submap.points + raised)


def shaken(submap: SubMap, factor: float, seed: int) -> SubMap:
    white = factor * submap.sigma * np.random.default_rng(seed).normal(size=submap.rank)
    errors = np.linalg.lstsq(submap.triangle(), white, rcond=None)[0].reshape(-1, 3)
    return replace(submap, points=submap.points + errors)


def with_one(submaps, k, damaged):
    return [damaged if at == k else submap for at, submap in enumerate(submaps)]


@pytest.mark.parametrize(('k', 'kind'), [(3, 'bent'), (0, 'shaken')])
def test_the_wrong_one_is_named_and_the_rest_is_believed(submaps, k, kind):
    damaged = bent(submaps[k], 0.1) if kind == 'bent' else shaken(submaps[k], 4.0, k)
    fusion = fuse(with_one(submaps, k, damaged))
    (item,) = fusion.quarantined
    assert item.submap.map_id == damaged.map_id
    assert item.state is State.REFUSED
    assert fusion.verdict.accepted
    assert len(fusion.components[0].map_ids) == 5
    others = {submap.map_id for submap in submaps} - {damaged.map_id}
    assert set(item.quarantine.contradicts) <= others
    assert item.quarantine.p_value < 1e-6
    assert item.quarantine.distance > 0.0
    assert all(name in item.reason for name in item.quarantine.contradicts)


def test_the_rest_is_the_map_without_it(submaps):
    damaged = with_one(submaps, 3, bent(submaps[3], 0.1))
    found = fuse(damaged).components[0].landmarks
    alone = fuse([submap for k, submap in enumerate(damaged) if k != 3]).components[0].landmarks
    np.testing.assert_array_equal(found.ids, alone.ids)
    np.testing.assert_array_equal(found.points_global, alone.points_global)


def test_two_that_are_wrong_are_both_named(submaps):
    damaged = with_one(submaps, 0, bent(submaps[0], 0.1))
    damaged = with_one(damaged, 3, bent(damaged[3], 0.2))
    fusion = fuse(damaged)
    names = {item.submap.map_id for item in fusion.quarantined}
    assert names == {damaged[0].map_id, damaged[3].map_id}
    assert fusion.verdict.accepted


def test_of_two_nobody_can_tell(submaps):
    fusion = fuse([submaps[0], bent(submaps[5], 0.2)])
    assert not fusion.quarantined
    assert not fusion.verdict.accepted


def test_without_unlocking_the_paper_s_test_refuses_all(submaps):
    fusion = fuse(with_one(submaps, 3, bent(submaps[3], 0.1)), FusionConfig(unlock=False))
    assert not fusion.quarantined
    assert not fusion.verdict.accepted


def test_unchanged_maps_stay(submaps):
    assert not fuse(submaps).quarantined


def test_a_revision_that_fits_comes_back(submaps):
    engine = FusionEngine()
    for submap in with_one(submaps, 3, bent(submaps[3], 0.1)):
        engine.add(submap)
    assert len(engine.fuse().quarantined) == 1
    engine.add(replace(submaps[3], revision=submaps[3].revision + 1))
    fusion = engine.fuse()
    assert not fusion.quarantined
    assert len(fusion.components[0].map_ids) == 6


def test_the_global_frame_stays_when_its_anchor_is_in_quarantine(submaps):
    engine = FusionEngine()
    for submap in submaps:
        engine.add(submap)
    before = engine.fuse()
    k = [submap.map_id for submap in submaps].index(before.components[0].anchor)
    engine.add(replace(bent(submaps[k], 0.1), revision=submaps[k].revision + 1))
    after = engine.fuse()
    assert [item.submap.map_id for item in after.quarantined] == [submaps[k].map_id]
    frames = {item.submap.map_id: item.S_global_map for item in before.alignments}
    for item in after.in_state(State.MERGED):
        was = frames[item.submap.map_id]
        assert item.S_global_map.scale == pytest.approx(was.scale, rel=0.02)
        np.testing.assert_allclose(item.S_global_map.rotation, was.rotation, atol=0.02)


def test_a_metric_map_of_another_scale_is_named(metric):
    wrong = replace(metric[2], points=1.03 * metric[2].points)
    fusion = fuse(with_one(metric, 2, wrong))
    (item,) = fusion.quarantined
    assert item.submap.map_id == wrong.map_id
    # The price that is nearly nothing is not the reason.
    assert item.quarantine.price_ratio < MIN_RATIO
    assert f'and {wrong.map_id} is +3.34% larger than the others have it' in item.reason
    assert not fuse(metric).quarantined


def test_the_summary_says_why(submaps):
    wrong = bent(submaps[3], 0.1)
    rows = summarise(fuse(with_one(submaps, 3, wrong)))['sub_maps']
    evidence = {row['map_id']: row['quarantine'] for row in rows}
    assert evidence.pop(wrong.map_id)['contradicts']
    assert set(evidence.values()) == {None}


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


@pytest.mark.parametrize(
    ('price_ratio', 'p_value', 'quoted'),
    [(1.5, 1e-20, 'suspicion'), (5.0, 1e-3, 'suspicion'), (5.0, 1e-20, 'price')],
)
@pytest.mark.parametrize('suspicion', ['b alone differs', ''])
def test_the_reason_is_what_convinced(submaps, price_ratio, p_value, quoted, suspicion):
    """A price that is small, or there by chance, is none: then it is what was suspected."""
    merged = Fake(fuse(submaps[:3]).components[0], np.zeros(0))
    trial = Trial((3,), [((0, 1, 2), merged)], price_ratio, p_value, 0.0, 0.0, suspicion)
    search = Search((0, 1, 2, 3), merged, lambda _: [], lambda _: True, lambda _: 0)
    assert search._believes(trial) is (bool(suspicion) or quoted == 'price')
    evidence = Quarantine(('a', 'c'), price_ratio, p_value, 0.1, 0.01)
    words = _in_words(evidence, trial, merged)
    is_suspected = bool(suspicion) and quoted == 'suspicion'
    assert words.endswith(suspicion) == (is_suspected or not suspicion)
    assert ('it would add' in words) is not is_suspected


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


def test_many_culprits_take_few_merges(submaps):
    """Of thirty-two maps three are wrong: a number of merges that grows with the logarithm."""
    group, wrong, tried = tuple(range(32)), {3, 17, 29}, []
    plain = fuse(submaps[:3]).components[0]

    def merged_group(left):
        inside = wrong & set(left)
        verdict = replace(
            plain.verdict, accepted=not inside, a_tilde=plain.verdict.a_tilde * (1 + len(inside))
        )
        names = tuple(map(str, left))
        component = replace(plain, map_ids=names, verdict=verdict)
        costs = np.array([9.0 if k in wrong else 1.0 + 0.1 * k for k in left])
        return Fake(component, costs)

    def merge_without(culprits):
        tried.append(culprits)
        left = tuple(k for k in group if k not in culprits)
        return [(left, merged_group(left))]

    search = Search(group, merged_group(group), merge_without, lambda part: True, lambda part: 0)
    found = search.culprits()
    assert set(found.without) == wrong
    assert len(tried) <= 14


class Fake:
    def __init__(self, component, cost_ratios):
        self.component, self.cost_ratios = component, cost_ratios


def test_contrasts_without_a_map_are_those_of_the_others():
    """Price and freedom of the others do not depend on what the one that is left out says."""
    rng = np.random.default_rng(5)
    points, members, matrices = scene(rng, maps=4, landmarks=40, views=(2, 4))
    errors = noise(rng, points, members, matrices)
    disturbed = errors.copy()
    part = members.of_map(2)
    disturbed[part] += rng.normal(size=disturbed[part].shape)
    prices = []
    for own in (errors, disturbed):
        data = contrasts(merged(points, members, matrices, own), 600)
        rest = without_map(data, part)
        prices.append(weigh(rest, np.array([1.0, 0.1, 0.1])).price(rest))
        assert abs(rest.from_members[:, part]).sum() == 0.0
        identity = (rest.from_members @ rest.from_members.T).toarray()
        np.testing.assert_allclose(identity, np.eye(len(rest.tracks)), atol=1e-12)
    assert prices[0] == pytest.approx(prices[1], rel=1e-6)
    assert rest.dof == 3 * len(rest.tracks) - 14


def test_a_map_that_is_noisier_than_the_others_is_the_worst():
    ratios, found = [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        points, members, matrices = scene(rng, maps=4, landmarks=70, views=(3, 4))
        errors = noise(rng, points, members, matrices)
        ratios.append(worst_map(merged(points, members, matrices, errors)).ratio)
        errors[members.of_map(2)] *= 3.0
        found.append(worst_map(merged(points, members, matrices, errors)))
    assert max(ratios) < 1.3
    assert {test.k for test in found} == {2}
    assert not any(test.is_believed for test in found)


def test_each_map_is_tested_by_the_errors_of_the_others():
    rng = np.random.default_rng(1)
    points, members, matrices = scene(rng, maps=4, landmarks=70, views=(3, 4))
    errors = noise(rng, points, members, matrices)
    errors[members.of_map(1)] *= 3.0
    merge = merged(points, members, matrices, errors)
    found = misfits(merge, [3, 1, 0])
    assert [test.k for test in found] == [3, 1, 0]
    assert np.argmax([test.ratio for test in found]) == 1
    assert found[1] == worst_map(merge)


def test_a_map_of_few_landmarks_may_be_further_off_by_chance():
    def test(ratio, landmarks):
        return MapTest(0, ratio * (3 * landmarks - 7), 3 * landmarks - 7, landmarks)

    assert test(2.9, 10).is_believed
    assert not test(2.9, 200).is_believed
    assert test(2.2, 100_000).is_believed
    assert not test(2.3, 100_000).is_believed


def rivals(submaps, misfits, **verdict_of_all):
    """Search in a group of four: without 2 or 5, which are slots 0 and 1, the others agree."""
    plain, group = fuse(submaps[:3]).components[0], (2, 5, 7, 9)

    def merged_group(left):
        both = {2, 5} <= set(left)
        # What is left of real maps without 5, who has more in common, is less.
        price = plain.verdict.dof * (9.0 if both else 3.0 + (5 in left))
        verdict = replace(plain.verdict, accepted=not both, a_tilde=price * plain.verdict.sigma**2)
        verdict = replace(verdict, **verdict_of_all) if left == group else verdict
        component = replace(plain, map_ids=tuple(map(str, left)), verdict=verdict)
        return Fake(component, np.arange(len(left)) + 1.0)

    def merge_without(culprits):
        left = tuple(k for k in group if k not in culprits)
        return [(left, merged_group(left))]

    whole = merged_group(group)
    return Search(group, whole, merge_without, lambda part: True, lambda part: 0, misfits)


def test_of_two_that_contradict_each_other_the_one_is_named_that_the_others_explain_less(submaps):
    """Not the one without whom less is left to be explained: that has most in common."""
    by_misfit = rivals(submaps, lambda slots: [{0: 3.4, 1: 1.9}[slot] for slot in slots])
    assert by_misfit.culprits().without == (2,)
    assert rivals(submaps, lambda slots: ()).culprits().without == (5,)


def test_a_suspicion_is_told_of_the_suspect_and_of_nobody_else(submaps):
    search = rivals(submaps, lambda slots: (), suspect='2', reason='2 alone differs')
    told = {k: search._without((k,)).suspicion for k in search.group}
    assert told == {2: '2 alone differs', 5: '', 7: '', 9: ''}
    assert search._without((2, 7)).suspicion == ''


@pytest.mark.parametrize('found', [(0.95, 0.5), (np.nan, 1.5), (np.inf, 1.2), ()])
def test_rivals_that_fit_as_right_ones_do_or_cannot_be_asked_are_told_apart_by_what_is_left(
    submaps, found
):
    search = rivals(submaps, lambda slots: [found[slot] for slot in slots if found])
    assert search.culprits().without == (5,)


def test_of_rivals_chance_is_as_large_as_their_landmarks_are_few():
    """The larger ratio is believed and the smaller is not: that one fits worse."""
    few, many = (
        MapTest(k, ratio * (3 * count - 7), 3 * count - 7, count)
        for k, ratio, count in ((0, 2.8, 10), (1, 2.7, 150))
    )
    assert few.ratio > many.ratio
    assert few.is_believed
    assert not many.is_believed
    assert few.excess < 1.0 < many.excess


def test_of_a_large_fleet_the_rivals_are_asked_wherever_the_sample_would_be(monkeypatch):
    """A sample of 150 contrasts is about 15 of 20 maps; some others are asked."""
    monkeypatch.setattr(misfit, 'MAX_CONTRASTS', 150)
    rng = np.random.default_rng(0)
    points, members, matrices = scene(rng, maps=20, landmarks=600, views=(2, 3))
    errors = noise(rng, points, members, matrices)
    plain = contrasts(merged(points, members, matrices, errors), 150)
    outside = np.setdiff1d(np.arange(20), members.maps[plain.owners >= 0])[:3]
    errors[members.of_map(int(outside[1]))] *= 3.0
    tests = misfits(merged(points, members, matrices, errors), outside)
    assert [test.k for test in tests] == outside.tolist()
    assert min(test.landmarks for test in tests) >= 20
    assert [test.is_believed for test in tests] == [True, False, True]


def test_of_two_maps_none_is_the_worst():
    rng = np.random.default_rng(3)
    points, members, matrices = scene(rng, maps=2, landmarks=70, views=(2, 2))
    errors = noise(rng, points, members, matrices)
    assert worst_map(merged(points, members, matrices, errors)) is None
