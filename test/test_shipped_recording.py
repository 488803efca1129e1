# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The shipped recording gives what is committed beside it, and what is true."""

import json
import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest

from mapmerge_ros.cli.main import main
from mapmerge_ros.fusion import fuse
from mapmerge_ros.io import read_submaps
from mapmerge_ros.io.truth import compare_with_truth, load_truth, truth_path

BAGS = Path(__file__).parents[1] / 'bags'
RECORDING = BAGS / 'four_drones.mcap'


def differences(expected, seen, path='summary'):
    """Places where two JSON values differ by more than 1e-6 of their size."""
    if isinstance(expected, dict):
        if set(expected) != set(seen):
            yield f'{path}: keys {sorted(set(expected) ^ set(seen))}'
            return
        for key, value in expected.items():
            yield from differences(value, seen[key], f'{path}.{key}')
    elif isinstance(expected, list):
        if len(expected) != len(seen):
            yield f'{path}: {len(seen)} instead of {len(expected)} items'
            return
        for k, (a, b) in enumerate(zip(expected, seen, strict=True)):
            yield from differences(a, b, f'{path}[{k}]')
    elif isinstance(expected, float) and isinstance(seen, float):
        if seen != pytest.approx(expected, rel=1e-6, abs=1e-9):
            yield f'{path}: {seen} instead of {expected}'
    elif expected != seen:
        yield f'{path}: {seen!r} instead of {expected!r}'


def test_the_replay_gives_what_is_committed(tmp_path):
    assert main(['replay', str(RECORDING), '--out', str(tmp_path / 'out')]) == 0
    seen = json.loads((tmp_path / 'out/summary.json').read_text())
    assert set(seen.pop('timing_s')) == {'associate', 'merge', 'test', 'total'}
    expected = json.loads((BAGS / 'four_drones.expected.json').read_text())
    assert list(differences(expected, seen)) == []


def test_the_merge_is_near_the_truth():
    """A tenth of a per cent of the scene: a third of what each drone alone would reach."""
    fusion = fuse([item.submap for item in read_submaps([RECORDING])])
    comparison = compare_with_truth(fusion, load_truth(truth_path(RECORDING)))
    assert comparison.count == len(fusion.components[0].landmarks.ids)
    assert comparison.median_error < 2e-3 * comparison.radius


def test_the_recording_is_small():
    assert RECORDING.stat().st_size <= 1_000_000


def test_the_recording_is_what_simulate_makes(tmp_path):
    pytest.importorskip('pycolmap', reason='simulated maps are bundled by Ceres')
    assert main(['simulate', str(tmp_path / 'again.mcap')]) == 0
    shipped = [item.submap for item in read_submaps([RECORDING])]
    again = [item.submap for item in read_submaps([tmp_path / 'again.mcap'])]
    assert [submap.map_id for submap in again] == [submap.map_id for submap in shipped]
    for a, b in zip(shipped, again, strict=True):
        assert (a.landmark_ids == b.landmark_ids).all()
        assert b.points == pytest.approx(a.points, rel=1e-5, abs=1e-5)
        assert b.a == pytest.approx(a.a, rel=1e-6)


def test_a_terminal_sees_that_the_last_merge_is_at_work(tmp_path):
    """The bar is gone by then, and thousands of landmarks take a minute."""
    ours, theirs = os.openpty()
    program = [sys.executable, '-m', 'mapmerge_ros.cli.main']
    process = subprocess.Popen(
        [*program, 'replay', RECORDING, '--out', tmp_path],
        stdout=subprocess.DEVNULL,
        stderr=theirs,
    )
    os.close(theirs)
    seen = b''
    # A terminal whose other end is closed cannot be read.
    with os.fdopen(ours, 'rb', buffering=0) as terminal, suppress(OSError):
        while part := terminal.read(4096):
            seen += part
    assert process.wait() == 0
    assert b'replaying' in seen
    assert b'merging' in seen
