# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What is known about one pair of sub-maps: values only."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from mapmerge_ros.arrays import Ints
from mapmerge_ros.geometry import Similarity


class Decision(Enum):
    """Whether two sub-maps show the same place."""

    JOINED = 'joined'
    UNDECIDED = 'undecided'
    """Something agrees, but not enough to stand alone: other sub-maps may settle it."""
    APART = 'apart'


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """What a decision about a pair rests on."""

    candidates: int
    """Mutual, distinctive matches of descriptors"""
    inliers: int
    """Candidates that the alignment explains"""
    log_nfa: float
    """log10 of the expected number of as good alignments by chance; inf without an alignment"""
    inlier_ratio: float
    """inliers / candidates"""
    agreeing_ratio: float
    """Share of the strong candidates in the overlap that agree with the alignment"""
    second_ratio: float
    """Support of a second alignment, on the candidates left over, over that of the first"""
    clear_ratio: float = 1.0
    """
    Descriptor distance over that of the second best, up to which a tenth of the inliers are.

    Where elements repeat, a wrong twin is hardly nearer than the next one: all ratios near 1.
    """
    peculiar_score: float = 0.0
    """
    Standard score of how much rather landmarks that are like no other one of their map match.

    Far below zero: only what has a twin was found. The better of both maps.
    """


@dataclass(frozen=True, slots=True, eq=False)
class PairMatch:
    """Two sub-maps a and b: their matches and, unless they are apart, their relative frame."""

    decision: Decision
    reason: str
    """Why not joined, in words; empty for a joined pair"""
    evidence: Evidence
    S_a_b: Similarity | None
    """None when no alignment was found"""
    rows_a: Ints
    """(n,) rows of the matched landmarks in a's message: the inliers of the alignment"""
    rows_b: Ints
    """(n,) their partners in b's message"""
    candidates_a: Ints
    """(c,) rows of all candidates in a's message"""
    candidates_b: Ints
    """(c,) their partners in b's message"""
    tolerance_a: float
    """Distance up to which a candidate is an inlier, in a's frame; nan without an alignment"""

    def exchanged(self) -> PairMatch:
        """Return the same about (b, a)."""
        S_a_b = self.S_a_b
        return PairMatch(
            decision=self.decision,
            reason=self.reason,
            evidence=self.evidence,
            S_a_b=S_a_b.inverse() if S_a_b is not None else None,
            rows_a=self.rows_b,
            rows_b=self.rows_a,
            candidates_a=self.candidates_b,
            candidates_b=self.candidates_a,
            tolerance_a=self.tolerance_a / S_a_b.scale if S_a_b is not None else np.nan,
        )
