# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How heavy the tails of single landmarks are: χ²(3), or F(3, ν) where errors are real."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.optimize

from mapmerge_ros.arrays import Floats
from mapmerge_ros.distributions import chi2_tail, f_log_density, f_log_distribution, f_tail

GAUSSIAN_FREEDOM = 400.0
"""ν from which F(3, ν) cannot be told from χ²(3) by any number of landmarks here."""

MIN_EVIDENCE = 3.0
"""
Log-likelihood ratio from which the tails are not those of Gaussian noise.

Gaussian noise reaches it in one merge of 150.
"""

USUAL_LOG_FREEDOM, LOG_FREEDOM_STD = float(np.log(4.0)), 0.25
"""Where the tails of EuRoC and Caliterra are: what is left of ν where it is hard to tell."""


@dataclass(frozen=True, slots=True)
class Tails:
    """Statistics of unmoved landmarks are 3 scale F(3, freedom)."""

    scale: float
    freedom: float
    """inf: Gaussian"""

    @property
    def mean(self) -> float:
        """How much larger the statistics are than Gaussian ones, on average."""
        if np.isinf(self.freedom):
            return self.scale
        return self.scale * self.freedom / (self.freedom - 2.0)

    def p_value(self, statistic: Floats, redundancy: float = np.inf) -> Floats:
        """Of statistics with 3 degrees of freedom; `redundancy` behind the variances."""
        freedom = min(self.freedom, redundancy)
        if np.isinf(freedom):
            return chi2_tail(statistic, 3)
        return f_tail(statistic / (3.0 * self.scale), 3, freedom)


GAUSSIAN = Tails(1.0, np.inf)


def fit_tails(statistics: Floats, highest: float) -> Tails:
    """
    Tails by maximum likelihood from the statistics below `highest` only.

    What lies beyond (moved objects, wrong matches) must not decide how heavy the tails are, or
    it would hide itself.
    """
    inside = statistics[(statistics < highest) & (statistics > 0.0)]

    def prior(log_freedom: float) -> float:
        return float(0.5 * ((log_freedom - USUAL_LOG_FREEDOM) / LOG_FREEDOM_STD) ** 2)

    def target(logs: Any) -> float:
        scale, freedom = np.exp(logs)
        return prior(float(logs[1])) + _surprise(inside, highest, float(scale), float(freedom))

    heavy: Any = scipy.optimize.minimize(
        target,
        np.array([-0.2, USUAL_LOG_FREEDOM]),
        method='L-BFGS-B',
        bounds=scipy.optimize.Bounds(np.log([0.1, 2.5]), np.log([3.0, 30.0])),
    )
    scale, freedom = np.exp(heavy.x)
    return Tails(float(scale), float(freedom))


def are_gaussian(statistics: Floats, highest: float) -> bool:
    """Whether nothing in the statistics below `highest` speaks for heavier tails than χ²(3)'s."""
    inside = statistics[(statistics < highest) & (statistics > 0.0)]

    def surprise(scale: float, freedom: float) -> float:
        return _surprise(inside, highest, scale, freedom)

    gaussian = scipy.optimize.minimize_scalar(
        lambda x: surprise(np.exp(x), GAUSSIAN_FREEDOM), bounds=(-2.0, 1.0), method='bounded'
    )
    tails = fit_tails(statistics, highest)
    return bool(gaussian.fun - surprise(tails.scale, tails.freedom) < MIN_EVIDENCE)


def _surprise(inside: Floats, highest: float, scale: float, freedom: float) -> float:
    unit = 3.0 * scale
    densities = f_log_density(inside / unit, 3, freedom) - np.log(unit)
    below = f_log_distribution(highest / unit, 3, freedom)
    return float(len(inside) * below - densities.sum())
