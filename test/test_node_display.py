# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What RViz and Foxglove are given: points, markers, frames; all of it latched."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ros_processes import FUSION, REMEDY, Observer, observing, spin_until
from test_node_fleets import submap_of

from mapmerge_ros.cli.processes import Children, free_domain
from mapmerge_ros.fusion import FusionConfig, Snapshot, State, fuse
from mapmerge_ros.io.map_points import map_points
from mapmerge_ros.io.palette import SHARED
from mapmerge_ros.submap import SubMap

PointCloud2 = pytest.importorskip('sensor_msgs.msg', reason=REMEDY).PointCloud2
visualization = pytest.importorskip('visualization_msgs.msg', reason=REMEDY)

from mapmerge_ros.nodes.cloud import POINT, make_cloud, pack, robot_colours  # noqa: E402
from mapmerge_ros.nodes.frames import MISSING, TFMessage, placeable  # noqa: E402
from mapmerge_ros.nodes.markers import axes  # noqa: E402

WARM = 1e-7
"""What a merge that went on from another may leave; std of these frames is 1e-2 and more."""


def test_a_late_viewer_gets_points_markers_and_frames(
    children: Children, observer: Observer, drones: tuple[SubMap, ...]
) -> None:
    children.start('fusion', FUSION, {'merge_period': 0.2, 'max_ellipsoids': 7})
    for submap in drones:
        observer.send(f'/{submap.robot_id}/submap', submap)
    spin_until([observer], lambda: observer.merged == len(drones), 'all merged')
    points = observer.latest(PointCloud2, '/fusion_node/points')
    markers = observer.latest(visualization.MarkerArray, '/fusion_node/markers')
    frames = observer.latest(TFMessage, '/tf_static') if TFMessage else {'message': None}
    spin_until([observer], lambda: points and markers and frames, 'the latest of each')

    fusion = fuse(drones, FusionConfig(map_id='fusion_node/global'))
    cloud = points['message']
    assert cloud.header.frame_id == 'global'
    assert [field.name for field in cloud.fields] == ['x', 'y', 'z', 'rgb', 'std', 'views']
    found = np.frombuffer(bytes(cloud.data), POINT)
    expected = map_points(fusion)
    assert len(found) == cloud.width == len(expected)
    xyz = np.column_stack([found['x'], found['y'], found['z']])
    np.testing.assert_allclose(xyz, expected.points_global, rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(found['views'], expected.views)
    palette = {packed(colour) for colour in (*robot_colours(fusion).values(), SHARED)}
    assert set(found['rgb'].tolist()) == palette
    known = np.isfinite(found['std'])
    assert known.sum() == expected.landmark_count
    assert (found['std'][known] > 0.0).all()
    assert_markers(markers['message'].markers, fusion, drones)
    if TFMessage is None:
        assert MISSING in children.log('fusion').read_text()
    else:
        assert_frames(frames['message'].transforms, fusion)
    assert children.ended() == ''


def packed(colour: tuple[int, int, int]) -> int:
    return (colour[0] << 16) | (colour[1] << 8) | colour[2]


def assert_markers(markers: Any, fusion: Any, drones: tuple[SubMap, ...]) -> None:
    kind = visualization.Marker
    assert markers[0].action == kind.DELETEALL
    by_namespace: dict[str, list[Any]] = {}
    for marker in markers[1:]:
        by_namespace.setdefault(marker.ns, []).append(marker)
        assert marker.header.frame_id == 'global'
        if marker.type == kind.SPHERE:
            assert min(marker.scale.x, marker.scale.y, marker.scale.z) > 0.0
    (links,) = by_namespace['links']
    joined = [pair for pair in fusion.pairs if pair.shared]
    assert len(links.points) == 2 * len(joined) > 0
    assert {marker.text for marker in by_namespace['labels']} == {x.map_id for x in drones}
    assert len(by_namespace['landmark_std']) == 7
    assert len(by_namespace['frames']) == len(drones)
    # The one that holds the global frame has no uncertainty.
    assert len(drones) - 1 <= len(by_namespace['frame_std']) <= len(drones)


def assert_frames(transforms: Any, fusion: Any) -> None:
    items = {item.submap.frame_id: item for item in fusion.in_state(State.MERGED)}
    assert {x.child_frame_id for x in transforms} == set(items)
    for sent in transforms:
        assert sent.header.frame_id == 'global'
        at, turn = sent.transform.translation, sent.transform.rotation
        S_global_map = items[sent.child_frame_id].S_global_map
        # On a busy machine the node has merged before all were there: what a warm merge leaves.
        np.testing.assert_allclose([at.x, at.y, at.z], S_global_map.translation, atol=WARM)
        x, y, z, w = turn.x, turn.y, turn.z, turn.w
        # First column of the rotation.
        column = [1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)]
        np.testing.assert_allclose(column, S_global_map.rotation[:, 0], atol=WARM)


