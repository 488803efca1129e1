# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How heavy the tails of single landmarks are: χ²(3) until the data say otherwise, then F(3, ν)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.optimize
import scipy.stats

from mapmerge_ros.arrays import Floats

GAUSSIAN_FREEDOM = 400.0
"""ν from which F(3, ν) cannot be told from χ²(3) by any number of landmarks here."""

MIN_EVIDENCE = 3.0
"""
Log-likelihood ratio from which tails are believed.

Gaussian noise reaches it in one merge of 150; every real set has 4 or more on 220 landmarks.
"""

USUAL_LOG_FREEDOM, LOG_FREEDOM_STD = np.log(4.0), 0.25
"""Where the tails of EuRoC and Caliterra are: what is left of ν where it is hard to tell."""


@dataclass(frozen=True, slots=True)
class Tails:
    """Statistics of unmoved landmarks are 3 scale F(3, freedom)."""

    scale: float
    freedom: float
    """inf: Gaussian"""

    def p_value(self, statistic: Floats, redundancy: float = np.inf) -> Floats:
        """Of statistics with 3 degrees of freedom; `redundancy` behind the variances."""
        freedom = min(self.freedom, redundancy)
        if np.isinf(freedom):
            return np.asarray(scipy.stats.chi2.sf(statistic, 3))
        return np.asarray(scipy.stats.f.sf(statistic / (3.0 * self.scale), 3, freedom))


GAUSSIAN = Tails(1.0, np.inf)


def fit_tails(statistics: Floats, highest: float) -> Tails:
    """
    Tails by maximum likelihood from the statistics below `highest` only.

    What lies beyond (moved objects, wrong matches) must not decide how heavy the tails are, or
    it would hide itself.
    """
    inside = statistics[(statistics < highest) & (statistics > 0.0)]

    def surprise(scale: float, freedom: float) -> float:
        law = scipy.stats.f(3, freedom, scale=3.0 * scale)
        return float(len(inside) * law.logcdf(highest) - law.logpdf(inside).sum())

    def prior(log_freedom: float) -> float:
        return float(0.5 * ((log_freedom - USUAL_LOG_FREEDOM) / LOG_FREEDOM_STD) ** 2)

    gaussian = scipy.optimize.minimize_scalar(
        lambda x: surprise(np.exp(x), GAUSSIAN_FREEDOM), bounds=(-2.0, 1.0), method='bounded'
    )
    heavy = scipy.optimize.minimize(
        lambda x: surprise(np.exp(x[0]), np.exp(x[1])) + prior(x[1]),
        [-0.2, USUAL_LOG_FREEDOM],
        method='L-BFGS-B',
        bounds=[(-2.0, 1.0), (np.log(2.0), np.log(30.0))],
    )
    scale, freedom = np.exp(heavy.x)
    if gaussian.fun - surprise(scale, freedom) < MIN_EVIDENCE:
        return GAUSSIAN
    return Tails(float(scale), float(freedom))
