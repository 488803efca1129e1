# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The command line end to end: results, exit codes, one line for what a user can cause."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from mapmerge_ros.cli.main import main
from mapmerge_ros.cli.outputs import output_folder, ros_name
from mapmerge_ros.fusion import fuse
from mapmerge_ros.io import OutputError, read_submaps, write_submaps
from mapmerge_ros.io.summary import summarise

from commands import complaint, summary_of  # isort: skip
from submaps import random_submap  # isort: skip

pytest.importorskip('pycolmap', reason='pycolmap is missing: pip install mapmerge_ros[colmap]')

RESULTS = {'summary.json', 'landmarks.csv', 'global_map.mcap', 'global_map.ply', 'report.html'}


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recording of three simulated drones."""
    path = tmp_path_factory.mktemp('bags') / 'drones.mcap'
    options = ['--drones', '3', '--landmarks', '120', '--seed', '4']
    assert main(['simulate', str(path), *options]) == 0
    return path


@pytest.fixture(autouse=True)
def in_tmp_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def misuse(capsys: pytest.CaptureFixture[str], *argv: str | Path) -> str:
    """What a wrongly used command prints."""
    try:
        code = main([str(arg) for arg in argv])
    except SystemExit as err:
        code = err.code if isinstance(err.code, int) else -1
    assert code == 2
    return capsys.readouterr().err


def test_simulated_recording_is_small_and_has_its_truth(
    bag: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert bag.stat().st_size < 1_000_000
    truth = json.loads(bag.with_name('drones.truth.json').read_text())
    messages = list(read_submaps(bag))
    assert len({item.log_time_ns for item in messages}) == 3
    assert [item.topic for item in messages] == [f'/drone{k}/submap' for k in range(3)]
    assert {x['map_id'] for x in truth['maps']} == {
        item.submap.map_id for item in messages if item.submap
    }


def test_replay_needs_nothing_but_the_bag(bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['replay', str(bag)]) == 0
    printed = capsys.readouterr()
    assert printed.err == ''
    assert 'All 3 sub-maps were merged' in printed.out
    assert 'The test believes it' in printed.out
    assert 'Against the truth' in printed.out
    assert {path.name for path in Path('drones_merged').iterdir()} == RESULTS
    summary = summary_of('drones_merged')
    assert [row['state'] for row in summary['sub_maps']] == ['merged'] * 3
    assert summary['test']['accepted'] is True
    assert summary['truth']['median_error'] < 0.01 * summary['truth']['radius']


def test_truth_of_another_recording_is_not_used(
    bag: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path('other.mcap').write_bytes(bag.read_bytes())
    truth = bag.with_name('drones.truth.json').read_text()
    Path('other.truth.json').write_text(truth.replace('drone2/0001', 'drone9/0001'))
    assert main(['replay', 'other.mcap']) == 0
    printed = capsys.readouterr()
    assert 'other.truth.json: it is about another recording: drone2/0001' in printed.err
    assert 'Against the truth' not in printed.out
    assert 'truth' not in summary_of('other_merged')
    Path('other.truth.json').write_text('{')
    assert 'not a JSON file' in complaint(capsys, 'replay', 'other.mcap', '--out', 'new')
    assert not Path('new').exists()


def test_replay_is_what_fuse_says_of_the_values(bag: Path) -> None:
    assert main(['replay', str(bag), '--out', 'merged']) == 0
    direct = summarise(fuse(item.submap for item in read_submaps(bag) if item.submap))
    found = summary_of('merged')
    assert found['components'] == direct['components']
    assert found['pairs'] == direct['pairs']
    assert found['bytes_in'] == direct['bytes_in']
    assert found['test']['dof'] == direct['test']['dof']
    assert found['test']['a_tilde'] == pytest.approx(direct['test']['a_tilde'], rel=1e-6)
    for one, two in zip(found['sub_maps'], direct['sub_maps'], strict=True):
        np.testing.assert_allclose(
            one['global_from_map']['rotation'], two['global_from_map']['rotation'], atol=1e-7
        )


def test_replay_is_deterministic_at_any_rate(bag: Path) -> None:
    assert main(['replay', str(bag), '--out', 'one']) == 0
    assert main(['replay', str(bag), '--out', 'two', '--rate', '100']) == 0
    one, two = summary_of('one'), summary_of('two')
    one.pop('timing_s')
    two.pop('timing_s')
    assert one == two
    for name in ('landmarks.csv', 'global_map.ply', 'global_map.mcap'):
        assert Path('one', name).read_bytes() == Path('two', name).read_bytes()


def test_replay_exits_with_0_where_the_test_refuses(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(['simulate', 'fleet.mcap', '--drones', '3']) == 0
    assert main(['replay', 'fleet.mcap', '--significance', '0.999', '--out', 'merged']) == 0
    assert summary_of('merged')['test']['accepted'] is False
    assert 'The test does not believe it' in capsys.readouterr().out


def test_replay_tells_what_moved(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['simulate', 'moved.mcap', '--drones', '3', '--moved', '1']) == 0
    assert main(['replay', 'moved.mcap']) == 0
    summary = summary_of('moved_merged')
    assert summary['test']['accepted'] is True
    assert {change['kind'] for change in summary['changes']} >= {'moved'}
    assert 'moved together' in capsys.readouterr().out


def test_options_of_replay_reach_the_engine(bag: Path) -> None:
    options = ['--min-shared', '10000', '--significance', '0.2', '--max-landmarks', '5']
    assert main(['replay', str(bag), '--out', 'apart', *options]) == 0
    assert {row['state'] for row in summary_of('apart')['sub_maps']} == {'detached'}
    assert main(['replay', str(bag), '--out', 'few', '--max-landmarks', '20']) == 0
    (message,) = read_submaps('few/global_map.mcap')
    assert message.submap is not None
    assert message.submap.compressed_count == 20


def test_merged_maps_can_be_merged_again(bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['replay', str(bag), '--out', 'first']) == 0
    capsys.readouterr()
    reason = complaint(capsys, 'replay', 'first/global_map.mcap', '--out', 'second')
    assert '--map-id' in reason
    assert not Path('second').exists()
    assert main(['replay', 'first/global_map.mcap', '--map-id', 'all/0', '--out', 'second']) == 0


def test_info_shows_maps_and_pairs(bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['info', str(bag)]) == 0
    text = capsys.readouterr().out
    for expected in ('drone0/0001', 'fleet', 'binary 32', 'shared', '3 usable messages'):
        assert expected in text


def test_refused_messages_are_counted(bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['replay', str(bag), str(bag), '--out', 'twice']) == 0
    messages = summary_of('twice')['messages']
    assert messages['accepted'] == 3
    assert len(messages['refused']) == 3
    assert 'not taken in: drone0/0001: revision' in capsys.readouterr().out


@pytest.mark.parametrize('command', ['replay', 'info'])
def test_bad_bags_are_one_line(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert 'none.mcap: No such file' in complaint(capsys, command, 'none.mcap')
    Path('text.txt').write_text('hello')
    assert 'text.txt: not a bag' in complaint(capsys, command, 'text.txt')
    Path('bad.mcap').write_text('hello')
    assert 'bad.mcap: not a .mcap file' in complaint(capsys, command, 'bad.mcap')
    assert {path.name for path in Path.cwd().iterdir()} == {'text.txt', 'bad.mcap'}


def test_unwritable_outputs_are_one_line(bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path('file').write_text('precious')
    assert 'file: is a file' in complaint(capsys, 'replay', bag, '--out', 'file')
    assert 'file/x: ' in complaint(capsys, 'replay', bag, '--out', 'file/x')
    assert Path('file').read_text() == 'precious'
    assert 'folder no is missing' in complaint(capsys, 'simulate', 'no/o.mcap')
    assert 'has to end in .mcap' in complaint(capsys, 'simulate', 'o.bag')
    Path('dir.mcap').mkdir()
    assert 'is a folder' in complaint(capsys, 'simulate', 'dir.mcap')


def test_impossible_simulations_are_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert 'moved: 99 objects' in complaint(capsys, 'simulate', 'o.mcap', '--moved', '99')
    assert list(Path.cwd().iterdir()) == []


@pytest.mark.parametrize(
    ('argv', 'expected'),
    [
        ([], 'COMMAND'),
        (['merge'], "invalid choice: 'merge'"),
        (['replay'], 'BAG'),
        (['replay', 'x.mcap', '--rate', 'fast'], "'fast' is not a number"),
        (['replay', 'x.mcap', '--rate', '-1'], 'not a number above 0'),
        (['replay', 'x.mcap', '--significance', '5'], 'not between 0 and 1'),
        (['replay', 'x.mcap', '--min-shared', '0'], 'whole number from 1'),
        (['replay', 'x.mcap', '--min-shared', '2'], 'mapmerge: --min-shared: 2'),
        (['simulate', 'o.mcap', '--gauge', '5'], 'not 7 (monocular)'),
        (['compress', 'a', '-o', 'o.mcap', '--landmarks', 'best'], 'not matched, all or a'),
        (['compress', 'a'], '-o'),
        (['compress', 'a', './a', '-o', 'o.mcap', '--id-space', 'x'], 'a: given twice'),
    ],
)
def test_wrong_usage_exits_with_2(
    argv: list[str], expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert expected in misuse(capsys, *argv)
    assert list(Path.cwd().iterdir()) == []


@pytest.mark.parametrize('command', ['', 'compress', 'replay', 'info', 'simulate', 'demo'])
def test_help_is_there(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main([*filter(None, [command]), '--help'])
    assert caught.value.code == 0
    assert 'mapmerge' in capsys.readouterr().out


def test_topics_are_valid_for_any_robot() -> None:
    assert [ros_name(x) for x in ('drone3', 'a b/c', '3', '__x__', 'Bär', '/')] == [
        'drone3', 'a_b_c', 'robot_3', 'x', 'B_r', 'robot',
    ]  # fmt: skip


def test_a_folder_made_for_nothing_is_gone_again(tmp_path: Path) -> None:
    folder = tmp_path / 'a' / 'b'
    with pytest.raises(OutputError), output_folder(folder):
        raise OutputError('later')
    assert not (tmp_path / 'a').exists()


def test_bags_without_a_usable_map_say_why(capsys: pytest.CaptureFixture[str]) -> None:
    own = random_submap(np.random.default_rng(0), map_id='fusion/global')
    write_submaps('own.mcap', [('/x/submap', 1, own)])
    reason = complaint(capsys, 'replay', 'own.mcap')
    assert 'own.mcap: no usable sub-map: fusion/global' in reason
    assert not Path('own_merged').exists()
