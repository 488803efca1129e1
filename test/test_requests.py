# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""When robots are asked, for what, and when no more."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pytest
from catalogues import catalogue, within
from submaps import random_submap

from mapmerge_ros.errors import InvalidValue
from mapmerge_ros.fusion import FusionConfig
from mapmerge_ros.fusion.asking import MAX_TRIES, Asking
from mapmerge_ros.fusion.catalogues import tracks_by_id
from mapmerge_ros.fusion.requests import Denial, landmark_budget, plan_requests
from mapmerge_ros.io import encode_submap
from mapmerge_ros.submap import Request, SubMap, catalogue_bytes, information_bytes

CONFIG = FusionConfig(request_landmarks=60)
S = 1_000_000_000


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


def ask(ids: Any, revision: int = 1, name: str = 'a') -> Request:
    return Request(name, name, revision, np.asarray(ids, np.uint64))


def test_a_lost_request_is_repeated_more_and_more_seldom_and_then_no_more() -> None:
    asking = Asking(CONFIG)
    asking.wish([ask(range(10))])
    sent = [t for t in range(0, 4000) if asking.due(t * S)]
    assert sent == [0, 10, 30, 70, 150, 310, 630, 1270]
    assert len(sent) == MAX_TRIES
    assert (asking.unanswered, asking.given_up) == (1, 1)
    asking.wish([ask(range(10))])
    assert asking.due(9999 * S) == ()
    asking.wish([ask(range(5, 15))])
    assert len(asking.due(9999 * S)) == 1, 'something else is another request'


def test_the_same_wish_of_the_next_merge_is_not_sent_again() -> None:
    asking = Asking(CONFIG)
    asking.wish([ask(range(10))])
    assert len(asking.due(0)) == 1
    asking.wish([ask(range(1, 11))])
    assert asking.due(1) == ()


def test_an_answer_ends_the_request_and_what_it_lacks_is_denied() -> None:
    asking = Asking(CONFIG)
    asking.wish([ask(range(10))])
    asking.due(0)
    asking.hear(catalogue('a', range(20), compressed=8, revision=2))
    assert asking.unanswered == 0
    assert asking.due(1000 * S) == (), 'a wish about the old revision'
    np.testing.assert_array_equal(asking.denied['a'].landmark_ids, [8, 9])
    assert asking.denied['a'].capacity == 8
    asking.hear(catalogue('a', range(20), compressed=9, revision=3))
    np.testing.assert_array_equal(asking.denied['a'].landmark_ids, [9])
    asking.hear(catalogue('a', range(20), revision=4))
    assert 'a' not in asking.denied, 'it begins again'


def test_a_robot_that_does_what_it_can_is_asked_only_twice() -> None:
    """It can only ever compress 20 landmarks, however often it is asked."""
    fleet, asking, sent = strips(2), Asking(CONFIG), 0
    for k in range(20):
        asking.wish(plan(fleet, denied=asking.denied).values())
        for request in asking.due(k * 100 * S):
            place = next(i for i, x in enumerate(fleet) if x.map_id == request.map_id)
            if place == 0:
                sent += 1
            ids = request.landmark_ids[: 20 if place == 0 else None]
            fleet[place] = answered(fleet[place], ids)
            asking.hear(fleet[place])
    assert 1 <= sent <= 2
    assert plan(fleet, denied=asking.denied) == {}


def test_a_robot_that_only_announces_is_not_asked_for_ever() -> None:
    asking = Asking(CONFIG)
    sent = 0
    for revision in range(1, 50):
        asking.hear(catalogue('a', range(20), revision=revision))
        asking.wish([ask(range(10), revision)])
        sent += len(asking.due(revision * S))
    assert sent == MAX_TRIES


def test_a_robot_that_begins_again_is_asked_at_once() -> None:
    asking = Asking(CONFIG)
    asking.wish([ask(range(10), 1)])
    asking.due(0)
    asking.hear(catalogue('a', range(20), compressed=10, revision=2))
    asking.hear(catalogue('a', range(20), revision=3))
    asking.wish([ask(range(10), 3)])
    assert len(asking.due(1)) == 1


def test_a_clock_that_is_set_back_does_not_silence_it() -> None:
    asking = Asking(CONFIG)
    asking.wish([ask(range(10))])
    assert asking.due(1000 * S)
    assert asking.due(5 * S)


def test_what_is_removed_is_forgotten() -> None:
    asking = Asking(CONFIG)
    asking.wish([ask(range(10)), ask(range(10), name='b')])
    asking.due(0)
    asking.forget(['a'])
    assert [x.map_id for x in asking.due(10 * S)] == ['b']
    asking.wish([])
    assert asking.unanswered == 0


def test_a_wish_about_what_has_changed_meanwhile_is_dropped_but_remembered() -> None:
    asking = Asking(CONFIG)
    for revision in range(1, 30):
        asking.wish([ask(range(10), revision), ask(range(10), revision, 'gone')], {'a': revision})
        asking.due(0)
        asking.wish([ask(range(10), revision)], {'a': revision + 1})
        assert asking.due(1) == ()
    assert asking.given_up == 1
