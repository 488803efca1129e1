# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The benchmark of the merge runs, on a small fleet; no times are asserted."""

import ctypes
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('pycolmap', reason='the full bundle is solved by Ceres: pip install pycolmap')

sys.path.insert(0, str(Path(__file__).parents[1] / 'benchmarks'))

from merge import quick
from merge_bundle import seconds_until, share_until, standard_output
from merge_tables import rows_of, tables
from workloads import cached, workload


@pytest.fixture(scope='module')
def measured():
    return quick(workload('S2', drones=4))


def test_a_small_fleet_is_merged_as_well_as_it_is_bundled(measured):
    assert measured['bundle']['converged']
    assert measured['merge']['rmse_m'] < 1.02 * measured['bundle']['rmse_m']
    assert measured['dense']['rmse_m'] == pytest.approx(measured['merge']['rmse_m'], rel=1e-5)
    assert 0.8 < measured['merge']['variance_factor'] < 1.2
    assert measured['whole']['maps'] == 4
    assert measured['rewarm']['apart_m'] < 1e-4 * measured['merge']['rmse_m']


def test_when_the_bundle_is_nearly_done_is_read_from_the_last_table(measured):
    """Ceres writes a line for each step: number, cost, six more, seconds of it and of all."""
    assert 0.0 < measured['bundle']['nearly_s'] < 2.0 * measured['bundle']['wall_s']
    head = (
        'iter cost cost_change |gradient| |step| tr_ratio tr_radius ls_iter iter_time total_time'
    )

    def table(steps):
        gains = [0.0, *(before[0] - after[0] for before, after in pairwise(steps))]
        rows = [
            f'{k} {cost} {gain} 0 0 0 0 0 0.1 {done}'
            for k, ((cost, done), gain) in enumerate(zip(steps, gains, strict=True))
        ]
        return '\n'.join([head, *rows, ''])

    first = table([(9.0, 0.1), (1.0, 0.2)])
    last = table([(200.0, 0.5), (101.5, 1.0), (100.9, 2.0), (100.0, 4.0)])
    assert seconds_until(first + 'more text\n' + last, 1.01) == 2.0
    assert seconds_until(first + last, 1.02) == 1.0
    # A standard deviation of 50 degrees of freedom is 2.0: 0.9 are left after two seconds.
    assert share_until(first + last, 1.0, 50) == 1.0 * 1.0 / 4.0
    assert share_until(first + last, 0.7, 50) == 2.0 / 4.0
    assert share_until(first + last, 0.1, 50) == 1.0


def test_what_libraries_write_is_kept_from_the_standard_output(capfd):
    with standard_output() as written:
        ctypes.CDLL(None).puts(b'from C')
    ctypes.CDLL(None).puts(b'afterwards')
    ctypes.CDLL(None).fflush(None)
    assert written == ['from C\n']
    assert capfd.readouterr().out == 'afterwards\n'


def test_noise_of_both_signs_takes_out_what_is_luck_and_a_round_what_is_left(measured):
    accuracy = measured['accuracy']
    assert accuracy['draws'] == 2
    assert abs(accuracy['ratio'] - 1.0) < 0.01
    assert accuracy['apart_after_a_round'] < 0.1 * accuracy['apart'] < 0.02


def test_a_mirrored_workload_has_the_opposite_noise():
    """The mean of both maps of a drone is off the truth only by what is of second order."""
    pair = [workload('S2', drones=4, mirrored=mirrored) for mirrored in (False, True)]
    for k, (one, other) in enumerate(zip(*(load.submaps for load in pair), strict=True)):
        truth = pair[0].points_world(one.compressed_ids)
        S_world_map = pair[0].S_world_maps[k]
        off = [S_world_map.apply(each.compressed_points) - truth for each in (one, other)]
        assert np.abs(off[0] + off[1]).max() < 0.1 * np.abs(off[0]).max()


def test_the_tables_have_every_size_and_every_ratio(measured):
    found = {kind: {**values, 'growth_mb': 1.0} for kind, values in measured.items()}
    unfinished = {**found, 'bundle': {**found['bundle'], 'converged': False}}
    results = {
        'drones': {'S2': 16, 'S3': 64},
        'sizes': {'S2': found, 'S3': unfinished},
        'compression': {
            'choices': [
                {
                    'choice': choice,
                    'cpu_s': 0.1,
                    'dense_cpu_s': dense_cpu_s,
                    'difference': difference,
                    'keyframes': 60,
                    'points': 1000,
                    'landmarks': 100,
                }
                for choice, dense_cpu_s, difference in [('lot', 50.0, 1e-11), ('end', 60.0, 3e-11)]
            ]
        },
    }
    first, second = rows_of(results)
    assert first['ratio'] == pytest.approx(found['bundle']['cpu_s'] / found['merge']['cpu_s'])
    assert 'rmse_ratio' not in second
    page = tables(results)
    assert '| S3 | 64 |' in page
    assert 'at least 500 times' in page
    assert 'at most 3.0e-11' in page
    assert '| end |' in page


def test_a_workload_is_kept_in_a_file(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules['workloads'].DRONES, 'S1', 2)
    made, read = cached('S1', tmp_path), cached('S1', tmp_path, bundles=True)
    assert [s.map_id for s in made.submaps] == [s.map_id for s in read.submaps]
    assert (made.submaps[1].packed_r == read.submaps[1].packed_r).all()
    assert (len(made.bundles), len(read.bundles)) == (0, 2)
    assert read.revised.revision == 2
    assert read.revised.map_id == read.submaps[1].map_id
