# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Replay: the node's timer in bag time, the same fusions however the messages come."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapmerge_ros.bundle import MapName, compress
from mapmerge_ros.errors import InvalidValue
from mapmerge_ros.fusion import Fusion, FusionEngine, Receipt, fuse
from mapmerge_ros.fusion.replay import BagTimer, EmptyReplayError, replay
from mapmerge_ros.geometry import Similarity
from mapmerge_ros.submap import SubMap

from scenes import random_bundle  # isort: skip

SECOND = 1_000_000_000


def views_of_one_scene(count: int) -> list[SubMap]:
    """Compressed maps of the same points, each in a frame of its own."""
    rng = np.random.default_rng(5)
    submaps = []
    for k in range(count):
        bundle = random_bundle(seed=0, noise_px=0.0)
        frame = Similarity.exp(0.3 * rng.normal(size=7))
        name = MapName(f'robot{k}/0001', f'robot{k}', 1, k * SECOND, id_space='site')
        submaps.append(compress(bundle.transformed(frame), name, bundle.point_ids[:12]))
    return [replace(submap, sigma=0.5) for submap in submaps]


def run(
    messages: list[tuple[int, SubMap]], period_ns: int = SECOND
) -> tuple[Fusion, list[tuple[int, int]]]:
    """Last fusion, and time and number of sub-maps of each."""
    seen: list[tuple[int, int]] = []
    fusion = replay(
        messages,
        FusionEngine(),
        period_ns,
        lambda time_ns, found: seen.append((time_ns, len(found.alignments))),
    )
    return fusion, seen


def test_ticks_are_at_start_plus_multiples_of_the_period() -> None:
    times_ns = np.array([0.0, 0.2, 1.0, 1.1, 7.5]) * SECOND
    submaps = views_of_one_scene(5)
    start_ns = 1_700_000_000_000_000_123
    messages = [(start_ns + int(t), x) for t, x in zip(times_ns, submaps, strict=True)]
    seconds = [((t - start_ns) / SECOND, count) for t, count in run(messages)[1]]
    # A message at the very tick still belongs to it; a gap has one tick; the rest is the end.
    assert seconds == [(1.0, 3), (2.0, 4), (7.5, 5)]


def test_timer_never_ticks_twice_nor_late() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        start, period = int(rng.integers(-1000, 1000)), int(rng.integers(1, 60))
        timer = BagTimer(start, period)
        last = start
        for now in np.sort(rng.integers(start, start + 1000, 30)).tolist():
            tick = timer.due(now)
            expected = [t for t in range(start + period, now, period) if t >= last]
            assert tick == (expected[0] if expected else None)
            last = now


def test_nothing_is_fused_while_nothing_changes() -> None:
    first, second = views_of_one_scene(2)
    messages = [(0, first), (SECOND // 2, second)]
    messages += [(k * SECOND, first) for k in range(1, 6)]  # old revisions
    assert run(messages)[1] == [(SECOND, 2)]


def test_last_fusion_is_that_of_the_values() -> None:
    submaps = views_of_one_scene(3)
    fusion, _ = run([(k * SECOND, submap) for k, submap in enumerate(submaps)])
    direct = fuse(submaps)
    assert fusion.components[0].map_ids == direct.components[0].map_ids
    found, expected = (x.components[0].landmarks.points_global for x in (fusion, direct))
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_same_messages_give_the_same_bits() -> None:
    messages = [(k * SECOND, submap) for k, submap in enumerate(views_of_one_scene(3))]
    (one, _), (two, _) = run(messages), run(messages)
    a, b = one.components[0], two.components[0]
    assert a.landmarks.points_global.tobytes() == b.landmarks.points_global.tobytes()
    assert a.submap.packed_r.tobytes() == b.submap.packed_r.tobytes()
    assert a.verdict == b.verdict


def test_refused_messages_are_told_and_change_nothing() -> None:
    first, second = views_of_one_scene(2)
    told: list[tuple[str, Receipt]] = []
    fusion = replay(
        [(0, first), (1, first), (2, second)],
        FusionEngine(),
        SECOND,
        on_receipt=lambda submap, receipt: told.append((submap.map_id, receipt)),
    )
    assert [receipt.accepted for _, receipt in told] == [True, False, True]
    assert 'revision 1 is not newer' in told[1][1].reason
    assert len(fusion.alignments) == 2


def test_nothing_accepted_is_an_error_with_the_reason() -> None:
    own = replace(views_of_one_scene(1)[0], map_id='fusion/global')
    with pytest.raises(EmptyReplayError, match='fusion/global is the map that this'):
        run([(0, own)])
    with pytest.raises(EmptyReplayError, match='no message'):
        run([])


def test_period_has_to_be_positive() -> None:
    with pytest.raises(InvalidValue, match='period_ns: 0 is not positive'):
        run([(0, views_of_one_scene(1)[0])], 0)
