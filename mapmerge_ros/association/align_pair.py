# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Whether two sub-maps show the same place, from descriptors and geometry alone."""

from __future__ import annotations

import hashlib
from dataclasses import replace

import numpy as np

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.association.alignment import Aligned, Matched, align_candidates
from mapmerge_ros.association.config import AssociationConfig
from mapmerge_ros.association.evidence import decide, gather
from mapmerge_ros.association.nearest import nearest
from mapmerge_ros.association.pair import Decision, Evidence, PairMatch
from mapmerge_ros.association.repetition import peculiar_score
from mapmerge_ros.submap import SubMap, alignment_weights


def match_pair(a: SubMap, b: SubMap, config: AssociationConfig) -> PairMatch:
    """
    Match two sub-maps: nearest descriptors, robust alignment, evidence, decision.

    The same landmarks in another order, or the maps exchanged, give the same matches.
    """
    if rank(b) < rank(a):
        return match_pair(b, a, config).exchanged()
    order_a, order_b = np.argsort(a.landmark_ids), np.argsort(b.landmark_ids)
    found = nearest(a.descriptors[order_a], b.descriptors[order_b], config)
    rows_a, rows_b = order_a[found.rows_a], order_b[found.rows_b]
    matched = Matched(
        a.points[rows_a], b.points[rows_b], variances(a)[rows_a], variances(b)[rows_b]
    )
    gauge = max(a.gauge, b.gauge)
    aligned = align_candidates(matched, gauge, config)
    evidence = gather(matched, found.ratios, aligned, gauge, config)
    if aligned is not None and evidence.log_nfa <= config.max_log_nfa:
        inliers = aligned.inliers
        scores = (
            peculiar_score(own.points[order], own.descriptors[order], rows[inliers], config)
            for own, order, rows in ((a, order_a, found.rows_a), (b, order_b, found.rows_b))
        )
        evidence = replace(evidence, peculiar_score=max(scores))
    decision, reason = decide(evidence, config)
    if found.reason:
        reason = found.reason
    return _result(decision, reason, evidence, aligned, rows_a, rows_b)


def rank(submap: SubMap) -> tuple[int, bytes, str, int, bytes]:
    """
    Order of sub-maps in which they are compared: the larger one of a pair is the first.

    It depends neither on which is asked about first nor, unless they are twins, on what they are
    called: names are anyone's choice, and a pair is not quite symmetric.
    """
    rows = submap.descriptors.rows[np.argsort(submap.landmark_ids)]
    content = hashlib.blake2b(rows.tobytes(), digest_size=16).digest()
    first = submap.points[:1].tobytes()
    return -len(submap.landmark_ids), content, submap.map_id, submap.revision, first


def variances(submap: SubMap) -> Floats:
    """(n,) variance of each landmark's position, mean of its coordinates; zero = unknown."""
    known = np.zeros(len(submap.landmark_ids))
    if submap.covariances is not None:
        return np.asarray(submap.covariances[:, [0, 3, 5]].mean(axis=1), np.float64)
    if submap.compressed_count:
        # With the other landmarks held fixed in place of the cameras: what R says.
        weights = alignment_weights(submap.triangle())
        variance = submap.sigma**2 or submap.a**2 / max(submap.redundancy, 1)
        known[: submap.compressed_count] = variance / (3.0 * weights)
    return known


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
