# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Exports say what the fusion found, read back by means of others, and never half."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.fusion import Fusion, fuse
from mapmerge_ros.geometry import Similarity
from mapmerge_ros.io import OutputError, encode_submap
from mapmerge_ros.io.exports import global_map_mcap, global_map_ply, landmarks_csv, write_files
from mapmerge_ros.io.map_points import SEVERAL, map_points
from mapmerge_ros.io.palette import SHARED, colours
from mapmerge_ros.io.summary import Refused, Traffic, summarise, summary_json
from mapmerge_ros.io.truth import (
    RecordingTruth,
    TrueMap,
    TrueMove,
    TruthError,
    compare_with_truth,
    load_truth,
    save_truth,
)

from reported import SHARED_COUNT, submaps  # isort: skip

SUMMARY_KEYS = {
    'sub_maps', 'test', 'changes', 'components', 'pairs', 'matches', 'timing_s',
    'bytes_in', 'bytes_out',
}  # fmt: skip
SUB_MAP_KEYS = {
    'map_id', 'robot_id', 'revision', 'landmarks', 'bytes', 'sigma', 'state', 'reason',
    'global_from_map',
}  # fmt: skip
TEST_KEYS = {'a_tilde', 'dof', 'sigma', 'variance_factor', 'p_value', 'accepted'}


@pytest.fixture(scope='module')
def fusion() -> Fusion:
    return fuse(submaps())


@pytest.fixture(scope='module')
def nothing() -> Fusion:
    return fuse([submaps()[3]])


def vertices(ply: bytes) -> tuple[list[str], np.ndarray[Any, np.dtype[Any]]]:
    """Header lines and vertices, by the words of the header alone."""
    end = ply.index(b'end_header\n') + len(b'end_header\n')
    header = ply[:end].decode('ascii').splitlines()
    kinds = {'double': '<f8', 'uchar': 'u1', 'ushort': '<u2'}
    fields = [line.split()[1:] for line in header if line.startswith('property ')]
    rows = np.frombuffer(ply[end:], np.dtype([(name, kinds[kind]) for kind, name in fields]))
    assert f'element vertex {len(rows)}' in header
    return header, rows


def test_summary_has_the_promised_keys(fusion: Fusion) -> None:
    summary = json.loads(summary_json(summarise(fusion)))
    assert summary.keys() >= SUMMARY_KEYS
    assert summary['test'].keys() >= TEST_KEYS
    assert summary['timing_s'].keys() == {'associate', 'merge', 'test', 'total'}
    for row in summary['sub_maps']:
        assert row.keys() >= SUB_MAP_KEYS
        assert row['global_from_map'].keys() == {'scale', 'rotation', 'translation'}


def test_summary_says_what_the_fusion_says(fusion: Fusion) -> None:
    summary = json.loads(summary_json(summarise(fusion)))
    assert [row['state'] for row in summary['sub_maps']] == [
        'merged', 'merged', 'detached', 'detached',
    ]  # fmt: skip
    assert [row['revision'] for row in summary['sub_maps']] == [1, 2, 3, 4]
    assert summary['components'] == [['r0/0001', 'r1/0001'], ['r2/0001']]
    assert summary['pairs'] == [{'a': 'r0/0001', 'b': 'r1/0001', 'shared': SHARED_COUNT}]
    assert summary['test']['dof'] == 3 * SHARED_COUNT - 7
    assert summary['test']['p_value'] == fusion.verdict.p_value
    for row, item in zip(summary['sub_maps'], fusion.alignments, strict=True):
        np.testing.assert_array_equal(
            row['global_from_map']['rotation'], item.S_global_map.rotation
        )
        assert row['bytes'] == len(encode_submap(item.submap))
    assert fusion.global_map is not None
    assert summary['bytes_out'] == len(encode_submap(fusion.global_map))
    assert summary['bytes_in'] == sum(row['bytes'] for row in summary['sub_maps'])


