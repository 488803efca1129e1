# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
Covariance of the differences between real sub-maps, fitted robustly from the merge itself.

φ times what the sub-maps say, plus τ² a ground floor that no sub-map knows of, plus ω² a smooth
field over each map (a lens that is not quite the calibrated one). docs/statistics.md
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.fusion.contrasts import Contrasts
from mapmerge_ros.fusion.element import coordinates
from mapmerge_ros.fusion.likelihood import (
    Weighing,
    derivatives,
    log_likelihood,
    step,
    weigh,
    with_usual_phi,
)
from mapmerge_ros.fusion.local import Sensitivity
from mapmerge_ros.fusion.quadratic import Quadratic
from mapmerge_ros.fusion.tails import Tails, fit_tails
from mapmerge_ros.fusion.trimming import trimmed

MAX_STEPS, SETTLED = 12, 0.02
"""Steps, and the relative change below which they end: a tenth of the fit's own uncertainty."""

TRIM_ROUNDS = 4
"""Times that the landmarks set aside are chosen anew; two are usual."""

LARGEST_TAIL = 150.0
"""
Statistic beyond which a landmark says nothing about tails: it has moved, or is a wrong match.

The largest of an unmoved landmark of EuRoC and Caliterra is 128.
"""

COARSE_CONTRASTS, FINE_STEPS = 200, 2
"""
Contrasts on which the fit walks most of its way, and the steps that it then takes on all.

Three variances need no more for single landmarks: 600 differences give φ to 6 %. The price of all
does: without these steps it is up to 1.2 times its degrees of freedom, p = 1e-6, on merges of 400
landmarks in which nothing is wrong. A step on 600 contrasts takes 0.3 s.
"""

CLEAR_GAIN = 30.0
"""Log-likelihood over the textbook's on some of the tracks from which nobody asks all of them."""


TEXTBOOK = np.array([1.0, 0.0, 0.0])
"""Variances of sub-maps that are what they claim."""


@dataclass(frozen=True, slots=True, eq=False)
class CovarianceModel:
    """Variances of the differences between sub-maps, as fitted."""

    variances: Floats
    """(3,) φ, τ² and ω² in `unit`²"""
    unit: float
    """Typical standard deviation of a difference [map units]"""
    radius: float
    """Of the scene [map units]"""
    tails: Tails
    steps: int

    @property
    def is_textbook(self) -> bool:
        """Whether the sub-maps are believed to the letter."""
        return bool(np.array_equal(self.variances, TEXTBOOK))

    @property
    def phi(self) -> float:
        """Factor on the variances that the sub-maps claim."""
        return float(self.variances[0])

    @property
    def tau(self) -> float:
        """Ground floor [map units]."""
        return float(self.unit * np.sqrt(self.variances[1]))

    @property
    def omega(self) -> float:
        """Smooth field [map units]."""
        return float(self.unit * np.sqrt(self.variances[2]))

    def variances_of(self, data: Contrasts) -> Floats:
        """Variances (3,) in the unit of other differences of the same sub-maps."""
        if self.is_textbook:
            return self.variances
        scale = self.unit / self.radius * data.radius / data.unit
        return np.asarray(self.variances * np.array([1.0, scale**2, scale**2]))


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """A model with what it was fitted to."""

    model: CovarianceModel
    aside: Ints
    """Members too far off to have a say, one of a track at most"""
    statistics: Floats
    """(tracks,) of the worst member of each track, those aside given each other"""
    gain: float
    """Log-likelihood over that of the textbook: φ = 1, τ = ω = 0"""
    price: float
    """Of what is neither moved nor aside, χ²(dof) if the variances are right"""
    dof: int
    weighing: Weighing
    """Of all differences"""


def fit_model(data: Contrasts, highest: Floats, moved: Ints) -> Fitted:
    """
    Fit φ, τ, ω within `highest` (3,), and the tails; `moved` members (objects) have no say.

    First on some of the tracks, then on all of them.

    Raises
    ------
    DegenerateGeometry
        The differences have no definite covariance.

    """
    start = np.minimum([1.0, 0.1, 0.1], highest)
    # As many as frames have directions: of each map then two thirds are left.
    coarse = data.thinned(max(COARSE_CONTRASTS, data.frames.shape[1]))
    variances, aside, taken = _iterate(coarse, start, highest, moved, MAX_STEPS)
    if coarse is data:
        return settled(data, variances, moved, aside, taken)
    gain = settled(coarse, variances, moved, aside).gain
    variances, aside, more = _iterate(data, variances, highest, moved, FINE_STEPS)
    clear = gain if gain >= CLEAR_GAIN else None
    return settled(data, variances, moved, aside, taken + more, gain=clear)


