# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The merged map as files for other programs: CSV, PLY, MCAP."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from mapmerge_ros.fusion import Fusion
from mapmerge_ros.io.map_points import MapPoints, map_points
from mapmerge_ros.io.output import OutputError, replacing
from mapmerge_ros.io.palette import SHARED, colours
from mapmerge_ros.io.recorder import McapRecorder
from mapmerge_ros.io.typestore import SUBMAP

GLOBAL_MAP_TOPIC = '/fusion_node/global_map'
"""As the node publishes it."""

CSV_HEADER = ('id', 'x', 'y', 'z', 'std_x', 'std_y', 'std_z', 'members')

_VERTEX = np.dtype(
    [
        *((axis, '<f8') for axis in 'xyz'),
        *((colour, 'u1') for colour in ('red', 'green', 'blue')),
        ('sub_maps', '<u2'),
        ('landmark', 'u1'),
    ]
)
_PLY_TYPES = {'<f8': 'double', '|u1': 'uchar', '<u2': 'ushort'}


def landmarks_csv(fusion: Fusion) -> bytes:
    """One row per merged landmark of the global map; numbers read back to the same bits."""
    text = io.StringIO(newline='')
    writer = csv.writer(text, lineterminator='\n')
    writer.writerow(CSV_HEADER)
    if fusion.components:
        landmarks = fusion.components[0].landmarks
        numbers = np.column_stack([landmarks.points_global, landmarks.std]).tolist()
        rows = zip(landmarks.ids.tolist(), numbers, landmarks.members(), strict=True)
        for landmark_id, row, members in rows:
            names = ';'.join(f'{map_id}:{own_id}' for map_id, own_id in members)
            writer.writerow([landmark_id, *map(repr, row), names])
    return text.getvalue().encode()


def global_map_ply(fusion: Fusion) -> bytes:
    """
    Point cloud (binary, little endian) of the global map, catalogue included.

    The colour says which sub-map has the point, grey is several; `sub_maps` is their number,
    `landmark` is 1 for merged landmarks and 0 for catalogue.
    """
    points = map_points(fusion)
    vertices = np.zeros(len(points), _VERTEX)
    for k, axis in enumerate('xyz'):
        vertices[axis] = points.points_global[:, k]
    # Row -1 of the table, the last one, is that of points with several owners.
    table = np.array([*colours(len(points.map_ids)), SHARED], np.uint8)
    for k, colour in enumerate(('red', 'green', 'blue')):
        vertices[colour] = table[points.owners, k]
    vertices['sub_maps'] = np.minimum(points.views, 65535)
    vertices['landmark'][: points.landmark_count] = 1
    return _ply_header(points) + vertices.tobytes()


def _ply_header(points: MapPoints) -> bytes:
    names = (
        f'comment sub-map {" ".join(map_id.split())}: {red} {green} {blue}'
        for map_id, (red, green, blue) in zip(
            points.map_ids, colours(len(points.map_ids)), strict=True
        )
    )
    properties = (
        f'property {_PLY_TYPES[_VERTEX[name].str]} {name}' for name in _VERTEX.names or ()
    )
    lines = (
        'ply',
        'format binary_little_endian 1.0',
        'comment global map of mapmerge_ros',
        *names,
        f'element vertex {len(points)}',
        *properties,
        'end_header',
    )
    return ''.join(f'{line}\n' for line in lines).encode('ascii', 'replace')


def global_map_mcap(fusion: Fusion) -> bytes:
    """Recording with the global map as one message; none where nothing could be merged."""
    stream = io.BytesIO()
    recorder = McapRecorder(stream)
    recorder.declare(GLOBAL_MAP_TOPIC, SUBMAP)
    if fusion.global_map is not None:
        log_time_ns = max(fusion.global_map.stamp_ns, 0)
        recorder.write_submap(GLOBAL_MAP_TOPIC, log_time_ns, fusion.global_map)
    recorder.finish()
    return stream.getvalue()


def write_files(folder: Path, contents: Mapping[str, bytes]) -> tuple[Path, ...]:
    """
    Write files into a folder: none of them appears before all of them are on disk.

    Raises
    ------
    OutputError
        One of them cannot be written.

    """
    paths = tuple(folder / name for name in contents)
    for path in paths:
        if path.is_dir():
            raise OutputError(f'{path}: is a folder: move it away')
    with ExitStack() as stack:
        streams = [stack.enter_context(replacing(path)) for path in paths]
        for stream, content in zip(streams, contents.values(), strict=True):
            stream.write(content)
            stream.flush()
    return paths
