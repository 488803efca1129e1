# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What makes reading fast changes nothing; the benchmark of it runs. No times are asserted."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from submaps import random_submap

from mapmerge_ros.io import decode_submap, encode_submap, read_submaps

sys.path.insert(0, str(Path(__file__).parents[1] / 'benchmarks'))

from bag_replay import KINDS, entries, measure
from messages_184kb import next_revision, submap

NAMES = ('landmark_ids', 'points', 'packed_r', 'c')


@pytest.mark.parametrize('name', NAMES)
def test_a_submap_of_a_message_cannot_be_written_to(name: str) -> None:
    found = decode_submap(encode_submap(random_submap(np.random.default_rng(0))))
    with pytest.raises(ValueError, match='read-only'):
        getattr(found, name)[0] = 0


@pytest.mark.parametrize('name', NAMES)
def test_a_view_of_a_message_cannot_be_opened_for_writing(name: str) -> None:
    found = decode_submap(encode_submap(random_submap(np.random.default_rng(0))))
    array = getattr(found, name)
    if array.base is not None:
        with pytest.raises(ValueError, match='WRITEABLE'):
            array.flags.writeable = True


def test_a_submap_does_not_follow_a_buffer_that_is_used_again() -> None:
    raw = bytearray(encode_submap(random_submap(np.random.default_rng(0))))
    found, expected = decode_submap(memoryview(raw)), decode_submap(bytes(raw))
    raw[:] = bytes(len(raw))
    for name in NAMES:
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def test_the_messages_that_are_measured_are_of_the_size_that_is_told() -> None:
    first = submap(0, 1)
    assert 183_500 < len(encode_submap(first)) < 184_500
    assert decode_submap(encode_submap(next_revision(first))).revision == 2


def test_every_kind_of_recording_that_is_measured_is_read(tmp_path: Path) -> None:
    for k, make in enumerate(KINDS.values()):
        found = list(read_submaps(make(tmp_path / f'{k}.mcap', entries(4, 2))))
        revisions = [item.submap.revision for item in found if item.submap]
        assert revisions == [1, 1, 2, 2]


def test_the_benchmark_runs() -> None:
    table = measure(messages=4, topics=2, repeats=1)
    assert len(table.splitlines()) == 2 + len(KINDS)
