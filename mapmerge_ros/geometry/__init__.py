# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Transforms, gauges and alignment: pure mathematics."""

from mapmerge_ros.geometry.alignment import Alignment, align, align_robustly
from mapmerge_ros.geometry.extent import scene_radius
from mapmerge_ros.geometry.gauge import Gauge, gauge_basis, generators
from mapmerge_ros.geometry.graph import FrameGraph, sparse_graph
from mapmerge_ros.geometry.segments import (
    Alignments,
    Moments,
    Segments,
    Similarities,
    align_moments,
    align_segments,
    align_segments_robustly,
)
from mapmerge_ros.geometry.similarity import Similarity, skew

__all__ = [
    'Alignment',
    'Alignments',
    'FrameGraph',
    'Gauge',
    'Moments',
    'Segments',
    'Similarities',
    'Similarity',
    'align',
    'align_moments',
    'align_robustly',
    'align_segments',
    'align_segments_robustly',
    'gauge_basis',
    'generators',
    'scene_radius',
    'skew',
    'sparse_graph',
]
