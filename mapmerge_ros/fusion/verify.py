# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Whether a merge can be believed: its price against what noise alone would cost."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapmerge_ros.arrays import Ints
from mapmerge_ros.distributions import tail
from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.fusion.config import FusionConfig
from mapmerge_ros.fusion.covariance_model import CovarianceModel
from mapmerge_ros.fusion.examination import Examination, by_textbook
from mapmerge_ros.fusion.honest import TESTED_FIRST, examine, is_large
from mapmerge_ros.fusion.joint.cost import JointCost
from mapmerge_ros.fusion.joint.covariance import Uncertainty
from mapmerge_ros.fusion.joint.near_optimum import near_optimum
from mapmerge_ros.fusion.merge import Estimate
from mapmerge_ros.fusion.misfit import worst_map
from mapmerge_ros.fusion.noise import Noise
from mapmerge_ros.fusion.outcome import ErrorModel, Verdict
from mapmerge_ros.fusion.overlap import Link
from mapmerge_ros.fusion.quadratic import Quadratic
from mapmerge_ros.fusion.refusal import listed
from mapmerge_ros.fusion.search import WEAK_TURN_RAD, loosely_tied
from mapmerge_ros.geometry import Gauge

MOST_NAMED = 3
"""Sub-maps that are named in one sentence."""


def degrees_of_freedom(views: Ints, gauges: Sequence[Gauge], gauge: Gauge) -> int:
    """Σ 3 κ_i (i - 1) - (Σ g_k - g): eq. 13 for sub-maps of any gauge."""
    locked = 3 * int(np.sum(np.maximum(views - 1, 0)))
    return locked - (sum(int(own) for own in gauges) - int(gauge))


def verify(a_tilde: float, dof: int, noise: Noise, config: FusionConfig) -> Verdict:
    """
    Test the price of merging: Γ(dof/2, 1/2σ²) for known σ, F for an estimated one.

    With nothing merged (dof = 0) there is nothing to doubt.
    """
    if dof <= 0:
        return Verdict(a_tilde, 0, noise.sigma, float('nan'), 1.0, accepted=True, reason='')
    factor = a_tilde / (dof * noise.sigma**2)
    p_value = float(tail(factor * dof, dof, noise.estimated_from or np.inf))
    accepted = p_value >= config.significance
    reason = (
        ''
        if accepted
        else (
            f'the merge costs {factor:.3g} times what noise of {noise.sigma:.3g} px explains '
            f'(p {_rounded(p_value)}, below {config.significance:g})'
        )
    )
    return Verdict(
        a_tilde, dof, noise.sigma, factor, p_value, accepted, reason, textbook_p_value=p_value
    )


@dataclass(frozen=True, slots=True, eq=False)
class Verified:
    """A merge with its test."""

    verdict: Verdict
    examination: Examination | None = None
    certain: bool = False
    """Whether its basin is"""


def verify_merge(
    map_ids: Sequence[str],
    reduced: JointCost,
    estimate: Estimate,
    links: Sequence[Link],
    gauge: Gauge,
    dof: int,
    noise: Noise,
    config: FusionConfig,
    known: CovarianceModel | None = None,
    taken_out: int = 0,
    learn: Callable[[Uncertainty], None] | None = None,
) -> Verified:
    """
    Test a merge, with the errors that maps of real cameras have where the textbook refuses.

    `reduced` is the cost of the shared landmarks, as merged. What the textbook accepts
    stays accepted, with its own p-value, unless its landmarks are not Gaussian; what moved
    together is refused as long as it is merged. `known` are the errors of these sub-maps, if
    something has been taken out of their merge already; `taken_out` single landmarks that do not
    fit are among it. `learn` is told what is known of landmarks and frames, where all of the
    inverse was needed.
    """
    textbook = verify(estimate.cost, dof, noise, config)
    if dof <= 0:
        return Verified(textbook)
    redundancy = noise.estimated_from or np.inf
    large = is_large(reduced.segments.lengths, len(estimate.points))
    if large and textbook.p_value >= TESTED_FIRST:
        return Verified(textbook, by_textbook(estimate.cost / noise.sigma**2, dof, redundancy))
    loose = loosely_tied(links, len(reduced))
    certain = estimate.converged and not loose
    state = reduced.evaluate(estimate.points)
    merge = near_optimum(reduced, state, gauge, noise.sigma, learn)
    found = examine(merge, redundancy, certain=certain, known=known, taken_out=taken_out)
    verdict = _judged(textbook, found, config, taken_out)
    if loose and verdict.reason:
        verdict = replace(verdict, reason=f'{verdict.reason}; {_may_be_turned(loose, map_ids)}')
    return Verified(verdict, found, certain)


