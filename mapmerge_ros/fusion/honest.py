# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
A merge examined with errors that maps of real cameras have: objects, model, landmarks, price.

In this order, since it matters: objects are put aside before the model is fitted, or the smooth
field swallows them; they are put back under the model, or warp is called an object.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.distributions import binomial_tail, chi2_quantile, product_tail, tail
from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.fusion.conditional import conditional_tests
from mapmerge_ros.fusion.confirm import (
    confirmed,
    members_of,
    p_objects,
    without_bystanders,
)
from mapmerge_ros.fusion.contrasts import MANY_CONTRASTS, Contrasts, contrasts
from mapmerge_ros.fusion.covariance_model import (
    LARGEST_TAIL,
    TEXTBOOK,
    CovarianceModel,
    Fitted,
    as_known,
    fit_model,
    model_sensitivity,
    settled,
)
from mapmerge_ros.fusion.doubtful import doubtful_members
from mapmerge_ros.fusion.examination import Examination, by_textbook
from mapmerge_ros.fusion.local import Sensitivity, forward_selection, sensitivity
from mapmerge_ros.fusion.objects import (
    LEAST_STATISTIC,
    MovedObject,
    find_objects,
)
from mapmerge_ros.fusion.plausible import largest_variances, p_plausible
from mapmerge_ros.fusion.quadratic import Quadratic
from mapmerge_ros.fusion.sample import LEAST_OF_A_MAP
from mapmerge_ros.fusion.scales import wrong_scale
from mapmerge_ros.fusion.tails import GAUSSIAN, are_gaussian

MIN_CONTRASTS, MAX_CONTRASTS = 4, 600
"""
Of fewer nothing can be said; of more, every n-th track stands for all.

The cost goes with the cube: 600 take 0.3 s a step.
"""

MIN_GAIN, MIN_GAIN_OF_FEW = 8.0, 3.0
"""
Log-likelihood that a model must bring to be preferred to the textbook, of many and of few.

Twice that is χ²(3) where noise is Gaussian: p = 0.001. Real sets have 27 to 4000, but two real
maps with 4 to 50 landmarks in common often less, and the textbook refuses two in five of them.
φ alone brings 3 where the textbook's price is significant at one per cent.
"""

BAD_LEVEL, BAD_SHARE = 1e-3, 0.01
"""p-value from which a landmark is one too many, and the share of those that is believed."""

MAX_SINGLES = 0.15
"""Share of the landmarks that are unlocked one by one, at most, where the textbook is believed."""

TESTED_FIRST = 0.05
"""p-value of the textbook from which nothing else is fitted, if the landmarks look Gaussian."""

MAX_TRACKS, MAX_CUBES = 650, 2e9
"""
Merged landmarks up to which single ones are tested and objects looked for, whatever overlaps.

Beyond, the sum over sub-maps of the cube of the landmarks that each shares: what it costs.
256 drones of a hundred landmarks have 2e8: twice the time of the merge, and 0.2 GB. Of more, the
price is tested on a sample.
"""

MAX_REFITS = 3
"""
Fits with other objects off, until these are those that stand under the fit; one is usual.

A model in which an object had no say that is none any more would be too narrow for the rest.
"""

MEDIAN_CHI2 = chi2_quantile(0.5, 3)


