# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`SubMap` to and from its message: one codec for the node and for recordings."""

from __future__ import annotations

from typing import Any

import numpy as np

from mapmerge_ros.io import fields
from mapmerge_ros.io.fields import Factory, refusing
from mapmerge_ros.io.typestore import SUBMAP
from mapmerge_ros.submap import Source, SubMap

_ARRAYS = ('landmark_ids', 'points', 'covariances', 'r', 'c', 'descriptors')


def submap_from_message(msg: Any) -> SubMap:
    """
    Sub-map of a message, of rosbags' or of ROS's class.

    Raises
    ------
    InvalidMessage
        A field breaks the contract of the message, or it is larger than MAX_MESSAGE_BYTES.

    """
    with refusing('sub-map', msg.map_id):
        fields.check_size(fields.array_bytes(msg, _ARRAYS))
        ids = fields.numbers(msg, 'landmark_ids', np.uint64)
        n = len(ids)
        gauge, compressed_count = fields.gauge(msg), int(msg.compressed_count)
        c = fields.numbers(msg, 'c', np.float32)
        if not len(c):
            c = np.zeros(max(3 * min(compressed_count, n) - int(gauge), 0), np.float32)
        return SubMap(
            map_id=fields.text(msg, 'map_id'),
            robot_id=fields.text(msg, 'robot_id'),
            revision=int(msg.revision),
            stamp_ns=fields.stamp_ns(msg.header.stamp),
            frame_id=fields.text(msg.header, 'frame_id'),
            sources=tuple(
                Source(fields.text(source, 'map_id'), int(source.revision))
                for source in msg.sources
            ),
            gauge=gauge,
            id_space=fields.text(msg, 'id_space'),
            landmark_ids=ids,
            points=fields.rows(msg, 'points', np.float64, 3, n),
            covariances=(
                fields.rows(msg, 'covariances', np.float32, 6, n) if len(msg.covariances) else None
            ),
            compressed_count=compressed_count,
            a=float(msg.a),
            packed_r=fields.numbers(msg, 'r', np.float32),
            c=c,
            residual_count=int(msg.residual_count),
            dof=int(msg.dof),
            sigma=float(msg.sigma),
            descriptors=fields.descriptors(msg, n),
        )


def submap_to_message(submap: SubMap, make: Factory) -> Any:
    """
    Message of a sub-map, of the class that `make` makes.

    R and c become float32; c = 0 is sent empty.

    Raises
    ------
    InvalidMessage
        A number that its field cannot hold.

    """
    with refusing('sub-map', submap.map_id):
        c = fields.wire('c', submap.c, np.float32)
        covariances = () if submap.covariances is None else submap.covariances
        return make(
            SUBMAP,
            header=fields.make_header(make, submap.stamp_ns, submap.frame_id),
            map_id=submap.map_id,
            robot_id=submap.robot_id,
            revision=fields.uint32('revision', submap.revision),
            sources=[_source(make, source) for source in submap.sources],
            gauge=int(submap.gauge),
            id_space=submap.id_space,
            landmark_ids=fields.wire('landmark_ids', submap.landmark_ids, np.uint64),
            points=fields.wire('points', submap.points, np.float64),
            covariances=fields.wire('covariances', covariances, np.float32),
            compressed_count=submap.compressed_count,
            a=float(submap.a),
            r=fields.wire('r', submap.packed_r, np.float32),
            c=c if c.any() else c[:0],
            residual_count=int(submap.residual_count),
            dof=int(submap.dof),
            sigma=float(submap.sigma),
            descriptor_type=int(submap.descriptors.type),
            descriptor_size=submap.descriptors.size,
            descriptors=fields.wire('descriptors', submap.descriptors.rows, np.uint8),
        )


def _source(make: Factory, source: Source) -> Any:
    revision = fields.uint32('sources', source.revision)
    return make('mapmerge_msgs/msg/MapSource', map_id=source.map_id, revision=revision)
