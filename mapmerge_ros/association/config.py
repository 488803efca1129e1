# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Every threshold of the association, each with the measurement behind it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class AssociationConfig:
    """Thresholds; the defaults hold for all sets of docs/association.md."""

    max_ratio_sift: float = 0.85
    """Distance over that of the second best neighbour."""
    max_ratio_binary: float = 0.90
    """Hamming distances are concentrated: their ratios are nearer to 1."""
    min_candidates: int = 6
    """Fewer cannot be significant in any group."""
    seed: int = 0
    """Of the samples; candidates are in canonical order, so the content decides the rest."""
    samples: int = 15_000
    max_judged: int = 60_000
    min_models: int = 200
    min_side_ratio: float = 0.1
    max_side_disagreement: float = 0.25
    min_triangle_height: float = 0.1
    max_scored: int = 300
    max_background: int = 150
    refined_models: int = 10
    refinements: int = 10
    max_tolerance_ratio: float = 0.2
    overlap_radius: float = 2.5
    agreeing_tolerances: float = 2.0
    left_over_tolerances: float = 3.0
    max_log_nfa: float = -5.0
    max_log_nfa_undecided: float = 0.0
    min_inliers: int = 10
    min_inlier_ratio: float = 0.36
    min_agreeing_ratio: float = 0.72
    max_second_ratio: float = 0.5
    clear_share: float = 0.1
    max_clear_ratio: float = 0.63
    screen_above: int = 12
    hash_tables: int = 32
    hash_bits: int = 20
    max_bucket: int = 64
    max_alike_binary: float = 0.2
    max_alike_sift: float = 0.09
    min_alike: int = 4
    min_alike_ratio: float = 0.003
    best_partners: int = 4
