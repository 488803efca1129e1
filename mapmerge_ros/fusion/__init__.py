# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Fusion of compressed sub-maps: one engine, the only state."""

from mapmerge_ros.fusion.accumulate import Receipt
from mapmerge_ros.fusion.changes import Change, Kind
from mapmerge_ros.fusion.config import FusionConfig
from mapmerge_ros.fusion.engine import FusionEngine, Snapshot, fuse
from mapmerge_ros.fusion.outcome import (
    Component,
    ErrorModel,
    Fusion,
    Landmarks,
    MapAlignment,
    Pair,
    State,
    Timing,
    Verdict,
)
from mapmerge_ros.fusion.warm import Warm

__all__ = [
    'Change',
    'Component',
    'ErrorModel',
    'Fusion',
    'FusionConfig',
    'FusionEngine',
    'Kind',
    'Landmarks',
    'MapAlignment',
    'Pair',
    'Receipt',
    'Snapshot',
    'State',
    'Timing',
    'Verdict',
    'Warm',
    'fuse',
]
