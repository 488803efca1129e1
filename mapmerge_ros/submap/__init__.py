# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Compressed sub-maps: immutable values."""

from mapmerge_ros.submap.descriptors import Descriptors, DescriptorType
from mapmerge_ros.submap.information import LandmarkInformation, alignment_weights
from mapmerge_ros.submap.request import Request
from mapmerge_ros.submap.size import (
    catalogue_bytes,
    information_bytes,
    most_landmarks,
    most_within,
)
from mapmerge_ros.submap.submap import (
    Source,
    SubMap,
    symmetric_from_upper,
    upper_from_symmetric,
)
from mapmerge_ros.submap.triangle import (
    factor_information,
    factor_root,
    pack,
    packed_size,
    triangulate,
    unpack,
    upper_qr,
)

__all__ = [
    'DescriptorType',
    'Descriptors',
    'LandmarkInformation',
    'Request',
    'Source',
    'SubMap',
    'alignment_weights',
    'catalogue_bytes',
    'factor_information',
    'factor_root',
    'information_bytes',
    'most_landmarks',
    'most_within',
    'pack',
    'packed_size',
    'symmetric_from_upper',
    'triangulate',
    'unpack',
    'upper_from_symmetric',
    'upper_qr',
]