def examine(
    merge: Quadratic,
    redundancy: float,
    *,
    certain: bool,
    known: CovarianceModel | None = None,
    taken_out: int = 0,
) -> Examination:
    """
    Examine a merge at its optimum.

    `redundancy` is that of an estimated σ (inf: known). Without `certain` geometry (a rotation
    between sub-maps weakly determined, no convergence) an excess may be a wrong basin, and only
    the textbook test is believed. `known` is the model of the same sub-maps, fitted before the
    worst of their landmarks were taken out: how many of these did not fit, each by itself, is
    `taken_out`. What moved is no error of a map, and ids that contradict are wrong links.

    Raises
    ------
    DegenerateGeometry
        A landmark is not determined.

    """
    plain = by_textbook(merge.price, merge.dof, redundancy)
    large = is_large(np.bincount(merge.members.maps), len(merge.points))
    state, gaussian = None, True
    if not large:
        # A sub-map may count so little that of its landmarks only rounding is left.
        with suppress(np.linalg.LinAlgError):
            expected = known if certain else None
            state, plain, gaussian = _by_landmark(merge, redundancy, plain, expected)
    count = len(merge.members) - len(merge.points)
    # Of a few landmarks nobody can say what law they follow.
    gaussian |= count < MANY_CONTRASTS and not plain.objects
    if not certain or count < MIN_CONTRASTS or _is_enough(plain, gaussian=gaussian):
        return _with_doubtful(plain, state) if state and certain else plain
    try:
        found = _under_model(merge, state, plain.objects, known, taken_out)
        return replace(found, textbook_tests=plain.textbook_tests, wrong_scale=plain.wrong_scale)
    except (DegenerateGeometry, np.linalg.LinAlgError):
        # So far off that no covariance describes it. What moved may not have been looked for yet.
        with suppress(np.linalg.LinAlgError):
            return replace(plain, objects=_suspects(state, merge, plain)) if state else plain
        return plain


def _is_enough(plain: Examination, *, gaussian: bool) -> bool:
    """Whether nothing asks for more than the textbook."""
    return gaussian and plain.p_value >= TESTED_FIRST


def _by_landmark(
    merge: Quadratic, redundancy: float, plain: Examination, known: CovarianceModel | None
) -> tuple[Sensitivity, Examination, bool]:
    """
    Tests of all landmarks by the textbook, what looks moved, and whether they are Gaussian.

    Under errors that are `known` already, what moved shows without such suspects, if no track
    is left out of the sample: of others only the suspects are in it.
    """
    state = sensitivity(merge, redundancy)
    tests = state.tests()
    statistics = tests.statistic[tests.distinct]
    scale = wrong_scale(state, merge)
    found = replace(plain, tests=tests, textbook_tests=tests, wrong_scale=scale)
    gaussian = are_gaussian(statistics, LARGEST_TAIL)
    count = len(merge.members) - len(merge.points)
    most = max(count, LEAST_OF_A_MAP * len(merge.information))
    is_whole = count >= MANY_CONTRASTS and most <= MAX_CONTRASTS
    if known and not known.is_textbook and is_whole and not _is_enough(found, gaussian=gaussian):
        return state, found, gaussian
    suspects = _suspects(state, merge, found)
    return state, replace(found, objects=suspects), gaussian and not suspects


def _suspects(state: Sensitivity, merge: Quadratic, plain: Examination) -> tuple[MovedObject, ...]:
    """What looks moved by the textbook, if that has not been looked for yet."""
    tests = plain.textbook_tests
    if plain.objects or tests is None:
        return plain.objects
    usual = _usual(tests.statistic[tests.distinct])
    return find_objects(state, merge.points, LEAST_STATISTIC * usual)


def is_large(landmarks: Ints, tracks: int) -> bool:
    """Whether sub-maps share too many landmarks (maps,) for tests of single ones."""
    return tracks > MAX_TRACKS and float(np.sum(landmarks.astype(float) ** 3)) > MAX_CUBES


def _usual(statistics: Floats) -> float:
    """How much larger the statistics are than Gaussian ones, by the median; at least 1."""
    return max(1.0, float(np.median(statistics)) / MEDIAN_CHI2) if len(statistics) else 1.0


def _with_doubtful(plain: Examination, state: Sensitivity) -> Examination:
    """Believe the textbook: singles are unlocked one after the other."""
    moved = members_of(plain.objects)
    rest = state.unlock(moved) if len(moved) else state
    _, singles = forward_selection(
        rest, BAD_LEVEL, int(MAX_SINGLES * len(np.unique(state.members.tracks)))
    )
    tests = conditional_tests(state, np.union1d(moved, singles))
    return replace(plain, tests=tests, doubtful=doubtful_members(tests, moved))


