# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Asking and answering without topics: what is lost, late or out of order does no harm."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import random_bundle

from mapmerge_ros.bundle import Bundle, MapName
from mapmerge_ros.fusion import FusionConfig, FusionEngine, State
from mapmerge_ros.geometry import Similarity
from mapmerge_ros.io import NamedBundle, decode_submap
from mapmerge_ros.nodes.own_map import OwnMap, Response, work

CONFIG = FusionConfig(request_landmarks=15)
ROBOTS = 3
S = 1_000_000_000


def bundle_of(robot: int) -> Bundle:
    """One scene with noise of its own, in a frame of its own."""
    bundle = random_bundle(0, points=40, noise_px=0.0)
    rng = np.random.default_rng(robot)
    noise = 0.3 * rng.normal(size=bundle.observations_px.shape)
    noisy = replace(bundle, observations_px=bundle.observations_px + noise)
    return noisy.transformed(Similarity.exp(rng.normal(size=7)))


def robot(k: int, revision: int = 100) -> OwnMap:
    bundle, name = bundle_of(k), MapName(f'd{k}/1', f'd{k}', id_space='site')
    return OwnMap(NamedBundle(name, bundle, (0,) * len(bundle.keyframe_ids)), revision)


class Air:
    """Engine and robots, and a radio between them that loses what it is told to lose."""

    def __init__(self, seed: int, loss: float) -> None:
        self.rng = np.random.default_rng(seed)
        self.loss = loss
        self.engine = FusionEngine(CONFIG)
        self.robots = {f'd{k}/1': robot(k) for k in range(ROBOTS)}
        self.requests = 0

    def arrives(self) -> bool:
        return bool(self.rng.random() >= self.loss)

    def tick(self, now_s: int) -> None:
        if self.engine.changed:
            self.engine.fuse()
        for request in self.engine.asking.due(now_s * S):
            self.requests += 1
            own = self.robots[request.map_id]
            if self.arrives() and own.respond(request) is Response.COMPRESS:
                own.finish(work(own.job(request)))

    def send(self) -> None:
        for name in self.rng.permutation(sorted(self.robots)):
            if self.arrives():
                self.engine.add(decode_submap(self.robots[name].raw))


@pytest.mark.parametrize('seed', range(4))
@pytest.mark.parametrize('loss', [0.0, 0.5])
def test_all_are_merged_and_then_it_is_quiet(seed: int, loss: float) -> None:
    air = Air(seed, loss)
    for now_s in range(0, 2000, 5):
        air.send()
        air.tick(now_s)
    fusion = air.engine.fuse()
    assert len(fusion.in_state(State.MERGED)) == ROBOTS
    assert fusion.verdict.accepted
    for item in fusion.alignments:
        assert 3 <= item.submap.compressed_count <= 15
    asked = air.requests
    assert asked == ROBOTS if not loss else asked <= 8 * ROBOTS
    air.loss = 0.0
    for now_s in range(2000, 6000, 10):
        air.send()
        air.tick(now_s)
    assert air.requests == asked


def test_a_robot_that_comes_back_is_merged_with_what_the_others_have() -> None:
    air = Air(0, 0.0)
    for now_s in range(10):
        air.send()
        air.tick(now_s)
    before = {name: own.raw for name, own in air.robots.items()}
    air.robots['d1/1'] = robot(1, revision=500)
    for now_s in range(10, 20):
        air.send()
        air.tick(now_s)
    assert len(air.engine.fuse().in_state(State.MERGED)) == ROBOTS
    assert air.requests == ROBOTS + 1
    assert {name for name, own in air.robots.items() if own.raw is not before[name]} == {'d1/1'}
