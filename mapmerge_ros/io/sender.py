# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Who a sub-map is from that breaks the contract of its message elsewhere."""

from __future__ import annotations

from typing import NamedTuple

from mapmerge_ros.errors import InvalidValue
from mapmerge_ros.io.codec import deserialise
from mapmerge_ros.io.fields import InvalidMessage, text
from mapmerge_ros.io.typestore import SUBMAP


class Sender(NamedTuple):
    """Whom a message names; empty where that is not legible."""

    map_id: str = ''
    robot_id: str = ''


def sender_of_submap(raw: bytes | memoryview) -> Sender:
    """Sender of the bytes of a sub-map, which need be right in nothing else."""
    try:
        message = deserialise(raw, SUBMAP)
        return Sender(text(message, 'map_id'), text(message, 'robot_id'))
    except (InvalidMessage, InvalidValue):
        return Sender()