def _under_model(
    merge: Quadratic,
    textbook: Sensitivity | None,
    suspects: tuple[MovedObject, ...],
    known: CovarianceModel | None,
    taken_out: int,
) -> Examination:
    data = contrasts(merge, MAX_CONTRASTS, members_of(suspects))
    # As many as there are for the part of the tracks that is tested.
    gone = taken_out * len(np.unique(data.tracks)) / len(merge.points)
    highest = largest_variances(data)
    fitted = _fit(data, highest, members_of(suspects), known)
    if textbook is None:
        return _judged(fitted, np.inf, gone)
    objects, state = suspects, _state(merge, data, textbook, fitted)
    for _ in range(MAX_REFITS):
        before, objects = objects, confirmed(state, merge.points, objects, fitted.model)
        if set(members_of(objects)) == set(members_of(before)):
            break
        # from the start: variances that were fitted with half of the warp unlocked mislead
        fitted = _fit(data, highest, members_of(objects), known)
        state = _state(merge, data, textbook, fitted)
    objects = without_bystanders(state, merge.points, objects, fitted.model)
    moved = members_of(objects)
    tests = conditional_tests(state, np.union1d(moved, fitted.aside))
    p_values = fitted.model.tails.p_value(tests.statistic, state.redundancy)
    tests = replace(tests, p_value=np.where(tests.testable, p_values, 1.0))
    return replace(
        _judged(fitted, state.redundancy, gone),
        objects=objects,
        p_objects=p_objects(objects, fitted.model),
        tests=tests,
        doubtful=doubtful_members(tests, moved),
    )


def _fit(data: Contrasts, highest: Floats, moved: Ints, known: CovarianceModel | None) -> Fitted:
    if known is not None:
        return as_known(data, known, moved)
    fitted = fit_model(data, highest, moved)
    if fitted.gain >= (MIN_GAIN if len(data.tracks) >= MANY_CONTRASTS else MIN_GAIN_OF_FEW):
        return fitted
    plain = settled(data, TEXTBOOK, moved, np.zeros(0, np.int64))
    return replace(plain, model=replace(plain.model, tails=GAUSSIAN))


def _state(
    merge: Quadratic, data: Contrasts, textbook: Sensitivity, fitted: Fitted
) -> Sensitivity:
    if fitted.model.is_textbook:
        return textbook
    return replace(model_sensitivity(merge, data, fitted.weighing), follow=textbook.follow)


def _judged(fitted: Fitted, redundancy: float, gone: float = 0.0) -> Examination:
    """
    Believe the rest by its price, the number of bad landmarks and the worst of them.

    And by what had to be believed of the maps for that, all of it together. Landmarks that are
    `gone`, since they did not fit either, are too far off like those that are aside now.
    """
    count, model = len(fitted.statistics), fitted.model
    p_values = model.tails.p_value(fitted.statistics, redundancy)
    bad = int((p_values < BAD_LEVEL).sum())
    plausible = p_plausible(
        model.phi, model.omega / model.radius, len(fitted.aside) + gone, count + gone
    )
    # Where too many are off, nothing is left that has a price.
    priced = plausible
    if fitted.dof > 0:
        priced = float(tail(np.array(fitted.price), fitted.dof, redundancy))
        # Beside the textbook nothing had to be believed.
        priced = priced if model.is_textbook else product_tail(priced * plausible)
    parts = (
        priced,
        binomial_tail(bad, count, BAD_SHARE),
        float(-np.expm1(count * np.log1p(-p_values.min(initial=0.5)))),
    )
    p_value = min(1.0, len(parts) * min(parts))
    return Examination(fitted.price, fitted.dof, p_value, model=model, aside=fitted.aside)
