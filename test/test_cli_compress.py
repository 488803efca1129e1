# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`mapmerge compress`: from a model to a message."""

from __future__ import annotations

from pathlib import Path

import pytest

from mapmerge_ros.cli.main import main
from mapmerge_ros.cli.names import robot_names
from mapmerge_ros.cli.options import UsageError
from mapmerge_ros.io import read_submaps

from commands import complaint, summary_of  # isort: skip
from submaps import real_model  # isort: skip

pytest.importorskip('pycolmap', reason='pycolmap is missing: pip install mapmerge_ros[colmap]')


@pytest.fixture(autouse=True)
def in_tmp_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_bad_models_are_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    Path('empty').mkdir()
    assert 'empty: not a COLMAP model' in complaint(capsys, 'compress', 'empty', '-o', 'o.mcap')
    assert 'no such folder' in complaint(capsys, 'compress', 'none', '-o', 'o.mcap')
    model = Path('pointless')
    model.mkdir()
    (model / 'cameras.txt').write_text('1 PINHOLE 640 480 500 500 320 240\n')
    (model / 'images.txt').write_text('1 1 0 0 0 0 0 0 1 a.jpg\n\n')
    (model / 'points3D.txt').write_text('')
    assert 'without points' in complaint(capsys, 'compress', model, '-o', 'o.mcap')
    assert not Path('o.mcap').exists()


def test_models_are_matched_and_merged(capsys: pytest.CaptureFixture[str]) -> None:
    models = [real_model(f'brighton_drone/session_{k}') for k in range(2)]
    common = ['-o', 'b.mcap', '--id-space', 'b']
    assert main(['compress', *map(str, models), *common, '--max-landmarks', '60']) == 0
    maps = [item.submap for item in read_submaps('b.mcap')]
    assert [(x.map_id, x.robot_id, x.compressed_count) for x in maps if x] == [
        ('session_0/0000', 'session_0', 60),
        ('session_1/0000', 'session_1', 60),
    ]
    assert main(['replay', 'b.mcap']) == 0
    assert summary_of('b_merged')['pairs'][0]['shared'] == 60


def test_options_of_compress_reach_the_message(capsys: pytest.CaptureFixture[str]) -> None:
    model = real_model('brighton_drone/session_0')
    options = ['--robot', 'Bär 3', '--landmarks', '20', '--sigma', '0.5', '--gauge', '6']
    assert main(['compress', str(model), '-o', 'a.mcap', *options, '--no-catalogue']) == 0
    (item,) = read_submaps('a.mcap')
    assert item.submap is not None
    assert (item.topic, item.submap.map_id) == ('/B_r_3/submap', 'Bär 3/0000')
    assert (item.submap.sigma, int(item.submap.gauge)) == (0.5, 6)
    assert len(item.submap.landmark_ids) == item.submap.compressed_count == 20


def test_a_model_with_nothing_to_share_is_announced(capsys: pytest.CaptureFixture[str]) -> None:
    model = real_model('brighton_drone/session_0')
    argv = ['compress', str(model), '-o', 'a.mcap', '--id-space', 'x', '--landmarks', 'matched']
    assert main(argv) == 0
    assert 'warning: session_0/0000: only announced' in capsys.readouterr().err
    (item,) = read_submaps('a.mcap')
    assert item.submap is not None
    assert item.submap.compressed_count == 0
    assert len(item.submap.landmark_ids) > 1000
    assert main(['replay', 'a.mcap']) == 0
    assert summary_of('a_merged')['sub_maps'][0]['state'] == 'detached'


def test_too_large_a_message_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    model = real_model('caliterra_drone/session_1')
    argv = ['compress', model, '-o', 'a.mcap', '--landmarks', 'all']
    assert 'choose fewer' in complaint(capsys, *argv)
    assert not Path('a.mcap').exists()


def test_robots_are_named_by_what_tells_their_folders_apart() -> None:
    paths = [Path('/x/a/model'), Path('/x/b/model'), Path('/x/c/other')]
    assert robot_names(paths[::2]) == ['model', 'other']
    assert robot_names(paths) == ['a_model', 'b_model', 'c_other']
    assert robot_names([Path('/x/a/sparse/0'), Path('/x/b/sparse')]) == ['a', 'b']
    assert len(set(robot_names([Path('/a_b/c'), Path('/a/b_c')]))) == 2
    with pytest.raises(UsageError, match='given twice'):
        robot_names([Path('/x/a'), Path('/x/../x/a')])