def test_sigma_is_estimated_where_it_is_unknown(fusion: Fusion) -> None:
    rows = summarise(fusion)['sub_maps']
    assert rows[0]['sigma'] == pytest.approx(0.3, rel=0.2)
    assert rows[3]['sigma'] is None  # nothing is known of an announcement
    known = fuse([replace(submap, sigma=0.7) for submap in submaps()])
    assert {row['sigma'] for row in summarise(known)['sub_maps']} == {0.7}


def test_nan_becomes_null(nothing: Fusion) -> None:
    text = summary_json(summarise(nothing, Traffic(1, 10, (Refused('/x/submap', 'why'),))))
    summary = json.loads(text, parse_constant=lambda word: pytest.fail(word))
    assert summary['test']['variance_factor'] is None
    assert summary['bytes_out'] == 0
    assert summary['bytes_in'] == 10
    assert summary['messages']['refused'] == [{'name': '/x/submap', 'reason': 'why'}]


def test_csv_reads_back_to_the_same_bits(fusion: Fusion) -> None:
    landmarks = fusion.components[0].landmarks
    rows = list(csv.DictReader(io.StringIO(landmarks_csv(fusion).decode())))
    assert [int(row['id']) for row in rows] == landmarks.ids.tolist()
    read = np.array([[float(row[key]) for key in ('x', 'y', 'z')] for row in rows])
    assert read.tobytes() == np.ascontiguousarray(landmarks.points_global).tobytes()
    std = np.array([[float(row[f'std_{key}']) for key in 'xyz'] for row in rows])
    np.testing.assert_array_equal(std, landmarks.std)
    members = [[text.rsplit(':', 1) for text in row['members'].split(';')] for row in rows]
    expected = [[[map_id, str(own)] for map_id, own in row] for row in landmarks.members()]
    assert members == expected


def test_map_points_hold_every_landmark_once(fusion: Fusion) -> None:
    points = map_points(fusion)
    inside = [item for item in fusion.alignments if item.component == 0]
    distinct = {int(own) for item in inside for own in item.submap.landmark_ids}
    assert len(points) == len(distinct)
    assert points.map_ids == fusion.components[0].map_ids
    assert points.landmark_count == len(fusion.components[0].landmarks.ids)
    # Both maps have all points of the scene, as landmark or as catalogue.
    assert (points.owners == SEVERAL).all()
    assert (points.views == 2).all()


def test_private_ids_are_never_the_same_point() -> None:
    private = [replace(submap, id_space='') for submap in submaps()[:2]]
    points = map_points(fuse(private))
    assert set(points.views) == {1}
    assert set(points.owners) == {0}


def test_ply_is_the_map(fusion: Fusion) -> None:
    header, rows = vertices(global_map_ply(fusion))
    points = map_points(fusion)
    np.testing.assert_array_equal(
        np.column_stack([rows[axis] for axis in 'xyz']), points.points_global
    )
    assert rows['landmark'].sum() == points.landmark_count
    assert {tuple(row) for row in rows[['red', 'green', 'blue']].tolist()} == {SHARED}
    red, green, blue = colours(1)[0]
    assert f'comment sub-map r0/0001: {red} {green} {blue}' in header


def test_colours_tell_sub_maps_apart() -> None:
    many = colours(64)
    assert len(set(many)) == 64
    assert many[:5] == colours(5)


def test_mcap_is_read_by_others(fusion: Fusion) -> None:
    reader = make_reader(io.BytesIO(global_map_mcap(fusion)), decoder_factories=[DecoderFactory()])
    (message,) = list(reader.iter_decoded_messages())
    assert message.channel.topic == '/fusion_node/global_map'
    assert message.decoded_message.map_id == 'fusion/global'


def test_empty_fusion_gives_empty_files(nothing: Fusion) -> None:
    assert landmarks_csv(nothing).count(b'\n') == 1
    assert len(vertices(global_map_ply(nothing))[1]) == 0
    assert list(make_reader(io.BytesIO(global_map_mcap(nothing))).iter_messages()) == []