def test_what_moved_is_told_and_drawn(children: Children, observer: Observer) -> None:
    pytest.importorskip('pycolmap', reason='simulated maps are bundled by Ceres')
    from mapmerge_msgs.msg import Change, ChangeArray

    from mapmerge_ros.simulation import FleetConfig, simulate_fleet

    fleet = simulate_fleet(FleetConfig(moved=1), 1).submaps()
    children.start('fusion', FUSION, {'merge_period': 0.2})
    for submap in fleet:
        observer.send(f'/{submap.robot_id}/submap', submap)
    spin_until([observer], lambda: observer.merged == len(fleet), 'all merged')
    changes = observer.latest(ChangeArray, '/fusion_node/changes')
    markers = observer.latest(visualization.MarkerArray, '/fusion_node/markers')
    spin_until([observer], lambda: changes and markers, 'the latest of each')
    told = changes['message'].changes
    moved = [change for change in told if change.kind == Change.KIND_MOVED]
    assert len(moved) >= 5
    arrows = [marker for marker in markers['message'].markers if marker.ns == 'changes']
    assert len(arrows) == len(told)
    for change, arrow in zip(told, arrows, strict=True):
        tail, tip = arrow.points
        assert tip == change.position
        assert tip.x - tail.x == pytest.approx(change.displacement.x, abs=1e-9)
    spin_until(
        [observer],
        lambda: observer.node_values.get('moved') == str(len(moved)),
        'the diagnostics count them',
    )


@pytest.fixture(scope='module')
def small() -> tuple[SubMap, ...]:
    """Maps of one small scene: fused in no time."""
    return tuple(submap_of(0, k, 1, k) for k in range(4))


def test_the_rounding_of_the_cloud_is_in_its_std() -> None:
    """Two drones in UTM coordinates, known to 5 mm: in float32 they are not."""
    rng = np.random.default_rng(0)
    near = rng.uniform(-50.0, 50.0, (400, 3))
    for origin in (np.zeros(3), np.array([448_262.0, 5_411_932.0, 300.0])):
        points = origin + near
        found = np.frombuffer(pack(points, 0, 0.005, 1).data, POINT)
        xyz = np.column_stack([found['x'], found['y'], found['z']]).astype(np.float64)
        errors = np.linalg.norm(xyz - points, axis=1)
        allowed = np.sqrt(np.mean(found['std'].astype(np.float64) ** 2))
        assert np.sqrt(np.mean(errors**2)) < 1.1 * allowed
        assert (allowed < 0.0051) == (not origin.any())


def test_colours_do_not_depend_on_the_order_of_arrival(small: tuple[SubMap, ...]) -> None:
    there, back = fuse(small), fuse(Snapshot(small[::-1]))
    assert robot_colours(there) == robot_colours(back)
    assert make_cloud(there).data == make_cloud(back).data


def test_frames_that_collide_are_left_out_and_named(small: tuple[SubMap, ...]) -> None:
    first, second, *others = small
    named = [replace(first, frame_id='map'), replace(second, frame_id='/map'), *others]
    placed, problems = placeable(fuse(named), 'global')
    assert {x.submap.map_id for x in placed} == {x.map_id for x in others}
    assert problems == ["frame 'map' belongs to 2 sub-maps: none of them is in TF"]
    named = [replace(first, frame_id='global'), second, *others]
    placed, problems = placeable(fuse(named), 'global')
    assert len(placed) == len(small) - 1
    assert len(problems) == 1


def test_nothing_is_drawn_of_nothing() -> None:
    assert make_cloud(fuse(())).data == b''


def test_axes_of_an_ellipsoid() -> None:
    rng = np.random.default_rng(0)
    half = rng.normal(size=(3, 3))
    covariance = half @ half.T
    diameters, rotation = axes(covariance, 1e2)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    rebuilt = rotation @ np.diag((diameters / 4.0) ** 2) @ rotation.T
    np.testing.assert_allclose(rebuilt, covariance, atol=1e-9)
    assert (axes(np.diag([1e9, 1.0, 0.0]), 5.0)[0] <= 10.0).all()
    assert (axes(np.zeros((3, 3)), 5.0)[0] > 0.0).all()


def test_without_tf2_messages_there_is_one_line_and_all_the_rest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small: tuple[SubMap, ...]
) -> None:
    (tmp_path / 'tf2_msgs').mkdir()
    (tmp_path / 'tf2_msgs' / '__init__.py').write_text("raise ImportError('not installed')\n")
    paths = [str(tmp_path), *filter(None, [os.environ.get('PYTHONPATH')])]
    monkeypatch.setenv('PYTHONPATH', os.pathsep.join(paths))
    with (
        Children(free_domain(), tmp_path / 'logs') as children,
        observing(children.domain) as observer,
    ):
        children.start('fusion', FUSION, {'merge_period': 0.1})
        for submap in small:
            observer.send('/submaps', submap)
        points = observer.latest(PointCloud2, '/fusion_node/points')
        spin_until(
            [observer],
            lambda: (
                points
                and observer.heard.is_complete
                and observer.heard.status.merged == len(small)
            ),
            'all merged',
        )
        assert children.log('fusion').read_text().count(MISSING) == 1
        assert not observer.get_publishers_info_by_topic('/tf_static')
