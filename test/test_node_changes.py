# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What moved, and what is wrong as a whole, over real topics."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ros_processes import FUSION, REMEDY, Observer, load, observing, spin_until
from std_srvs.srv import Trigger

from mapmerge_ros.cli.main import main
from mapmerge_ros.cli.processes import Children, free_domain
from mapmerge_ros.nodes.quality import LATCHED_PROFILE
from mapmerge_ros.submap import SubMap

messages = pytest.importorskip('mapmerge_msgs.msg', reason=REMEDY)
DiagnosticStatus = pytest.importorskip('diagnostic_msgs.msg', reason=REMEDY).DiagnosticStatus
pytest.importorskip('pycolmap', reason='drones are simulated: pip install pycolmap')

NODE = '/fusion_node: fusion'


@pytest.fixture(scope='module')
def moved(tmp_path_factory: pytest.TempPathFactory) -> tuple[SubMap, ...]:
    """A recording in which an object moves between two drones' visits."""
    recording = tmp_path_factory.mktemp('recording') / 'moved.mcap'
    assert main(['simulate', str(recording), '--moved', '1', '--seed', '1']) == 0
    return load(recording)


@pytest.fixture
def children(tmp_path: Path) -> Iterator[Children]:
    with Children(free_domain(), tmp_path / 'logs') as started:
        yield started


@pytest.fixture
def observer(children: Children) -> Iterator[Observer]:
    with observing(children.domain) as node:
        yield node


def changes_of(observer: Observer) -> list[Any]:
    """The newest ChangeArray, last in the list."""
    heard: list[Any] = []
    observer.create_subscription(
        messages.ChangeArray, '/fusion_node/changes', heard.append, LATCHED_PROFILE
    )
    return heard


def level_of(observer: Observer) -> Any:
    return observer.diagnostics.get(NODE, (None,))[0]


def send(observer: Observer, submaps: tuple[SubMap, ...]) -> None:
    for submap in submaps:
        observer.send(f'/{submap.robot_id}/submap', submap)
    spin_until(
        [observer],
        lambda: observer.heard.is_complete and observer.heard.status.sub_maps == len(submaps),
        'all sub-maps in one merge',
    )


def test_one_object_is_told_and_after_reset_all_is_well(
    children: Children, observer: Observer, moved: tuple[SubMap, ...]
) -> None:
    children.start('fusion', FUSION, {'merge_period': 0.2})
    heard = changes_of(observer)
    send(observer, moved)
    kinds = messages.Change
    spin_until([observer], lambda: level_of(observer) == DiagnosticStatus.WARN, 'a warning')
    spin_until([observer], lambda: heard and heard[-1].changes, 'changes')
    members = [x for x in heard[-1].changes if x.kind == kinds.KIND_MOVED]
    assert {change.object_id for change in members} == {1}
    assert len({change.map_id for change in members}) == 1
    assert 'moved' in observer.diagnostics[NODE][1]
    assert observer.node_values['moved'] == str(len(members))
    assert observer.heard.status.accepted
    assert observer.call(Trigger, 'reset').success
    spin_until([observer], lambda: level_of(observer) == DiagnosticStatus.OK, 'all is well')
    assert children.ended() == ''


def test_quarantine_is_an_error_until_a_revision_fits(
    children: Children, observer: Observer, moved: tuple[SubMap, ...]
) -> None:
    children.start('fusion', FUSION, {'merge_period': 0.2})
    wrong = replace(moved[0], points=bent(moved[0].points))
    send(observer, (wrong, *moved[1:]))
    spin_until([observer], lambda: level_of(observer) == DiagnosticStatus.ERROR, 'an error')
    assert wrong.map_id in observer.diagnostics[NODE][1]
    level, text, values = observer.diagnostics[f'/fusion_node: robot {wrong.robot_id}']
    assert (level, values['state']) == (DiagnosticStatus.ERROR, 'quarantined')
    assert 'contradicts' in text
    item = next(x for x in observer.heard.alignments.alignments if x.map_id == wrong.map_id)
    assert item.state == messages.Alignment.STATE_REFUSED
    assert item.reason == text
    assert observer.heard.status.merged == len(moved) - 1
    observer.send(f'/{wrong.robot_id}/submap', replace(moved[0], revision=wrong.revision + 1))
    spin_until([observer], lambda: level_of(observer) != DiagnosticStatus.ERROR, 'it came back')
    spin_until([observer], lambda: observer.heard.status.merged == len(moved), 'all merged')


def bent(points: np.ndarray) -> np.ndarray:
    """Raised towards its ends by a fifth of half its length."""
    centred = points - points.mean(axis=0)
    axes = np.linalg.svd(centred, full_matrices=False)[2]
    along = centred @ axes[0]
    return np.asarray(points + np.outer(0.2 * along**2 / np.abs(along).max(), axes[2]))
