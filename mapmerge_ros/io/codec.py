# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Serialised messages (CDR), without ROS."""

from __future__ import annotations

from typing import Any

from rosbags.serde import SerdeError

from mapmerge_ros.bundle import MapName
from mapmerge_ros.io.bundle_messages import (
    NamedBundle,
    bundle_from_message,
    bundle_to_message,
    name_from_message,
)
from mapmerge_ros.io.fields import InvalidMessage, check_size, refusing
from mapmerge_ros.io.messages import submap_from_message, submap_to_message
from mapmerge_ros.io.request_messages import request_from_message, request_to_message
from mapmerge_ros.io.typestore import BUNDLE, REQUEST, SUBMAP, create, typestore
from mapmerge_ros.submap import Request, SubMap


def serialise(message: Any) -> bytes:
    """Bytes of a message of rosbags' class."""
    return bytes(typestore().serialize_cdr(message, message.__msgtype__))


def deserialise(raw: bytes | memoryview, typename: str) -> Any:
    """
    Message of rosbags' class; its arrays are views of `raw`.

    Raises
    ------
    InvalidMessage
        The bytes are not of this type, or more than MAX_MESSAGE_BYTES.

    """
    with refusing('message of type', typename):
        check_size(len(raw))
    try:
        # Of bytes the typestore would make a copy.
        return typestore().deserialize_cdr(memoryview(raw), typename)
    except (SerdeError, IndexError) as err:
        reason = str(err.__cause__ or err) or type(err).__name__
        raise InvalidMessage(f'bytes are not a {typename}: {reason}') from err


def encode_submap(submap: SubMap) -> bytes:
    """Serialise a sub-map; `decode_submap` gives the same, up to float32 of R and c."""
    return serialise(submap_to_message(submap, create))


def decode_submap(raw: bytes | memoryview) -> SubMap:
    """
    Sub-map of its bytes, checked.

    Raises
    ------
    InvalidMessage
        What is wrong with them.

    """
    return submap_from_message(deserialise(raw, SUBMAP))


def encode_bundle(named: NamedBundle) -> bytes:
    """Serialise a bundle; its observations become float32."""
    return serialise(bundle_to_message(named, create))


def decode_bundle(raw: bytes | memoryview) -> NamedBundle:
    """
    Bundle of its bytes, checked and pruned.

    Raises
    ------
    InvalidMessage
        What is wrong with them.

    """
    return bundle_from_message(deserialise(raw, BUNDLE))


def decode_bundle_name(raw: bytes | memoryview) -> MapName:
    """
    Return only the name of a bundle, which takes no time: arrays are not looked at.

    Raises
    ------
    InvalidMessage
        The bytes are not a bundle, or its name is none.

    """
    return name_from_message(deserialise(raw, BUNDLE))


def encode_request(request: Request, stamp_ns: int) -> bytes:
    """Serialise a request made at this time."""
    return serialise(request_to_message(request, stamp_ns, create))


def decode_request(raw: bytes | memoryview) -> Request:
    """
    Request of its bytes, checked.

    Raises
    ------
    InvalidMessage
        What is wrong with them.

    """
    return request_from_message(deserialise(raw, REQUEST))
