# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What descriptors found between sub-maps is shown: by info, replay and the summary."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from mapmerge_ros.association import Decision, Evidence, PairMatch
from mapmerge_ros.bundle import compress
from mapmerge_ros.cli import console
from mapmerge_ros.cli.main import main
from mapmerge_ros.fusion import fuse
from mapmerge_ros.fusion.offline import choose_for_bundles
from mapmerge_ros.fusion.outcome import Match
from mapmerge_ros.io import read_submaps
from mapmerge_ros.io.drawing_graph import common_landmarks, map_graph
from mapmerge_ros.io.map_points import SEVERAL, map_points
from mapmerge_ros.io.match_rows import by_worth, tally, why_not, worth_showing
from mapmerge_ros.io.report import report_html
from mapmerge_ros.io.summary import summarise
from mapmerge_ros.io.truth import load_truth, truth_path
from mapmerge_ros.simulation import FleetConfig, simulate_fleet

from submaps import real_model  # isort: skip

pytest.importorskip('pycolmap', reason='pycolmap is missing: pip install mapmerge_ros[colmap]')

MATCH_KEYS = {'a', 'b', 'decision', 'reason', 'candidates', 'inliers', 'log_nfa', 'links'}
SCENE = ['--landmarks', '120', '--seed', '4', '--ids', 'private']


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four drones with private ids, whose descriptors differ as those of ORB do."""
    path = tmp_path_factory.mktemp('bags') / 'strangers.mcap'
    assert main(['simulate', str(path), *SCENE, '--flips', '0.1']) == 0
    return path


@pytest.fixture(autouse=True)
def in_tmp_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def match(a: str, b: str, decision: Decision, inliers: int = 20, links: int = 0) -> Match:
    evidence = Evidence(30, inliers, -float(inliers) if inliers else np.inf, 0.5, 0.9, 0.1)
    rows = np.zeros(0, np.int64)
    reason = '' if decision is Decision.JOINED else f'reason of {a} {b}'
    return Match(
        a, b, links, PairMatch(decision, reason, evidence, None, rows, rows, rows, rows, np.nan)
    )


def fleet_of(count: int) -> list[Match]:
    """Chain of sub-maps: neighbours joined, next ones undecided, the last is apart from all."""
    names = [f'm{k:02d}' for k in range(count)]
    kinds = {1: Decision.JOINED, 2: Decision.UNDECIDED}
    return [
        match(a, b, Decision.APART if b == names[-1] else kinds.get(j - i, Decision.APART), j)
        for (i, a), (j, b) in combinations(enumerate(names), 2)
    ]


def test_drones_with_private_ids_are_merged(bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['replay', str(bag)]) == 0
    printed = capsys.readouterr()
    assert printed.err == ''
    assert '6 pairs compared by descriptors: 5 joined, 1 apart.' in printed.out
    assert 'All 4 sub-maps were merged' in printed.out
    summary = json.loads(Path('strangers_merged/summary.json').read_text())
    assert summary['test']['accepted'] is True
    assert summary['truth']['median_error'] < 0.005 * summary['truth']['radius']
    matches = summary['matches']
    assert [set(row) for row in matches] == [MATCH_KEYS] * 6
    assert [(row['decision'], row['reason'] == '') for row in matches].count(('joined', True)) == 5
    (apart,) = [row for row in matches if row['decision'] == 'apart']
    assert apart['reason']
    assert apart['links'] == 0
    for row in matches:
        assert row['candidates'] >= row['inliers']
        assert row['log_nfa'] is None or row['log_nfa'] < 5.0


def test_what_is_compressed_with_private_ids_comes_from_descriptors(bag: Path) -> None:
    """No drone knows the truth: what it compresses is what can be found, and it is right."""
    truth = load_truth(truth_path(bag))
    maps = [item.submap for item in read_submaps(bag) if item.submap]
    true_ids = {
        x.map_id: dict(zip(x.own_ids.tolist(), x.true_ids.tolist(), strict=True))
        for x in truth.maps
    }
    held = [[true_ids[x.map_id][own] for own in x.compressed_ids.tolist()] for x in maps]
    names, views = np.unique(np.concatenate(held), return_counts=True)
    assert len(names) > 60
    assert (views >= 2).mean() > 0.98


@pytest.mark.parametrize('options', [['--flips', '0.4'], ['--no-descriptors']])
def test_drones_that_nothing_connects_announce(
    options: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(['simulate', 'apart.mcap', *SCENE, *options]) == 0
    assert 'only announced' in capsys.readouterr().err
    assert main(['info', 'apart.mcap']) == 0
    text = capsys.readouterr().out
    assert 'Announced only: drone0/0001, drone1/0001' in text
    if options == ['--no-descriptors']:
        assert 'drone2/0001: its landmark ids are private, and it has no descriptors' in text
    else:
        assert 'drone0/0001 – drone1/0001 apart: ' in text
    assert main(['replay', 'apart.mcap']) == 0
    text = capsys.readouterr().out
    assert 'drone3/0001 detached: an announcement' in text
    assert 'Nothing was merged' in text


def test_info_says_which_pairs_show_the_same_place(
    bag: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(console, 'PIPE_WIDTH', 80)
    assert main(['info', str(bag)]) == 0
    text = capsys.readouterr().out
    for expected in ('id space private', 'inliers', 'log NFA', 'common', 'joined'):
        assert expected in text
    assert text.count(' apart: ') == 1
    assert 'equal id' not in text
    tables = [line for line in text.splitlines() if ' – ' not in line and '.mcap' not in line]
    assert max(map(len, tables)) <= 80
    rows = [line.split() for line in tables if line.split()[-1:] == ['joined']]
    assert len(rows) == 5
    for a, b, inliers, of, candidates, *_ in rows:
        assert a < b
        assert of == 'of'
        assert int(inliers) <= int(candidates)


def test_of_many_pairs_the_useful_ones_are_shown() -> None:
    matches = fleet_of(12)
    shown = worth_showing(matches)
    assert len(shown) < len(matches) / 2
    kinds = [row.found.decision for row in shown]
    assert kinds.count(Decision.JOINED) == 10
    assert kinds.count(Decision.UNDECIDED) == 9
    assert kinds == sorted(kinds, key=list(Decision).index)
    assert {name for row in shown for name in (row.a, row.b)} == {f'm{k:02d}' for k in range(12)}
    assert worth_showing(matches[:10]) == by_worth(matches[:10])
    assert sorted(by_worth(matches), key=lambda row: (row.a, row.b)) == matches
    assert worth_showing(matches[::-1]) == shown


def test_words_about_pairs() -> None:
    matches = [
        match('a', 'b', Decision.JOINED, links=9),
        match('a', 'c', Decision.UNDECIDED),
        match('b', 'c', Decision.APART, 0, links=7),
    ]
    assert tally(matches) == '3 pairs compared by descriptors: 1 joined, 1 undecided, 1 apart.'
    assert tally([]) == ''
    assert [why_not(row) for row in matches] == [
        '',
        'reason of a c',
        'reason of b c; 7 landmarks in common, found through other sub-maps',
    ]


def test_all_pairs_are_shown_on_request(
    bag: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr('mapmerge_ros.io.match_rows.FEW', 2)
    monkeypatch.setattr('mapmerge_ros.io.match_rows.MAX_JOINED', 3)
    assert main(['info', str(bag)]) == 0
    assert '--all-pairs shows them' in capsys.readouterr().out
    assert main(['info', str(bag), '--all-pairs']) == 0
    text = capsys.readouterr().out
    assert text.count(' joined') == 1 + 5
    assert '--all-pairs' not in text


def test_real_models_without_ids_are_compressed_shown_and_merged(
    capsys: pytest.CaptureFixture[str],
) -> None:
    models = [str(real_model(f'brighton_drone/session_{k}')) for k in range(2)]
    assert main(['compress', *models, '-o', 'b.mcap', '--max-landmarks', '60']) == 0
    assert main(['info', 'b.mcap']) == 0
    assert '1 pair compared by descriptors: 1 joined.' in capsys.readouterr().out
    assert main(['replay', 'b.mcap']) == 0
    assert 'Both sub-maps were merged into one map of ' in capsys.readouterr().out
    (row,) = json.loads(Path('b_merged/summary.json').read_text())['matches']
    assert row['decision'] == 'joined'
    assert row['links'] > 200


def test_report_shows_pairs_with_reasons_and_escapes_them(bag: Path) -> None:
    evil = '<script>&'
    maps = [item.submap for item in read_submaps(bag) if item.submap]
    plain = fuse(maps)
    renamed = [replace(own, map_id=f'{evil}{k}') for k, own in enumerate(maps)]
    fusion = fuse(renamed)
    bad = replace(fusion.matches[0], found=replace(fusion.matches[0].found, reason=evil))
    bad = replace(bad, found=replace(bad.found, decision=Decision.UNDECIDED))
    fusion = replace(fusion, matches=(bad, *fusion.matches[1:]))
    html = report_html(fusion, summarise(fusion), evil).decode()
    honest = report_html(plain, summarise(plain), 'strangers').decode()
    assert html.count('<script') == honest.count('<script')
    assert html.count('&lt;script&gt;&amp;') > 20
    assert 'Who shows the same place' in html
    assert tally(fusion.matches) in html
    agree = f'>{bad.found.evidence.inliers}</data> of <data'
    assert agree in html
    assert '<tr class="why"><td colspan="5"><div>&lt;script&gt;&amp;; ' in html


def test_graph_joins_what_has_landmarks_in_common(bag: Path) -> None:
    fusion = fuse(item.submap for item in read_submaps(bag) if item.submap)
    drawn = map_graph(fusion)
    assert drawn.count('<circle') == 4
    assert drawn.count('<line') == 5
    assert 'class="undecided"' not in drawn
    open_pair = replace(
        fusion.matches[0],
        links=0,
        found=replace(fusion.matches[0].found, decision=Decision.UNDECIDED),
    )
    alone = replace(fusion, components=(), pairs=(), matches=(open_pair,))
    assert map_graph(alone).count('class="undecided"') == 1
    assert map_graph(replace(alone, matches=())) == ''
    assert common_landmarks(replace(fusion, matches=())) == {
        (pair.a, pair.b): pair.shared for pair in fusion.pairs
    }


def test_drawing_joins_catalogue_that_descriptors_joined() -> None:
    """Points that two maps have are one point, though nobody has compressed them."""
    fleet = simulate_fleet(FleetConfig(drones=2, landmarks=120, ids='private'), seed=4)
    chosen = choose_for_bundles(fleet.bundles, fleet.names, 15)
    fusion = fuse(
        compress(bundle, name, ids)
        for bundle, name, ids in zip(fleet.bundles, fleet.names, chosen, strict=True)
    )
    points = map_points(fusion)
    (found,) = fusion.matches
    assert points.landmark_count == 15
    assert (points.views == 2).sum() == found.links > 20
    assert (points.owners[points.views == 2] == SEVERAL).all()
    total = sum(len(bundle.point_ids) for bundle in fleet.bundles)
    assert len(points) == total - found.links
