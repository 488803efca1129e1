# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What speaks for an alignment beside the number of its inliers, and what it decides."""

from __future__ import annotations

import numpy as np

from mapmerge_ros.arrays import Floats
from mapmerge_ros.association.alignment import Aligned, Matched, align_candidates
from mapmerge_ros.association.config import AssociationConfig
from mapmerge_ros.association.pair import Decision, Evidence
from mapmerge_ros.association.repetition import within
from mapmerge_ros.geometry import Gauge


def gather(
    matched: Matched,
    ratios: Floats,
    aligned: Aligned | None,
    gauge: Gauge,
    config: AssociationConfig,
) -> Evidence:
    """Evidence about an alignment of the candidates; `ratios` (n,) say how distinctive each is."""
    if aligned is None:
        return Evidence(len(matched), 0, np.inf, 0.0, 0.0, 0.0)
    inliers = int(aligned.inliers.sum())
    return Evidence(
        candidates=len(matched),
        inliers=inliers,
        log_nfa=aligned.log_nfa,
        inlier_ratio=inliers / len(matched),
        agreeing_ratio=_agreeing_ratio(matched, ratios, aligned, config),
        second_ratio=_second_support(matched, aligned, gauge, config) / inliers,
        clear_ratio=float(np.quantile(ratios[aligned.inliers], config.clear_share)),
    )


def decide(evidence: Evidence, config: AssociationConfig) -> tuple[Decision, str]:
    """JOINED only when everything speaks for it; what is missing, in words."""
    if evidence.inliers == 0:
        return (
            Decision.APART,
            f'no alignment explains what looks alike (candidates: {evidence.candidates})',
        )
    if evidence.log_nfa > config.max_log_nfa_undecided:
        return Decision.APART, (
            f'{evidence.inliers} of {evidence.candidates} candidates agree, as by chance '
            f'(log NFA {evidence.log_nfa:.1f})'
        )
    doubts = _doubts(evidence, config)
    return (Decision.UNDECIDED, '; '.join(doubts)) if doubts else (Decision.JOINED, '')


def _doubts(evidence: Evidence, config: AssociationConfig) -> list[str]:
    e, c = evidence, config
    checks = [
        (e.log_nfa <= c.max_log_nfa, f'log NFA {e.log_nfa:.1f} above {c.max_log_nfa:g}'),
        (e.inliers >= c.min_inliers, f'{e.inliers} inliers, below {c.min_inliers}'),
        (
            e.inlier_ratio >= c.min_inlier_ratio,
            f'{e.inlier_ratio:.0%} of the candidates are inliers, below {c.min_inlier_ratio:.0%}',
        ),
        (
            e.agreeing_ratio >= c.min_agreeing_ratio,
            f'{e.agreeing_ratio:.0%} of the strong candidates in the overlap agree, '
            f'below {c.min_agreeing_ratio:.0%}',
        ),
        (
            e.second_ratio <= c.max_second_ratio,
            f'repeated structure: another alignment has {e.second_ratio:.0%} of the support, '
            f'above {c.max_second_ratio:.0%}',
        ),
        (
            e.clear_ratio <= c.max_clear_ratio,
            'repeated structure, or noisy descriptors: even the clearest are at '
            f'{e.clear_ratio:.2f} of the second best, above {c.max_clear_ratio:g}',
        ),
        (
            e.peculiar_score >= c.min_peculiar_score,
            'repeated structure: landmarks without a twin in their own map found no partner '
            f'(score {e.peculiar_score:.1f}, below {c.min_peculiar_score:g})',
        ),
    ]
    return [words for holds, words in checks if not holds]


def _agreeing_ratio(
    matched: Matched, ratios: Floats, aligned: Aligned, config: AssociationConfig
) -> float:
    """Share of the strong candidates with both ends in the overlap that agree."""
    inliers = aligned.inliers
    strong = ratios <= np.median(ratios[inliers])
    overlap = within(matched.points_a, inliers, config.overlap_radius)
    overlap &= within(matched.points_b, inliers, config.overlap_radius)
    judged = strong & overlap
    agree = aligned.distances <= config.agreeing_tolerances * aligned.tolerance
    return float((agree & judged).sum() / max(judged.sum(), 1))


def _second_support(
    matched: Matched, aligned: Aligned, gauge: Gauge, config: AssociationConfig
) -> int:
    """Inliers of the best alignment of what the first one leaves over."""
    rest = aligned.distances > config.left_over_tolerances * aligned.tolerance
    second = align_candidates(matched[rest], gauge, config)
    return int(second.inliers.sum()) if second is not None else 0
