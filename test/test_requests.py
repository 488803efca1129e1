# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""When robots are asked, for what, and when no more."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pytest
from catalogues import catalogue, tracks_by_id, within
from submaps import random_submap

from mapmerge_ros.errors import InvalidValue
from mapmerge_ros.fusion import FusionConfig
from mapmerge_ros.fusion.requests import Denial, _has_all, landmark_budget, plan_requests
from mapmerge_ros.io import encode_submap
from mapmerge_ros.submap import Request, SubMap, catalogue_bytes, information_bytes

CONFIG = FusionConfig(request_landmarks=60)


def plan(
    fleet: Sequence[SubMap],
    config: FusionConfig = CONFIG,
    denied: Mapping[str, Denial] | None = None,
) -> dict[str, Request]:
    found = plan_requests(fleet, tracks_by_id(fleet), config, denied)
    return {request.map_id: request for request in found}


def answered(submap: SubMap, ids: Any) -> SubMap:
    """The next revision, compressed to these landmarks."""
    others = np.setdiff1d(submap.landmark_ids, ids)
    order = np.concatenate([np.asarray(ids, np.uint64), others])
    return catalogue(submap.map_id, order, compressed=len(ids), revision=submap.revision + 1)


def strips(count: int) -> list[SubMap]:
    """Announcements of strips side by side, neighbours overlapping."""
    width = 100.0 / count
    return [
        catalogue(f'd{k}/1', within([k * width - 4, 0], [(k + 1) * width + 4, 60], 0.5))
        for k in range(count)
    ]


def test_announcements_are_asked_and_then_left_alone() -> None:
    fleet = strips(4)
    requests = plan(fleet)
    assert set(requests) == {'d0/1', 'd1/1', 'd2/1', 'd3/1'}
    for submap in fleet:
        request = requests[submap.map_id]
        assert (request.robot_id, request.revision, request.frame_id) == (
            submap.robot_id,
            submap.revision,
            submap.frame_id,
        )
        assert 3 <= len(request.landmark_ids) <= 60
    done = [answered(x, requests[x.map_id].landmark_ids) for x in fleet]
    assert plan(done) == {}


def test_few_missing_ones_are_not_worth_a_request() -> None:
    fleet = strips(2)
    wanted = [plan(fleet)[x.map_id].landmark_ids for x in fleet]
    most = [answered(x, ids[: int(0.9 * len(ids))]) for x, ids in zip(fleet, wanted, strict=True)]
    assert plan(most) == {}
    half = [answered(x, ids[: len(ids) // 2]) for x, ids in zip(fleet, wanted, strict=True)]
    assert set(plan(half)) == {'d0/1', 'd1/1'}


def test_only_the_one_that_lacks_is_asked() -> None:
    fleet = strips(2)
    wanted = plan(fleet)['d0/1'].landmark_ids
    requests = plan([answered(fleet[0], wanted), fleet[1]])
    assert set(requests) == {'d1/1'}
    assert np.isin(requests['d1/1'].landmark_ids, wanted).mean() > 0.8


@pytest.mark.parametrize('seed', range(5))
def test_a_newcomer_is_joined_and_nobody_else_falls_short(seed: int) -> None:
    """Whoever is asked again keeps enough in common with those who are not."""
    fleet = strips(3)
    first = plan(fleet)
    done = [answered(x, first[x.map_id].landmark_ids) for x in fleet]
    newcomer = catalogue('new/1', within([0, 20], [100, 40], 0.7, seed=seed), seed=seed)
    requests = plan([*done, newcomer])
    assert 'new/1' in requests
    after = {x.map_id: set(x.compressed_ids) for x in done}
    after |= {name: set(request.landmark_ids) for name, request in requests.items()}
    fresh = plan([*fleet, newcomer])
    for a in after:
        for b in after:
            ideal = set(fresh[a].landmark_ids) & set(fresh[b].landmark_ids)
            assert a == b or len(after[a] & after[b]) >= 0.6 * len(ideal)


@pytest.mark.parametrize('budget', [10, 60, 1000])
def test_where_all_that_is_common_is_compressed_no_choice_would_ask_for_more(
    budget: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    fleet = strips(4)
    owners = Counter(int(one) for submap in fleet for one in submap.landmark_ids)
    common = [[one for one in submap.landmark_ids if owners[int(one)] > 1] for submap in fleet]
    served = [answered(submap, ids) for submap, ids in zip(fleet, common, strict=True)]
    lacking = [answered(fleet[0], common[0][1:]), *served[1:]]
    config = FusionConfig(request_landmarks=budget)
    assert _has_all(served, tracks_by_id(served))
    assert not _has_all(lacking, tracks_by_id(lacking))
    assert not plan(served, config)
    monkeypatch.setattr('mapmerge_ros.fusion.requests._has_all', lambda *_: False)
    assert not plan(served, config)


def test_what_a_robot_denies_is_asked_of_nobody() -> None:
    fleet = strips(2)
    denied = plan(fleet)['d0/1'].landmark_ids[:20]
    requests = plan(fleet, denied={'d0/1': Denial(denied, 50)})
    for name in ('d0/1', 'd1/1'):
        assert not np.isin(requests[name].landmark_ids, denied).any()
        assert len(requests[name].landmark_ids) == 50


def test_nobody_is_asked_without_a_partner() -> None:
    fleet = strips(3)
    assert plan(fleet[:1]) == {}
    assert plan([]) == {}
    assert plan([fleet[0], fleet[2]]) == {}
    private = [catalogue(x.map_id, x.landmark_ids, id_space='') for x in fleet]
    assert plan(private) == {}


def test_the_answer_keeps_the_bytes() -> None:
    fleet = strips(2)
    for room in (0, 1000, 20_000, 100_000):
        limit = catalogue_bytes(fleet[0]) + room
        config = FusionConfig(request_landmarks=300, request_bytes=limit)
        budget = landmark_budget(fleet[0], config)
        assert information_bytes(budget) <= room
        assert budget == 300 or information_bytes(budget + 1) > room
        for name, request in plan(fleet, config).items():
            own = next(x for x in fleet if x.map_id == name)
            assert len(encode_submap(answered(own, request.landmark_ids))) <= limit
            assert request.max_bytes == limit


@pytest.mark.parametrize('seed', range(20))
def test_the_size_of_a_message_is_known_before(seed: int) -> None:
    submap = random_submap(np.random.default_rng(seed))
    bound = catalogue_bytes(submap) + information_bytes(submap.compressed_count)
    slack = 1000 + 4 * (3 * submap.compressed_count + 25)
    assert len(encode_submap(submap)) <= bound <= len(encode_submap(submap)) + slack


@pytest.mark.parametrize(
    ('changes', 'field'),
    [
        ({'map_id': ''}, 'map_id'),
        ({'revision': -1}, 'revision'),
        ({'max_bytes': -1}, 'max_bytes'),
        ({'landmark_ids': []}, 'landmark_ids'),
        ({'landmark_ids': [3, 3]}, 'landmark_ids'),
    ],
)
def test_a_request_says_something(changes: dict[str, Any], field: str) -> None:
    values: dict[str, Any] = {
        'map_id': 'a',
        'robot_id': 'a',
        'revision': 1,
        'landmark_ids': np.arange(3, dtype=np.uint64),
    }
    with pytest.raises(InvalidValue, match=field):
        Request(**{**values, **changes})
