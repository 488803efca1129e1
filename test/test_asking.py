# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The memory of requests: repeated when lost, ended when answered, given up in the end."""

from __future__ import annotations

from typing import Any

import numpy as np
from catalogues import catalogue
from test_requests import CONFIG, answered, plan, strips

from mapmerge_ros.fusion.asking import MAX_TRIES, Asking
from mapmerge_ros.submap import Request

S = 1_000_000_000


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
