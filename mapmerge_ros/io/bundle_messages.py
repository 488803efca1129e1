# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`Bundle` to and from its message, for a SLAM that does not compress by itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.bundle import Bundle, FramePrior, MapName
from mapmerge_ros.errors import InvalidValue
from mapmerge_ros.geometry.rotations import as_rotation
from mapmerge_ros.io import fields
from mapmerge_ros.io.fields import Factory, refusing
from mapmerge_ros.io.raw_bundle import RawBundle
from mapmerge_ros.io.typestore import BUNDLE

UNIT_TOLERANCE = 1e-3
"""A quaternion sent as float32 is unit to 1e-7; one that is off by more is not a rotation."""

_ARRAYS = (
    'intrinsics',
    'keyframe_ids',
    'keyframe_cameras',
    'poses',
    'point_ids',
    'points',
    'observation_keyframes',
    'observation_points',
    'observations',
    'descriptors',
)


@dataclass(frozen=True, slots=True, eq=False)
class NamedBundle:
    """A bundle that came as a message."""

    name: MapName
    bundle: Bundle
    keyframe_stamps_ns: tuple[int, ...]
    """one per key frame of `bundle`"""
    undetermined: int = 0
    """Points of the message that are left out because they have no parallax"""


def bundle_from_message(msg: Any) -> NamedBundle:
    """
    Bundle of a message, without the points and key frames that nothing determines.

    See `RawBundle.pruned` for what goes.

    Raises
    ------
    InvalidMessage
        A field breaks the contract of the message, or it is larger than MAX_MESSAGE_BYTES.

    """
    with refusing('bundle', msg.map_id):
        fields.check_size(fields.array_bytes(msg, _ARRAYS))
        name = _name(msg)
        pruned = _raw_bundle(msg).pruned()
        if len(msg.keyframe_stamps) != len(msg.keyframe_ids):
            raise InvalidValue(
                f'keyframe_stamps: {len(msg.keyframe_stamps)} for {len(msg.keyframe_ids)} ids'
            )
        stamps = [fields.stamp_ns(stamp, 'keyframe_stamps') for stamp in msg.keyframe_stamps]
        kept = tuple(stamps[row] for row in pruned.keyframe_rows)
        return NamedBundle(name, pruned.bundle, kept, pruned.undetermined)


def name_from_message(msg: Any) -> MapName:
    """
    Name of a bundle's message.

    Raises
    ------
    InvalidMessage
        A field of it breaks the contract of the message.

    """
    with refusing('bundle', msg.map_id):
        return _name(msg)


def _name(msg: Any) -> MapName:
    if not fields.text(msg, 'map_id'):
        raise InvalidValue('map_id: empty')
    return MapName(
        map_id=fields.text(msg, 'map_id'),
        robot_id=fields.text(msg, 'robot_id'),
        revision=int(msg.revision),
        stamp_ns=fields.stamp_ns(msg.header.stamp),
        frame_id=fields.text(msg.header, 'frame_id'),
        id_space=fields.text(msg, 'id_space'),
    )


def _raw_bundle(msg: Any) -> RawBundle:
    keyframe_ids = fields.numbers(msg, 'keyframe_ids', np.uint64)
    point_ids = fields.numbers(msg, 'point_ids', np.uint64)
    m, n = len(keyframe_ids), len(point_ids)
    intrinsics = _finite('intrinsics', fields.rows(msg, 'intrinsics', np.float64, 4))
    observations = _finite('observations', fields.rows(msg, 'observations', np.float64, 2))
    poses = _finite('poses', fields.rows(msg, 'poses', np.float64, 7, m))
    o = len(observations)
    return RawBundle(
        intrinsics=intrinsics,
        keyframe_ids=keyframe_ids,
        keyframe_cameras=_indices(msg, 'keyframe_cameras', m, len(intrinsics)),
        rotations_camera_map=_rotations(poses[:, :4]),
        translations_camera_map=poses[:, 4:],
        point_ids=point_ids,
        points=_finite('points', fields.rows(msg, 'points', np.float64, 3, n)),
        observation_keyframes=_indices(msg, 'observation_keyframes', o, m),
        observation_points=_indices(msg, 'observation_points', o, n),
        observations_px=observations,
        descriptors=fields.descriptors(msg, n),
        gauge=fields.gauge(msg),
        prior=_prior(msg),
        sigma_px=float(msg.sigma),
    )


