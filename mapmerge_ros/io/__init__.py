# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Messages, recordings and COLMAP models: everything that enters or leaves as bytes or files."""

from mapmerge_ros.io.bags import BagError, Recorded, Recording, read_submaps
from mapmerge_ros.io.bundle_files import load_bundles
from mapmerge_ros.io.bundle_messages import NamedBundle, bundle_from_message, bundle_to_message
from mapmerge_ros.io.codec import (
    decode_bundle,
    decode_bundle_name,
    decode_request,
    decode_submap,
    encode_bundle,
    encode_request,
    encode_submap,
)
from mapmerge_ros.io.colmap import MissingExtraError, load_colmap, read_colmap
from mapmerge_ros.io.colmap_files import ModelError
from mapmerge_ros.io.fields import MAX_MESSAGE_BYTES, Factory, InvalidMessage, class_factory
from mapmerge_ros.io.messages import submap_from_message, submap_to_message
from mapmerge_ros.io.output import OutputError, replacing
from mapmerge_ros.io.recorder import McapRecorder, record, write_submaps
from mapmerge_ros.io.typestore import create

__all__ = [
    'MAX_MESSAGE_BYTES',
    'BagError',
    'Factory',
    'InvalidMessage',
    'McapRecorder',
    'MissingExtraError',
    'ModelError',
    'NamedBundle',
    'OutputError',
    'Recorded',
    'Recording',
    'bundle_from_message',
    'bundle_to_message',
    'class_factory',
    'create',
    'decode_bundle',
    'decode_bundle_name',
    'decode_request',
    'decode_submap',
    'encode_bundle',
    'encode_request',
    'encode_submap',
    'load_bundles',
    'load_colmap',
    'read_colmap',
    'read_submaps',
    'record',
    'replacing',
    'submap_from_message',
    'submap_to_message',
    'write_submaps',
]
