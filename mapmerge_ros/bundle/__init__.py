# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Bundles: a robot's own map, its linearisation and its compression."""

from mapmerge_ros.bundle.bundle import Bundle, FramePrior
from mapmerge_ros.bundle.compress import MapName, Update, compress, eliminate, update
from mapmerge_ros.bundle.elimination import Elimination
from mapmerge_ros.bundle.lens import Lens
from mapmerge_ros.bundle.lens_prior import with_lens_prior
from mapmerge_ros.bundle.linearise import Linearisation, linearise

__all__ = [
    'Bundle',
    'Elimination',
    'FramePrior',
    'Lens',
    'Linearisation',
    'MapName',
    'Update',
    'compress',
    'eliminate',
    'linearise',
    'update',
    'with_lens_prior',
]
