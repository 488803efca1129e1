# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The benchmark of the merge runs, on a small fleet; no times are asserted."""

import sys
from pathlib import Path

import pytest

pytest.importorskip('pycolmap', reason='the full bundle is solved by Ceres: pip install pycolmap')

sys.path.insert(0, str(Path(__file__).parents[1] / 'benchmarks'))

from merge import run_bundle, run_fuse, run_merge
from workloads import cached, workload


def test_a_small_fleet_is_merged_as_well_as_it_is_bundled():
    load = workload('S2', drones=4)
    merged, bundled = run_merge(load), run_bundle(load)
    assert bundled['converged']
    assert merged['rmse_m'] < 1.02 * bundled['rmse_m']
    assert 0.8 < merged['variance_factor'] < 1.2
    assert run_fuse(load)['maps'] == 4


def test_a_workload_is_kept_in_a_file(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules['workloads'].DRONES, 'S1', 2)
    made, read = cached('S1', tmp_path), cached('S1', tmp_path)
    assert [s.map_id for s in made.submaps] == [s.map_id for s in read.submaps]
    assert (made.submaps[1].packed_r == read.submaps[1].packed_r).all()
