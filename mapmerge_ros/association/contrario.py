# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
How surprising the agreement of an alignment with its candidates is, a contrario.

The threshold that separates inliers and the significance of their number are chosen together:
those for which the expected number of as good alignments among wrong pairings is least.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln

from mapmerge_ros.arrays import Floats


@dataclass(frozen=True, slots=True, eq=False)
class Background:
    """Distances that wrong pairings have."""

    distances: Floats
    """(w,) ascending"""

    def log10_probability(self, distances: Floats) -> Floats:
        """Log10 of the chance that a wrong pairing is as near; never below one in w."""
        below = np.searchsorted(self.distances, distances, side='right')
        chance: Floats = np.log10((below + 1.0) / (len(self.distances) + 1.0))
        return np.minimum(chance, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class Significance:
    """The best threshold of each of m alignments."""

    log_nfa: Floats
    """(m,) log10 of the expected number by chance"""
    inliers: Floats
    """(m,)"""
    tolerances: Floats
    """(m,) distance of the farthest inlier"""


def combinations(count: int, sample: int) -> Floats:
    """Log10 of the number of tests for k = sample + 1 ... count inliers."""
    k = np.arange(sample + 1.0, count + 1.0)
    ways: Floats = _log_choose(count, k) + _log_choose(k, sample)
    tests: Floats = (ways + np.log(max(count - sample, 1))) / np.log(10.0)
    return tests


def significance(
    distances: Floats, background: Background, sample: int, max_tolerance: float
) -> Significance:
    """Best threshold for each row of `distances` (m, n); `sample` candidates fit for free."""
    count = distances.shape[1]
    ordered = np.sort(distances, axis=1)[:, sample:]
    k = np.arange(sample + 1.0, count + 1.0)
    chance = background.log10_probability(ordered)
    log_nfa: Floats = combinations(count, sample) + (k - sample) * chance
    log_nfa = np.where(ordered <= max_tolerance, log_nfa, np.inf)
    best = log_nfa.argmin(axis=1)
    rows = np.arange(len(distances))
    return Significance(log_nfa[rows, best], k[best], ordered[rows, best])


def _log_choose(n: Floats | int, k: Floats | int) -> Floats:
    n, k = np.asarray(n, np.float64), np.asarray(k, np.float64)
    chosen: Floats = gammaln(n + 1.0) - gammaln(k + 1.0) - gammaln(n - k + 1.0)
    return chosen
