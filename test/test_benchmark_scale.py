# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Choosing landmarks for many robots: its memory grows with them, not with their square."""

from __future__ import annotations

import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / 'benchmarks'))

from choice_scale import HEAD, catalogues, run
from choice_scale import main as command

from mapmerge_ros.association import number_by_id
from mapmerge_ros.fusion import FusionConfig
from mapmerge_ros.fusion.catalogues import Tracks
from mapmerge_ros.fusion.requests import plan_requests


def memory_of(robots: int) -> int:
    """Bytes at the peak of planning for catalogues of sixty landmarks."""
    fleet = catalogues(robots, 60)
    tracks = Tracks(*number_by_id(fleet, [submap.landmark_ids for submap in fleet]))
    tracemalloc.start()
    assert len(plan_requests(fleet, tracks, FusionConfig())) == robots
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak


def test_memory_grows_with_the_robots_and_not_with_their_square() -> None:
    """Nine times the robots have a little more than nine times the pairs of neighbours."""
    assert memory_of(144) < 15 * memory_of(16)


def test_every_robot_has_about_as_many_landmarks_and_neighbours_share_them() -> None:
    fleet = catalogues(9, 200)
    lengths = [len(submap.landmark_ids) for submap in fleet]
    assert 120 < min(lengths) <= max(lengths) < 280
    shared = len(np.intersect1d(fleet[0].landmark_ids, fleet[1].landmark_ids))
    assert 10 < shared < 80
    assert not len(np.intersect1d(fleet[0].landmark_ids, fleet[8].landmark_ids))


def test_everybody_is_asked_for_what_is_common() -> None:
    found = run(4)
    assert found['asked'] == 4
    assert 100 < found['landmarks'] <= FusionConfig().request_landmarks


def test_the_command_writes_its_table_into_a_document(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    document = tmp_path / 'page.md'
    document.write_text('before\n<!-- scale -->\nold\n<!-- end of scale -->\nafter\n')
    assert command(['--robots', '2', '4', '--markdown', str(document)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[: len(HEAD)] == HEAD
    assert [line.split()[1] for line in lines[len(HEAD) :]] == ['2', '4']
    wanted = ['before', '<!-- scale -->', *lines, '<!-- end of scale -->', 'after']
    assert document.read_text().splitlines() == wanted