def unless_one_is_wrong(
    verified: Verified, map_ids: Sequence[str], near_optimum: Callable[[], Quadratic]
) -> Verdict:
    """
    Refuse a merge in which one sub-map differs from all others by more than they differ.

    Where a model was needed: for that it is fitted once more, to the others. The merge
    `near_optimum` is asked for then.
    """
    verdict, found = verified.verdict, verified.examination
    if found is None:
        return verdict
    if scale := found.wrong_scale:
        reason = (
            f'{map_ids[scale.k]} is {np.expm1(scale.log_scale):+.2%} larger than the others have '
            f'it, ± {scale.std:.2%} by what they claim'
        )
        return replace(verdict, accepted=False, reason=reason, suspect=map_ids[scale.k])
    if not (verdict.accepted and verified.certain and verdict.errors is not None):
        return verdict
    try:
        worst = worst_map(near_optimum())
    except (DegenerateGeometry, np.linalg.LinAlgError):
        return verdict
    if worst is None or worst.is_believed:
        return verdict
    suspect = map_ids[worst.k]
    reason = f'{suspect} alone differs {worst.ratio:.3g} times as much as the errors of the others'
    return replace(verdict, accepted=False, reason=f'{reason} explain', suspect=suspect)


def _judged(
    textbook: Verdict, found: Examination, config: FusionConfig, taken_out: int
) -> Verdict:
    model, moved = found.model, sum(len(each.members) for each in found.objects)
    if textbook.accepted and not moved and (model is None or model.is_textbook):
        return textbook
    if model is None:
        return replace(textbook, moved=moved)
    p_value = min(found.p_value, found.p_objects)  # as long as they are merged like all else
    accepted, aside = p_value >= config.significance and not moved, len(found.aside)
    errors = ErrorModel(
        model.phi,
        model.tau / model.radius,
        model.omega / model.radius,
        model.tails.freedom,
        found.price,
        found.dof,
    )
    return replace(
        textbook,
        p_value=p_value,
        accepted=accepted,
        reason='' if accepted else _why(textbook, p_value, moved, aside + taken_out, errors),
        errors=errors,
        set_aside=aside,
        moved=moved,
    )


def _why(textbook: Verdict, p_value: float, moved: int, aside: int, errors: ErrorModel) -> str:
    price = f'the merge costs {textbook.variance_factor:.3g} times what noise of '
    price += f'{textbook.sigma:.3g} px explains'
    if moved:
        return f'{price}: {moved} landmarks moved together with their neighbours'
    return (
        f'{price}, and no plausible error of the maps does (p {_rounded(p_value)}; variances × '
        f'{errors.phi:.2g}, warp {errors.omega_ratio:.2%} of the scene, {aside} landmarks aside)'
    )


def _may_be_turned(loose: Sequence[int], map_ids: Sequence[str]) -> str:
    """Why errors of the maps are not asked whether they explain the price."""
    names = [map_ids[k] for k in loose[:MOST_NAMED]]
    names += [f'{len(loose) - MOST_NAMED} more'] if len(loose) > MOST_NAMED else []
    return (
        f'the rotation of {listed(names)} among the others is known to no better than '
        f'{WEAK_TURN_RAD:g} rad, so a wrong place is not told from errors of the maps'
    )


def _rounded(p_value: float) -> str:
    return f'= {p_value:.2g}' if p_value >= 1e-300 else '< 1e-300'