def test_files_appear_together_or_not_at_all(tmp_path: Path) -> None:
    broken: Any = None
    with pytest.raises(TypeError):
        write_files(tmp_path, {'a': b'1', 'b': broken})
    assert list(tmp_path.iterdir()) == []
    (tmp_path / 'b').mkdir()
    with pytest.raises(OutputError, match='b: is a folder'):
        write_files(tmp_path, {'a': b'1', 'b': b'2'})
    assert [path.name for path in tmp_path.iterdir()] == ['b']


def truth_of(fusion: Fusion, shift: float = 0.0) -> RecordingTruth:
    """Truth that the merged map meets up to a similarity; the first landmark is shifted."""
    landmarks = fusion.components[0].landmarks
    world = Similarity.exp(np.array([0.3, -0.2, 0.5, 1.0, 2.0, 3.0, 0.4]))
    points = world.apply(landmarks.points_global)
    points[0] += shift
    return RecordingTruth(
        landmark_ids=landmarks.ids,
        points_world=points,
        maps=(TrueMap('r0/0001', 'r0', world, landmarks.ids[:3], landmarks.ids[:3]),),
        moved=(TrueMove(landmarks.ids[1:3], ('r1/0001',), np.array([0.5, 0.0, 0.0])),),
    )


def test_truth_is_written_and_read(tmp_path: Path, fusion: Fusion) -> None:
    path, truth = tmp_path / 'x.truth.json', truth_of(fusion)
    save_truth(path, truth)
    again = load_truth(path)
    np.testing.assert_array_equal(again.landmark_ids, truth.landmark_ids)
    np.testing.assert_array_equal(again.points_world, truth.points_world)
    np.testing.assert_array_equal(again.moved[0].displacement_world, [0.5, 0, 0])
    assert again.moved[0].map_ids == ('r1/0001',)
    np.testing.assert_array_equal(again.maps[0].true_ids, truth.maps[0].true_ids)
    plain = json.loads(path.read_text())
    assert plain.keys() == {'landmarks', 'maps', 'moved', 'temporary'}
    assert plain['maps'][0]['world_from_map'].keys() == {'scale', 'rotation', 'translation'}


@pytest.mark.parametrize(
    ('text', 'reason'),
    [
        ('{', 'not a JSON file'),
        ('[]', 'simulate again'),
        ('{"maps": [], "moved": []}', "'landmarks' is missing"),
        ('{"landmarks": {"ids": [-1], "points": []}, "maps": [], "moved": []}', 'simulate'),
        ('{"landmarks": {"ids": [1], "points": [[1, 2]]}, "maps": [], "moved": []}', 'simulate'),
        ('{"landmarks": {"ids": [1], "points": []}, "maps": [], "moved": []}', 'landmarks.points'),
    ],
)
def test_damaged_truth_is_refused(tmp_path: Path, text: str, reason: str) -> None:
    path = tmp_path / 'x.truth.json'
    path.write_text(text)
    with pytest.raises(TruthError, match=reason) as caught:
        load_truth(path)
    assert str(caught.value).startswith(str(path))


def test_comparison_is_that_of_shared_unmoved_landmarks(fusion: Fusion) -> None:
    found = compare_with_truth(fusion, truth_of(fusion, shift=5.0))
    assert found.count == SHARED_COUNT - 2
    assert found.median_error < 1e-6
    assert found.rmse == pytest.approx(5.0 * np.sqrt(3 / found.count), rel=1e-3)
    with pytest.raises(DegenerateGeometry, match='only 0 merged landmarks'):
        compare_with_truth(
            fusion,
            replace(
                truth_of(fusion),
                landmark_ids=np.arange(len(fusion.components[0].landmarks.ids)) + 10**6,
            ),
        )
