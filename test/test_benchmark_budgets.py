# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How the benchmark of budgets counts what merges say; real data, where it is there, once."""

import sys
from dataclasses import replace
from pathlib import Path

import pytest
from ros_processes import SHIPPED

from mapmerge_ros.fusion import FusionConfig, fuse
from mapmerge_ros.io import read_submaps

ROOT = Path(__file__).parents[1]
DATA = ROOT.parent / 'shared' / 'data'
sys.path.insert(0, str(ROOT / 'benchmarks'))

import budgets  # noqa: E402
from budgets import Said, counted  # noqa: E402


def said(**differences: object) -> Said:
    usual = {
        'merged': True,
        'accepted': True,
        'may_be_turned': False,
        'moved': False,
        'first': 'a',
        'included': True,
        'named': frozenset(),
    }
    return Said(**(usual | differences))  # type: ignore[arg-type]


EVERY = (
    said(),
    said(included=False, named=frozenset('a')),
    said(included=False, named=frozenset('ab')),
    said(included=False),  # neither named nor merged with the others
    said(named=frozenset('c'), moved=True),
    said(accepted=False, may_be_turned=True),
    said(merged=False),
)


def test_of_what_is_damaged_the_first_is_named_rightly() -> None:
    # merges, kept apart, accepted with it, it named, another named, may be turned, moved
    assert counted('bent', EVERY) == '7 | 1 | 2 | 2 | 2 | 1 | 1'


def test_where_nothing_is_wrong_whoever_is_named_is_named_wrongly() -> None:
    assert counted('nothing', EVERY) == '7 | 1 | 2 | – | 3 | 1 | 1'


def test_whether_the_first_is_included_is_read_from_the_map_that_comes_out() -> None:
    newest = {item.submap.map_id: item.submap for item in read_submaps(SHIPPED)}
    submaps = [newest[name] for name in sorted(newest)]
    together = Said.by(fuse(submaps))
    assert together.accepted
    assert together.included
    submaps[0] = replace(submaps[0], id_space='of nobody else')
    apart = Said.by(fuse(submaps, FusionConfig(match_descriptors=False)))
    assert apart.accepted
    assert not apart.named
    assert not apart.included


def test_rows_are_made_of_real_maps() -> None:
    folder = DATA / 'brighton_drone'
    if not folder.is_dir():
        pytest.skip(f'{folder} is not there: real data is not shipped')
    pytest.importorskip('pycolmap', reason='COLMAP models are read by pycolmap')
    rows = list(budgets.rows([folder], budgets=(24,), drawn=(30, 50), seeds=(0,)))
    assert rows[0] == '| chosen, 24 to 300 a map | nothing | 1 | 0 | 1 | – | 0 | 0 | 0 |'
    assert rows[1] == rows[0].replace('chosen, 24 to 300 a map', 'longest tracks, 24 to 300')
    assert rows[2] == '| by lot, 30 or 40 | nothing | 1 | 0 | 1 | – | 0 | 0 | 0 |'
    assert len(rows) == 4 + len(budgets.DAMAGES)
