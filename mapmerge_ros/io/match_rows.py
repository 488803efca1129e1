# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Pairs that were compared by descriptors, as people read them: order, choice, words."""

from __future__ import annotations

import math
from collections.abc import Sequence

from mapmerge_ros.association import Decision
from mapmerge_ros.fusion.outcome import Match

FEW = 10
"""Pairs up to which all are shown: those of five sub-maps fit on a screen."""
MAX_JOINED = 40
"""Joined pairs shown, those with most in common first."""
MAX_OPEN = 10
"""Undecided pairs shown, the best first."""

_ORDER = {Decision.JOINED: 0, Decision.UNDECIDED: 1, Decision.APART: 2}


def by_worth(matches: Sequence[Match]) -> tuple[Match, ...]:
    """Joined pairs first, those with most in common; then what came nearest to being joined."""
    return tuple(sorted(matches, key=_worth))


def worth_showing(matches: Sequence[Match]) -> tuple[Match, ...]:
    """Joined pairs, the best undecided ones, and the best of every sub-map, in that order."""
    ranked = by_worth(matches)
    if len(ranked) <= FEW:
        return ranked
    joined = [match for match in ranked if match.found.decision is Decision.JOINED]
    undecided = [match for match in ranked if match.found.decision is Decision.UNDECIDED]
    shown = {(match.a, match.b) for match in [*joined[:MAX_JOINED], *undecided[:MAX_OPEN]]}
    met = {name for pair in shown for name in pair}
    for match in ranked:
        if not {match.a, match.b} <= met:
            shown.add((match.a, match.b))
            met |= {match.a, match.b}
    return tuple(match for match in ranked if (match.a, match.b) in shown)


def tally(matches: Sequence[Match]) -> str:
    """'3 pairs compared by descriptors: 2 joined, 1 undecided.'; empty if none was."""
    if not matches:
        return ''
    found = [match.found.decision for match in matches]
    counts = ', '.join(
        f'{found.count(decision)} {decision.value}' for decision in Decision if decision in found
    )
    noun = 'pair' if len(matches) == 1 else 'pairs'
    return f'{len(matches)} {noun} compared by descriptors: {counts}.'


def inliers_of(match: Match) -> str:
    """Inliers among the candidates, as `50 of 82`."""
    return f'{match.found.evidence.inliers} of {match.found.evidence.candidates}'


def log_nfa(match: Match) -> str:
    """log10 of the false alarms to expect; a dash where nothing could be aligned."""
    value = match.found.evidence.log_nfa
    return f'{value:.1f}' if math.isfinite(value) else '–'


def why_not(match: Match) -> str:
    """Why a pair is not joined, and what connects it all the same; empty for a joined one."""
    if match.found.decision is Decision.JOINED:
        return ''
    if not match.links:
        return match.found.reason
    others = f'{match.links} landmarks in common, found through other sub-maps'
    return f'{match.found.reason}; {others}'


def _worth(match: Match) -> tuple[int, int, float, int, str, str]:
    evidence = match.found.evidence
    rank = _ORDER[match.found.decision]
    links = -match.links if rank == 0 else 0
    return rank, links, evidence.log_nfa, -evidence.candidates, match.a, match.b
