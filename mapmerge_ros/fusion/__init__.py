# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Fusion of compressed sub-maps: one engine, the only state."""

from mapmerge_ros.fusion.accumulate import Receipt
from mapmerge_ros.fusion.config import FusionConfig
from mapmerge_ros.fusion.engine import FusionEngine, Snapshot, fuse
from mapmerge_ros.fusion.outcome import (
    Component,
    Fusion,
    Landmarks,
    MapAlignment,
    Pair,
    State,
    Timing,
    Verdict,
)

__all__ = [
    'Component',
    'Fusion',
    'FusionConfig',
    'FusionEngine',
    'Landmarks',
    'MapAlignment',
    'Pair',
    'Receipt',
    'Snapshot',
    'State',
    'Timing',
    'Verdict',
    'fuse',
]
