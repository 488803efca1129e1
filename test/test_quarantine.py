# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A sub-map that is wrong as a whole is named and kept out; the others stay merged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from damaged_maps import bent, metric_drones, shaken, six_drones, with_one

from mapmerge_ros.fusion import FusionConfig, FusionEngine, State, fuse
from mapmerge_ros.fusion.contradiction import _in_words
from mapmerge_ros.fusion.quarantine import MIN_RATIO, Search, Trial
from mapmerge_ros.fusion.refusal import Quarantine
from mapmerge_ros.io.summary import summarise
from mapmerge_ros.submap import SubMap

pytest.importorskip('pycolmap', reason='simulated maps are bundled by Ceres: pip install pycolmap')


@pytest.fixture(scope='module')
def submaps() -> list[SubMap]:
    return six_drones()


@pytest.fixture(scope='module')
def metric() -> list[SubMap]:
    return metric_drones()


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
