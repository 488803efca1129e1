# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A robot's bundles from files: a COLMAP model, or a recording of `Bundle` messages."""

from __future__ import annotations

from pathlib import Path

from mapmerge_ros.bundle import MapName
from mapmerge_ros.errors import InvalidValue
from mapmerge_ros.geometry import Gauge
from mapmerge_ros.io.bags import read_raw
from mapmerge_ros.io.bundle_messages import NamedBundle
from mapmerge_ros.io.codec import decode_bundle
from mapmerge_ros.io.colmap import read_colmap
from mapmerge_ros.io.typestore import BUNDLE


def load_bundles(
    path: str | Path, robot_id: str = '', id_space: str = '', gauge: Gauge = Gauge.SIMILARITY
) -> tuple[NamedBundle, ...]:
    """
    Newest bundle of each map of one robot, by map_id.

    A folder without `metadata.yaml` is a COLMAP model: it becomes the map ROBOT/0000 (by default
    the robot is called like the folder), with the given id space and gauge. Recordings say all
    this themselves; there `robot_id` chooses, and may be empty if there is only one robot.

    Raises
    ------
    ModelError
        The folder does not hold a usable model.
    MissingExtraError
        It is a model, and pycolmap is not installed.
    BagError
        The recording cannot be read, or has no bundles.
    InvalidMessage
        A bundle in it breaks its contract.
    InvalidValue
        It has no such robot, or several and none was named.

    """
    path = Path(path)
    if path.is_dir() and not (path / 'metadata.yaml').exists():
        name = robot_id or path.resolve().name
        model = read_colmap(path, gauge)
        map_name = MapName(f'{name}/0000', name, id_space=id_space)
        stamps_ns = (0,) * len(model.bundle.keyframe_ids)
        return (NamedBundle(map_name, model.bundle, stamps_ns, model.undetermined),)
    found = [decode_bundle(raw) for raw in read_raw(path, BUNDLE)]
    robots = sorted({named.name.robot_id for named in found})
    wanted = robot_id or (robots[0] if len(robots) == 1 else '')
    if wanted not in robots:
        raise InvalidValue(f'robot_id: {robot_id!r} is none of {", ".join(robots)}')
    newest: dict[str, NamedBundle] = {}
    for named in found:
        old = newest.get(named.name.map_id)
        if named.name.robot_id == wanted and (
            old is None or old.name.revision < named.name.revision
        ):
            newest[named.name.map_id] = named
    return tuple(newest[map_id] for map_id in sorted(newest))
