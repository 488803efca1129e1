# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Every threshold of the association of pairs, each with the measurement behind it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class AssociationConfig:
    """
    Thresholds; figures are those of benchmarks/association.py.

    Chosen on EuRoC (true pairs) and the street of seed 0 (aliases); checked on the photographic
    sets, halves, shuffled maps and other streets.
    """

    max_ratio_sift: float = 0.85
    """Distance over that of the second best neighbour, the worse of both directions."""
    max_ratio_binary: float = 0.90
    """Hamming distances are concentrated: their ratios are nearer to 1."""

    min_candidates: int = 6
    """Fewer cannot be significant in any group."""
    seed: int = 0
    """Of the samples; candidates are in canonical order, so the content decides the rest."""
    samples: int = 15_000
    """Triples drawn; up to 45 candidates these are all that exist."""
    min_side_ratio: float = 0.1
    """Shortest side of a sample over the typical distance of candidates from their middle."""
    max_side_disagreement: float = 0.25
    """Largest log ratio between the sides of a sample: bent maps differ by up to a fifth."""
    min_triangle_height: float = 0.1
    """Over the longest side: below it, the rotation about that side is noise."""
    max_scored: int = 300
    """Candidates that samples are drawn from and judged by, evenly over the ranking."""
    max_judged: int = 60_000
    """Samples times candidates that are judged: 5 ms; many candidates need few samples."""
    min_models: int = 200
    """Samples judged in any case."""
    refined_models: int = 10
    """Best samples that are fitted to their inliers; the best alone misses 1 pair of EuRoC."""
    refined_if_settled: int = 3
    """The same where more than half of the candidates agree: the rest are near copies."""
    refinements: int = 10
    """Rounds of fit and judgement; three are usual."""
    max_background: int = 150
    """Candidates whose wrong pairings are the background: 22 350 distances."""
    max_tolerance_ratio: float = 0.2
    """Largest tolerance over the typical distance from the middle; EuRoC needs up to 0.14."""

    max_log_nfa: float = -5.0
    """True pairs of EuRoC: -6.6 at most; halves and shuffled maps: seldom below 0, once -5.5."""
    max_log_nfa_undecided: float = 0.0
    """Above it chance alone is expected to do as well: nothing for loops to settle."""
    min_inliers: int = 10
    """Weak joins are imprecise: below 15 inliers up to 13 % of the radius."""
    min_inlier_ratio: float = 0.32
    """Inliers over candidates. True: 0.37 at least; halves with log NFA below -2: 0.27 at most."""
    min_agreeing_ratio: float = 0.7
    """Of the strong candidates in the overlap. True: 0.79 at least."""
    max_second_ratio: float = 0.5
    """Support of a second alignment over that of the first. True: 0.36 at most."""
    clear_share: float = 0.1
    """Share of the inliers that `max_clear_ratio` is about."""
    max_clear_ratio: float = 0.61
    """True pairs: 0.55 at most; identical façades with log NFA below -5: 0.64 at least."""
    min_peculiar_score: float = -3.5
    """True pairs: -2.4 at least; a façade that is there twice, element by element: -1 to -5."""
    max_peculiar: int = 600
    """Landmarks it is computed from: more would make a small preference significant."""
    overlap_radius: float = 2.5
    """Standard deviations of the inliers about their mean that count as the overlap."""
    agreeing_tolerances: float = 2.0
    """A strong candidate within so many tolerances agrees: maps bend."""
    left_over_tolerances: float = 3.0
    """A second alignment may only use candidates farther off than this from the first."""

    screen_above: int = 12
    """Sub-maps; up to so many, all pairs are matched (66 pairs: 2 s)."""
    hash_tables: int = 32
    """Keys of each landmark. With 20 bits each, descriptors that differ by 10 % of their bits
    meet with probability 0.98, by 20 % with 0.31, unrelated ones (46 %) with 0.0001."""
    hash_bits: int = 20
    max_bucket: int = 64
    """Landmarks under one key, or two per map; more are no sign of one place, but costly."""
    max_alike_binary: float = 0.2
    """Share of bits. EuRoC: three of five true matches are nearer, one of twenty wrong ones."""
    max_alike_sift: float = 0.09
    """Share of the code's bits. Half of the true matches are nearer; at 0.2 foreign sets meet."""
    min_alike: int = 4
    """Look-alikes that make a pair worth matching. EuRoC: joined pairs have 5 to 122."""
    min_alike_ratio: float = 0.003
    """The same over the landmarks of the smaller map: large maps have more look-alikes."""
    best_partners: int = 4
    """Maps that every map is matched with, if it has at least `min_alike_partner` look-alikes."""
    min_alike_partner: int = 2
    """A single look-alike is chance: EuRoC's sessions 2 and 7 have one, and cannot be joined."""

    min_transitive: int = 6
    """Landmarks that other maps say are common before a pair is looked at that no match joined."""
    min_posterior_heard: float = 0.005
    """Below it third maps cannot bring a link up to any threshold."""
    agreement: float = 2.0
    """
    Log odds by which a link gains when both ends have the same partner in a third map.

    With `contradiction`, EuRoC's precision went from 0.853 to 0.857 and its recall from 0.802 to
    0.805 (chosen there); Caliterra's stayed.
    """
    contradiction: float = 1.0
    """Log odds that it loses when they have different ones."""
    min_posterior_sift: float = 0.03
    """
    Of a link, from appearance and position.

    How alike partners look is learnt from first matches that had to stand out; for SIFT that
    leaves out so many right ones that the posterior of the others comes out too low.
    """
    min_posterior_binary: float = 0.6
    """Of 384 bits in a room, 8 of 10 such links are right by id, and nearly all by geometry."""
