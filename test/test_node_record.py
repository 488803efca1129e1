# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Recorded from running nodes, replayed, and gone on with from a saved state."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from ros_processes import FUSION, RECORDER, Observer, spin_for, spin_until
from rosbags.rosbag2 import Reader

from mapmerge_ros.cli.main import main
from mapmerge_ros.cli.processes import Children
from mapmerge_ros.fusion import FusionEngine
from mapmerge_ros.io import decode_submap, encode_submap, write_submaps
from mapmerge_ros.io.bags import read_raw
from mapmerge_ros.io.state import save_state
from mapmerge_ros.io.typestore import SUBMAP
from mapmerge_ros.nodes import record_node
from mapmerge_ros.submap import SubMap


def test_what_was_said_is_recorded_what_was_latched_before_too(
    children: Children, observer: Observer, drones: tuple[SubMap, ...], tmp_path: Path
) -> None:
    file = tmp_path / 'site.mcap'
    observer.send('/a/submap', drones[0])
    children.start('fusion', FUSION, {'merge_period': 0.2})
    command = [sys.executable, '-m', 'mapmerge_ros.cli.main', 'record', '-o', str(file)]
    log = (tmp_path / 'record.log').open('wb')
    recorder = subprocess.Popen(
        command, stdout=log, stderr=subprocess.STDOUT, env=os.environ, start_new_session=True
    )
    try:
        spin_until([observer], lambda: observer.heard_by('/a/submap') == 2, 'both listen')
        observer.send('/b/submap', drones[1], latched=False)
        spin_until([observer], lambda: observer.heard_by('/b/submap') == 2, 'both listen')
        observer.send('/b/submap', drones[1], latched=False)
        spin_until(
            [observer],
            lambda: observer.heard.is_complete and observer.heard.status.merged >= 2,
            'a map',
        )
        words = (tmp_path / 'record.log').read_text
        results = [f'/fusion_node/{name}' for name in ('alignments', 'global_map', 'status')]
        spin_until([observer], lambda: all(x in words() for x in results), 'results')
    finally:
        recorder.send_signal(signal.SIGINT)  # to this process alone, as a supervisor does
        assert recorder.wait(20) == 0, words()
        log.close()
    assert 'messages of' in words()
    raw = set(read_raw(file, SUBMAP))
    assert {encode_submap(drones[0]), encode_submap(drones[1])} <= raw
    with Reader(file) as reader:
        topics = {x.topic for x in reader.connections if x.msgcount}
    assert set(results) <= topics
    assert main(['info', str(file)]) == 0


def test_a_replay_goes_on_from_a_state(drones: tuple[SubMap, ...], tmp_path: Path) -> None:
    engine, half = FusionEngine(), len(drones) // 2
    for submap in drones[:half]:
        engine.add(submap)
    engine.fuse()
    save_state(tmp_path / 'state.mcap', engine.state(), 0)

    def replayed(name: str, part: tuple[SubMap, ...], *more: str) -> Any:
        bag, out = tmp_path / f'{name}.mcap', tmp_path / name
        write_submaps(bag, [('/submaps', k, submap) for k, submap in enumerate(part)])
        assert main(['replay', str(bag), '--out', str(out), *more]) == 0
        return json.loads((out / 'summary.json').read_text())

    whole = replayed('whole', drones)
    rest = replayed('rest', drones[half:], '--resume', str(tmp_path / 'state.mcap'))
    assert [item['map_id'] for item in rest['sub_maps']] == [x.map_id for x in drones]
    assert rest['test']['a_tilde'] == pytest.approx(whole['test']['a_tilde'], rel=1e-9)
    assert [x['state'] for x in rest['sub_maps']] == [x['state'] for x in whole['sub_maps']]
    missing = ['replay', str(tmp_path / 'whole.mcap'), '--resume', str(tmp_path / 'no.mcap')]
    assert main([*missing, '--out', str(tmp_path / 'x')]) == 1


def test_record_ends_at_sigterm_with_a_whole_file(
    children: Children, observer: Observer, drones: tuple[SubMap, ...], tmp_path: Path
) -> None:
    file = tmp_path / 'site.mcap'
    observer.send('/a/submap', drones[0])
    command = [sys.executable, '-m', 'mapmerge_ros.cli.main', 'record', '-o', str(file)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, env=os.environ) as recorder:
        spin_until([observer], lambda: observer.heard_by('/a/submap'), 'it listens')
        spin_for([observer], 0.5)
        recorder.terminate()
        assert recorder.wait(20) == 0
    assert list(read_raw(file, SUBMAP)) == [encode_submap(drones[0])]


def test_what_is_latched_is_written_once_whoever_leaves(
    children: Children, observer: Observer, drones: tuple[SubMap, ...], tmp_path: Path
) -> None:
    file, topic = tmp_path / 'site.mcap', '/submaps'
    observer.send(topic, drones[0])
    recorder = children.start('recorder', RECORDER, {'output': str(file)})
    spin_until([observer], lambda: observer.heard_by(topic) == 1, 'it listens')
    spin_for([observer], 0.5)
    for revision in (2, 3):
        # The first of a volatile robot is gone before the recorder has found it.
        observer.send(topic, drones[1], latched=False)
        spin_until([observer], lambda: observer.heard_by(topic) == 2, 'both are heard')
        observer.send(topic, replace(drones[1], revision=revision), latched=False)
        spin_for([observer], 0.5)
        observer.destroy_publisher(observer._senders.pop((topic, True, False)))
        spin_for([observer], 1.0)
    # Who says the same again has said it twice.
    observer.send(topic, drones[0])
    spin_for([observer], 0.5)
    recorder.terminate()
    assert recorder.wait(20) == 0
    found = [decode_submap(raw) for raw in read_raw(file, SUBMAP)]
    assert [(x.map_id, x.revision) for x in found if x.map_id == drones[0].map_id] == [
        (drones[0].map_id, drones[0].revision)
    ] * 2
    assert [x.revision for x in found if x.revision > 1] == [2, 3]


def test_what_is_known_is_no_news() -> None:
    known = record_node.Known()
    assert known.is_news(b'a', 1)
    assert not known.is_news(b'a', 1)
    assert known.is_news(b'a', 2), 'said again'
    assert known.is_news(b'b', 1)
    assert known.is_news(b'a', 0)
    assert known.is_news(b'a', 0), 'a middleware that does not tell the time'


def test_memory_of_what_was_written_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(record_node, 'REMEMBERED', 2)
    known = record_node.Known()
    for published_ns in (1, 2, 3):
        assert known.is_news(b'a', published_ns)
    assert not known.is_news(b'a', 3)
    assert not known.is_news(b'a', 2)
    assert known.is_news(b'a', 1)


def test_record_says_what_is_wrong(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['record', '-o', 'x.bag']) == 2
    assert main(['record', '-o', 'x.mcap', '--topics', '(']) == 2
    errors = capsys.readouterr().err.splitlines()
    assert len(errors) == 2
    assert '.mcap' in errors[0]
