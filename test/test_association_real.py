# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Links between real sub-maps, from descriptors alone, as right and complete as promised."""

from __future__ import annotations

import importlib
import sys
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from associated import partition
from submaps import real_model

from mapmerge_ros.association import Decision, Memory, associate
from mapmerge_ros.bundle import MapName, compress
from mapmerge_ros.bundle.answer import announce

pytest.importorskip('pycolmap', reason='COLMAP models are read by pycolmap')

BENCHMARKS = Path(__file__).parents[1] / 'benchmarks'


@pytest.fixture(scope='module')
def scoring():
    sys.path.insert(0, str(BENCHMARKS))
    yield importlib.import_module('scoring')
    sys.path.remove(str(BENCHMARKS))


def announcements(scorer):
    return [
        announce(bundle, MapName(f'{k}', f'robot{k}')) for k, bundle in enumerate(scorer.bundles)
    ]


@pytest.mark.parametrize(
    ('name', 'joined', 'by_id', 'by_triangulation', 'recall'),
    [
        ('brighton_drone', 1, 0.97, 0.999, 0.95),
        ('boruszyn_kite', 1, 0.97, 0.999, 0.93),
        ('euroc_v101_maplab', 25, 0.85, 0.97, 0.80),
    ],
)
def test_links_are_right_and_nearly_all_there(
    scoring, name, joined, by_id, by_triangulation, recall
):
    scorer = scoring.Scorer(real_model(name))
    found = associate(announcements(scorer))
    decisions = [match.decision for match in found.matches.values()]
    assert decisions.count(Decision.JOINED) >= joined
    links = []
    for a, b in combinations(range(len(scorer.bundles)), 2):
        _, rows_a, rows_b = np.intersect1d(found.tracks[a], found.tracks[b], return_indices=True)
        links.append(scoring.Links(a, b, rows_a, rows_b))
    score = scorer.score(links)
    assert score.precision_by_id >= by_id
    assert score.precision_by_triangulation >= by_triangulation
    assert score.recall >= recall


def test_a_real_announcement_that_is_compressed_keeps_its_tracks_at_no_cost(scoring, monkeypatch):
    """Where σ is unknown its estimate goes into the covariances: it must not move with R."""
    scorer = scoring.Scorer(real_model('brighton_drone'))
    announced = announcements(scorer)
    memory = Memory()
    expected = partition(announced, associate(announced, memory=memory))
    answered = [
        compress(bundle, MapName(f'{k}', f'robot{k}', 2), bundle.point_ids[::7])
        for k, bundle in enumerate(scorer.bundles)
    ]
    assert partition(answered, associate(answered)) == expected

    def nothing(*_):
        raise AssertionError('matched again')

    monkeypatch.setattr('mapmerge_ros.association.memory.match_pair', nothing)
    assert partition(answered, associate(answered, memory=memory)) == expected