def as_known(data: Contrasts, model: CovarianceModel, moved: Ints) -> Fitted:
    """
    Take a model as it is, that was fitted when more of the landmarks were in.

    What is left after the worst of them have been taken out is a truncated sample: tails fitted
    to it are too thin, so that its own worst are taken for wrong in turn, and warp for objects.
    """
    known = settled(data, model.variances_of(data), moved, np.zeros(0, np.int64), gain=np.inf)
    return replace(known, model=replace(known.model, tails=model.tails, steps=model.steps))


def settled(
    data: Contrasts,
    variances: Floats,
    moved: Ints,
    aside: Ints,
    steps: int = 0,
    *,
    gain: float | None = None,
) -> Fitted:
    """
    Everything that follows once the variances are given; `aside` is where trimming starts.

    `gain` is that over the textbook, where it is known.
    """
    moved = moved[data.owners[moved] >= 0]
    blind, everything = data.blind_to(moved), weigh(data, variances)
    weighing = everything.blind_to(blind.frames[:, data.frames.shape[1] :])
    for _ in range(TRIM_ROUNDS):
        before = aside
        aside, worst = trimmed(blind, weighing, aside, moved)
        if np.array_equal(before, aside):
            break
    rest = weighing.unlocked(blind, aside)
    if gain is None:
        gain = rest.log_likelihood - log_likelihood(blind, TEXTBOOK, aside)
    tails = fit_tails(worst, LARGEST_TAIL)
    return Fitted(
        CovarianceModel(variances, data.unit, data.radius, tails, steps),
        aside,
        worst,
        gain=gain,
        price=rest.price(data),
        dof=blind.dof - 3 * len(aside),
        weighing=everything,
    )


def model_sensitivity(merge: Quadratic, data: Contrasts, weighing: Weighing) -> Sensitivity:
    """Local tests under a covariance: s = C'P w, J = C'P C."""
    # Of tracks that are not in the sample nothing is known: their rows are zero.
    present = np.flatnonzero(data.owners >= 0)
    within = []
    for k in range(len(merge.information)):
        part = merge.members.of_map(k)
        low, high = np.searchsorted(present, [part.start, part.stop])
        own, at = data.columns(present[low:high]), coordinates(present[low:high] - part.start)
        block = np.zeros((3 * (part.stop - part.start),) * 2)
        block[np.ix_(at, at)] = weighing.seen(own) @ own
        within.append(block)
    everyone = data.columns(present)

    def columns(chosen: Ints) -> Floats:
        answers = np.zeros((3 * len(merge.members), 3 * len(chosen)))
        answers[coordinates(present)] = everyone.T @ weighing.seen(data.columns(chosen)).T
        return answers

    return Sensitivity(
        members=merge.members,
        score=data.scores(weighing.weighted),
        within=tuple(within),
        columns=columns,
        price=weighing.price(data),
        dof=data.dof,
        unlocked=data.owners < 0,
    )


def _iterate(
    data: Contrasts, variances: Floats, highest: Floats, moved: Ints, steps: int
) -> tuple[Floats, Ints, int]:
    moved = moved[data.owners[moved] >= 0]
    blind = data.blind_to(moved)
    aside, taken = np.zeros(0, np.int64), 0
    while taken < steps:
        taken += 1
        weighing = weigh(blind, variances)
        before = aside
        aside, _ = trimmed(blind, weighing, aside, moved)
        without = weighing.unlocked(blind, aside)
        slopes = with_usual_phi(variances, *derivatives(blind, without))
        following = step(variances, *slopes, highest)
        change = np.abs(following - variances).max() / following.sum()
        variances = following
        if change < SETTLED and np.array_equal(before, aside):
            break
    return variances, aside, taken
