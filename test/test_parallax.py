# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Points without parallax: a robot that turns on the spot, a point at the horizon."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scenes import random_bundle, seen_only, with_a_turn_on_the_spot, without_points

from mapmerge_ros.bundle import Bundle, MapName, announce, compress, linearise
from mapmerge_ros.bundle.elimination import held, is_determined, point_information
from mapmerge_ros.bundle.relinearise import relinearise
from mapmerge_ros.io import (
    InvalidMessage,
    NamedBundle,
    decode_bundle,
    decode_bundle_name,
    encode_bundle,
)
from mapmerge_ros.nodes.own_map import OwnMap

NAME = MapName('drone/0001', 'drone', 7, 5, 'drone/map', 'fleet')


def sent(bundle: Bundle) -> NamedBundle:
    """Return what arrives of a bundle."""
    stamps = (0,) * len(bundle.keyframe_ids)
    return decode_bundle(encode_bundle(NamedBundle(NAME, bundle, stamps)))


def at_the_horizon(bundle: Bundle, depth: float) -> Bundle:
    """Move the last point away from the first key frame, along its ray."""
    R, t = bundle.rotations_camera_map[0], bundle.translations_camera_map[0]
    far = np.array(bundle.points)
    far[-1] = R.T @ (depth * (R @ far[-1] + t) - t)
    return replace(bundle, points=far)


@pytest.mark.parametrize('turn_rad', [0.0, 0.02, 0.1, 0.3])
@pytest.mark.parametrize('depth', [1.0, 10.0, 1e6])
def test_a_point_without_parallax_goes_and_the_others_are_as_good_as_before(
    turn_rad: float, depth: float
) -> None:
    for seed in range(5):
        whole = at_the_horizon(with_a_turn_on_the_spot(random_bundle(seed), turn_rad), depth)
        found, expected = sent(whole), sent(without_points(whole, [999]))
        assert (found.undetermined, expected.undetermined) == (1, 0)
        ids = expected.bundle.point_ids[:10]
        for some in ((), ids):
            one, other = (compress(x.bundle, NAME, some) for x in (found, expected))
            np.testing.assert_array_equal(one.landmark_ids, other.landmark_ids)
            np.testing.assert_array_equal(one.covariances, other.covariances)
            np.testing.assert_array_equal(one.packed_r, other.packed_r)
        assert len(OwnMap(found, 5).announced.landmark_ids) == 30


def test_little_parallax_is_parallax() -> None:
    """A thousandth of the depth: it knows little about the distance, and says so."""
    whole = with_a_turn_on_the_spot(random_bundle(0))
    shifts = np.array(whole.translations_camera_map)
    shifts[-1] += [9e-3, 0.0, 0.0]
    found = sent(replace(whole, translations_camera_map=shifts))
    assert found.undetermined == 0
    assert 999 in found.bundle.point_ids


def test_too_few_with_parallax_are_refused_by_name() -> None:
    whole = with_a_turn_on_the_spot(random_bundle(0))
    last = len(whole.keyframe_ids) - 1
    two = seen_only(whole, np.isin(whole.observation_keyframes, [0, last]))
    with pytest.raises(InvalidMessage, match=r'drone/0001.*too few.* have no parallax'):
        sent(two)


def test_compression_of_such_a_point_says_that_nothing_is_known() -> None:
    """Whoever makes a bundle without messages gets no noise of cancelled digits either."""
    whole = with_a_turn_on_the_spot(random_bundle(0))
    rest = without_points(whole, [999])
    for some in ((), rest.point_ids[:10]):
        found, expected = compress(whole, NAME, some), compress(rest, NAME, some)
        assert found.covariances is not None
        assert expected.covariances is not None
        traces = {
            int(key): float(row[[0, 3, 5]].sum())
            for key, row in zip(found.landmark_ids, found.covariances, strict=True)
        }
        assert np.isfinite(found.covariances).all()
        others = [traces[int(key)] for key in expected.landmark_ids]
        assert traces[999] > 1e6 * max(others)
        np.testing.assert_allclose(
            found.covariances[found.landmark_ids != 999], expected.covariances, rtol=0.05
        )


def test_a_bundle_with_such_a_point_follows_the_global_map() -> None:
    whole = with_a_turn_on_the_spot(random_bundle(0))
    moved = whole.points[:10] + 0.01 * np.random.default_rng(1).normal(size=(10, 3))
    found = relinearise(whole, whole.point_ids[:10], moved).bundle
    assert np.isfinite(found.points).all()


def test_information_is_held_where_it_is_weak_alone() -> None:
    information = point_information(linearise(with_a_turn_on_the_spot(random_bundle(0))))
    information[0], information[1] = np.nan, 0.0
    determined = is_determined(information)
    assert not determined[[0, 1, -1]].any()
    assert determined[2:-1].all()
    assert (np.linalg.eigvalsh(held(information)[-1]) > 0.0).all()
    np.testing.assert_array_equal(held(information)[2:-1], information[2:-1])


def test_models_say_how_many_points_are_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pycolmap = pytest.importorskip('pycolmap', reason='the extra colmap is not installed')
    from colmap_models import synthetic, write

    from mapmerge_ros.cli.main import main
    from mapmerge_ros.io import load_bundles, load_colmap, read_submaps

    model = synthetic('PINHOLE')
    expected = len(load_colmap(write(model, tmp_path / 'before')).point_ids)
    turn_on_the_spot(model, pycolmap)
    folder = write(model, tmp_path / 'model')
    (named,) = load_bundles(folder)
    assert named.undetermined == 1
    assert len(named.bundle.point_ids) == expected
    out = tmp_path / 'out.mcap'
    assert main(['compress', str(folder), '-o', str(out)]) == 0
    assert 'model/0000: 1 landmark left out' in ' '.join(capsys.readouterr().err.split())
    (item,) = read_submaps(out)
    assert item.submap is not None
    assert len(item.submap.landmark_ids) == expected


def turn_on_the_spot(model: Any, pycolmap: Any) -> None:
    """Add an image at the place of the first, and a point that only these two see."""
    first = model.images[min(model.reg_image_ids())]
    pose, camera = first.cam_from_world(), first.camera
    turn = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.0, 0.05, 0.0])), np.zeros(3))
    xyz = pose.inverse() * np.array([0.1, 0.1, 5.0])
    keys = [point.point3D_id for point in first.points2D if point.has_point3D()]
    places = [model.points3D[key].xyz for key in keys] + [xyz]
    pixels = [camera.img_from_cam((turn * pose) * place) for place in places]
    image = pycolmap.Image('again.png', np.array(pixels), camera.camera_id, 9999)
    model.add_image_with_trivial_frame(image, turn * pose)
    first.points2D.append(pycolmap.Point2D(camera.img_from_cam(pose * xyz)))
    for row, key in enumerate(keys):
        if np.isfinite(pixels[row]).all():
            model.add_observation(key, pycolmap.TrackElement(9999, row))
    track = pycolmap.Track()
    track.add_element(first.image_id, len(first.points2D) - 1)
    track.add_element(9999, len(keys))
    model.add_point3D(xyz, track)


def test_a_name_is_read_without_the_rest() -> None:
    raw = encode_bundle(NamedBundle(NAME, random_bundle(0), (0,) * 6))
    assert decode_bundle_name(raw) == NAME
    with pytest.raises(InvalidMessage, match='bytes are not'):
        decode_bundle_name(b'nonsense')


def test_announcing_what_is_not_pruned_does_not_fail() -> None:
    whole = with_a_turn_on_the_spot(random_bundle(0), 0.0)
    assert len(announce(whole, NAME).landmark_ids) == 31