def _finite(name: str, values: Floats) -> Floats:
    if not np.isfinite(values).all():
        bad = int(np.flatnonzero(~np.isfinite(values).ravel())[0])
        raise InvalidValue(f'{name}: value {bad} is not finite')
    return values


def _indices(msg: Any, name: str, count: int, bound: int) -> Ints:
    rows: Ints = fields.rows(msg, name, np.int64, 1, count)[:, 0]
    if len(rows) and rows.max() >= bound:
        raise InvalidValue(f'{name}: row {rows.max()} of {bound}')
    return rows


def _rotations(quaternions: Floats) -> Floats:
    """(m, 4) x y z w to (m, 3, 3)."""
    lengths = np.linalg.norm(quaternions, axis=1)
    off = np.abs(lengths - 1.0) > UNIT_TOLERANCE
    if off.any():
        row = int(np.argmax(off))
        raise InvalidValue(f'poses: quaternion {row} has length {lengths[row]:.4g}, not 1')
    if not len(quaternions):
        return np.zeros((0, 3, 3))
    matrices: Floats = Rotation.from_quat(quaternions).as_matrix()
    return matrices


def _prior(msg: Any) -> FramePrior:
    """Prior of a message, whose fields count only where the gauge uses them."""
    gauge, default = int(msg.gauge), FramePrior()
    scale, gravity = float(msg.scale_std_ratio), float(msg.gravity_std_rad)
    return FramePrior(
        scale_std_ratio=scale if gauge <= 6 else default.scale_std_ratio,
        gravity_std_rad=gravity if gauge <= 4 else default.gravity_std_rad,
    )


def bundle_to_message(named: NamedBundle, make: Factory) -> Any:
    """
    Message of a bundle, of the class that `make` makes.

    Raises
    ------
    InvalidMessage
        A number that its field cannot hold.

    """
    name, bundle = named.name, named.bundle
    with refusing('bundle', name.map_id):
        turns = as_rotation(bundle.rotations_camera_map).as_quat()
        poses = np.column_stack([turns, bundle.translations_camera_map])
        return make(
            BUNDLE,
            header=fields.make_header(make, name.stamp_ns, name.frame_id or name.map_id),
            map_id=name.map_id,
            robot_id=name.robot_id,
            revision=fields.uint32('revision', name.revision),
            gauge=int(bundle.gauge),
            id_space=name.id_space,
            sigma=float(bundle.sigma_px),
            scale_std_ratio=float(bundle.prior.scale_std_ratio),
            gravity_std_rad=float(bundle.prior.gravity_std_rad),
            intrinsics=fields.wire('intrinsics', bundle.intrinsics, np.float64),
            keyframe_ids=fields.wire('keyframe_ids', bundle.keyframe_ids, np.uint64),
            keyframe_stamps=[fields.make_stamp(make, ns) for ns in named.keyframe_stamps_ns],
            keyframe_cameras=fields.wire('keyframe_cameras', bundle.keyframe_cameras, np.uint32),
            poses=fields.wire('poses', poses, np.float64),
            point_ids=fields.wire('point_ids', bundle.point_ids, np.uint64),
            points=fields.wire('points', bundle.points, np.float64),
            observation_keyframes=fields.wire(
                'observation_keyframes', bundle.observation_keyframes, np.uint32
            ),
            observation_points=fields.wire(
                'observation_points', bundle.observation_points, np.uint32
            ),
            observations=fields.wire('observations', bundle.observations_px, np.float32),
            descriptor_type=int(bundle.descriptors.type),
            descriptor_size=bundle.descriptors.size,
            descriptors=fields.wire('descriptors', bundle.descriptors.rows, np.uint8),
        )
