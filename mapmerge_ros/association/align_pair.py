# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Whether two sub-maps show the same place, from descriptors and geometry alone."""

from __future__ import annotations

import numpy as np

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.association.alignment import Aligned, Matched, align_candidates
from mapmerge_ros.association.config import AssociationConfig
from mapmerge_ros.association.evidence import gather
from mapmerge_ros.association.nearest import Candidates, nearest
from mapmerge_ros.association.pair import Decision, Evidence, PairMatch
from mapmerge_ros.submap import SubMap, alignment_weights


def match_pair(a: SubMap, b: SubMap, config: AssociationConfig) -> PairMatch:
    """
    Match two sub-maps: nearest descriptors, robust alignment, evidence, decision.

    The same landmarks in another order, or the maps exchanged, give the same matches.
    """
    if (b.map_id, b.revision) < (a.map_id, a.revision):
        return _exchanged(match_pair(b, a, config))
    order_a, order_b = np.argsort(a.landmark_ids), np.argsort(b.landmark_ids)
    found = nearest(a.descriptors[order_a], b.descriptors[order_b], config)
    rows_a, rows_b = order_a[found.rows_a], order_b[found.rows_b]
    matched = Matched(
        a.points[rows_a], b.points[rows_b], variances(a)[rows_a], variances(b)[rows_b]
    )
    gauge = max(a.gauge, b.gauge)
    aligned = align_candidates(matched, gauge, config)
    evidence = gather(matched, found.ratios, aligned, gauge, config)
    decision, reason = decide(evidence, found, config)
    return _result(decision, reason, evidence, aligned, rows_a, rows_b)


def variances(submap: SubMap) -> Floats:
    """(n,) variance of each landmark's position, mean of its coordinates; zero = unknown."""
    known = np.zeros(len(submap.landmark_ids))
    if submap.covariances is not None:
        known = submap.covariances[:, [0, 3, 5]].mean(axis=1).astype(np.float64)
    if submap.compressed_count:
        # With the other landmarks held, in place of the cameras: from R, unit variance.
        weights = alignment_weights(submap.triangle())
        variance = submap.sigma**2 or submap.a**2 / max(submap.redundancy, 1)
        known[: submap.compressed_count] = variance / (3.0 * weights)
    return known


def decide(
    evidence: Evidence, found: Candidates, config: AssociationConfig
) -> tuple[Decision, str]:
    """JOINED only when everything speaks for it; what is missing, in words."""
    if found.reason:
        return Decision.APART, found.reason
    if evidence.inliers == 0:
        return Decision.APART, f'no alignment explains the {evidence.candidates} candidates'
    if evidence.log_nfa > config.max_log_nfa_undecided:
        return Decision.APART, (
            f'{evidence.inliers} of {evidence.candidates} candidates agree, as by chance '
            f'(log NFA {evidence.log_nfa:.1f})'
        )
    doubts = _doubts(evidence, config)
    return (Decision.UNDECIDED, '; '.join(doubts)) if doubts else (Decision.JOINED, '')


def _doubts(evidence: Evidence, config: AssociationConfig) -> list[str]:
    checks = [
        (
            evidence.log_nfa <= config.max_log_nfa,
            f'log NFA {evidence.log_nfa:.1f} above {config.max_log_nfa:g}',
        ),
        (
            evidence.inliers >= config.min_inliers,
            f'{evidence.inliers} inliers, below {config.min_inliers}',
        ),
        (
            evidence.inlier_ratio >= config.min_inlier_ratio,
            f'{evidence.inlier_ratio:.0%} of the candidates are inliers, '
            f'below {config.min_inlier_ratio:.0%}',
        ),
        (
            evidence.agreeing_ratio >= config.min_agreeing_ratio,
            f'{evidence.agreeing_ratio:.0%} of the strong candidates in the overlap agree, '
            f'below {config.min_agreeing_ratio:.0%}',
        ),
        (
            evidence.second_ratio <= config.max_second_ratio,
            f'another alignment has {evidence.second_ratio:.0%} of the support, '
            f'above {config.max_second_ratio:.0%}: repeated structure',
        ),
        (
            evidence.clear_ratio <= config.max_clear_ratio,
            f'even the clearest descriptors are at {evidence.clear_ratio:.2f} of the second '
            f'best, above {config.max_clear_ratio:g}: repeated structure',
        ),
    ]
    return [words for holds, words in checks if not holds]


def _result(
    decision: Decision,
    reason: str,
    evidence: Evidence,
    aligned: Aligned | None,
    rows_a: Ints,
    rows_b: Ints,
) -> PairMatch:
    inliers = aligned.inliers if aligned is not None else np.zeros(len(rows_a), bool)
    return PairMatch(
        decision=decision,
        reason=reason,
        evidence=evidence,
        S_a_b=aligned.S_a_b if aligned is not None else None,
        rows_a=rows_a[inliers],
        rows_b=rows_b[inliers],
        candidates_a=rows_a,
        candidates_b=rows_b,
        tolerance_a=aligned.tolerance if aligned is not None else np.nan,
    )


def _exchanged(match: PairMatch) -> PairMatch:
    """Return the same about (b, a)."""
    S_a_b = match.S_a_b
    return PairMatch(
        decision=match.decision,
        reason=match.reason,
        evidence=match.evidence,
        S_a_b=S_a_b.inverse() if S_a_b is not None else None,
        rows_a=match.rows_b,
        rows_b=match.rows_a,
        candidates_a=match.candidates_b,
        candidates_b=match.candidates_a,
        tolerance_a=match.tolerance_a / S_a_b.scale if S_a_b is not None else np.nan,
    )
