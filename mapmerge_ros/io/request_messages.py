# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`LandmarkRequest` to and from its message."""

from __future__ import annotations

from typing import Any

import numpy as np

from mapmerge_ros.io import fields
from mapmerge_ros.io.fields import Factory, refusing
from mapmerge_ros.io.typestore import REQUEST
from mapmerge_ros.submap import Request


def request_from_message(msg: Any) -> Request:
    """
    Request of a message, of rosbags' or of ROS's class.

    Raises
    ------
    InvalidMessage
        A field breaks the contract of the message.

    """
    with refusing('request for', msg.map_id):
        return Request(
            map_id=fields.text(msg, 'map_id'),
            robot_id=fields.text(msg, 'robot_id'),
            revision=int(msg.revision),
            landmark_ids=fields.numbers(msg, 'landmark_ids', np.uint64),
            max_bytes=int(msg.max_bytes),
            frame_id=fields.text(msg.header, 'frame_id'),
        )


def request_to_message(request: Request, stamp_ns: int, make: Factory) -> Any:
    """
    Message of a request made at a time, of the class that `make` makes.

    Raises
    ------
    InvalidMessage
        A number that its field cannot hold.

    """
    with refusing('request for', request.map_id):
        return make(
            REQUEST,
            header=fields.make_header(make, stamp_ns, request.frame_id),
            map_id=request.map_id,
            robot_id=request.robot_id,
            revision=fields.uint32('revision', request.revision),
            landmark_ids=fields.wire('landmark_ids', request.landmark_ids, np.uint64),
            max_bytes=request.max_bytes,
        )
