# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
How far a merge may bend: its weakest directions followed along the valley of the cost.

Where the rotations between sub-maps are weakly determined, the landmarks that the data allow lie
along a curve. An ellipsoid about the optimum leaves it after one standard deviation: in rooms
whose corners are within 0.1 m, the truth was outside the 99 % ellipsoid in 16 % of the merges.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from mapmerge_ros.arrays import Floats
from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.fusion.compress import Normal, frame_covariance, normal_equations
from mapmerge_ros.fusion.element import Element, Placement
from mapmerge_ros.geometry import align, gauge_basis
from mapmerge_ros.submap import alignment_weights

DIRECTIONS, WEAK_RATIO = 3, 0.25
"""
Weakest directions that are followed at most, and the least std over that of the weakest.

What a direction bends goes with its variance. In closed rooms the second is ten times stiffer, in
a room that is open at one corner three hinges are alike.
"""

LOOSE_TURN_RAD = 0.02
"""
Standard deviation of a sub-map's rotation up to which its merge counts as straight.

In 60 wide rooms it is 0.010 to 0.019 and the ellipsoid covers what it claims; in 60 narrow ones
0.029 to 0.099. Everyday merges are below 0.005 and pay nothing.
"""

STEP, MAX_STEPS = 0.7, 24
"""Along the valley, in standard deviations; the trapezoidal rule is exact to 1e-4 at that."""

MAX_RISE = 9.0
"""Of the cost over σ²: beyond three standard deviations nothing is left to weigh."""

WIDEST = 3.0
"""
Largest temperature at which the points of a valley are weighed.

What bends has longer tails than an ellipsoid of its size: with the second moments of the curve
itself, 93 % of 100 narrow merges hold the truth where 99 % are claimed. At twice the temperature
96.5 % of 400 others do, at three times 97.8 %.
"""

LEAST_GAIN = 0.02
"""Relative growth of a variance (1 % of the standard deviation) that is not worth reporting."""

LEAST_VARIANCE = 1e-12
"""Of the largest: what is below is rounding, and not to be whitened."""

SETTLING_STEPS, SETTLED = 8, 1e-3
"""Gauss-Newton steps per point; done when a step promises less than this share of σ²."""


@dataclass(frozen=True, slots=True, eq=False)
class _Stop:
    """A point of the valley."""

    points: Floats
    """(n, 3)"""
    covariance: Floats
    """(3n, 3n) as if this were the optimum"""
    offset: float
    """Along the direction that is followed [map units]"""
    rise: float
    """Of the cost, over σ²"""


def as_wide_as_it_is(
    elements: Sequence[Element], placements: Sequence[Placement], normal: Normal, sigma: float
) -> tuple[Normal, Floats]:
    """Information and covariance (3n, 3n) of a merge, not surer than its bent region allows."""
    covariance = normal.covariance(sigma)
    if len(elements) < 2:
        return normal, covariance
    frames = [
        frame_covariance(element, placement, covariance)[:3, :3]
        for element, placement in zip(elements, placements, strict=True)
    ]
    if max(np.linalg.eigvalsh(turn)[-1] for turn in frames) < LOOSE_TURN_RAD**2:
        return normal, covariance
    spread = excess_spread(elements, normal, covariance, sigma)
    return normal.loosened(spread, sigma), covariance + spread @ spread.T


def excess_spread(
    elements: Sequence[Element], normal: Normal, covariance: Floats, sigma: float
) -> Floats:
    """
    Columns U (3n, k): the landmarks spread by covariance + U U', bends included.

    No column where the merge is as straight as its covariance (3n, 3n) says. Only ever adds.
    """
    variances, directions = np.linalg.eigh(covariance)
    free = slice(int(normal.gauge), None)  # the gauge has none, and they ascend
    roots = np.sqrt(np.maximum(variances[free], LEAST_VARIANCE * variances[-1]))
    root, white = directions[:, free] * roots, (directions[:, free] / roots).T
    spread = np.zeros((len(covariance), 0))
    for k in range(1, DIRECTIONS + 1):
        std = float(np.sqrt(max(variances[-k], 0.0)))
        if std < WEAK_RATIO * np.sqrt(variances[-1]):
            break
        bottom = _Stop(normal.points, covariance, 0.0, 0.0)
        stops = _valley(elements, normal, bottom, directions[:, -k], std, sigma)
        moments = _second_moments(stops, normal, directions[:, -k], white)
        gains, axes = np.linalg.eigh(white @ moments @ white.T - np.eye(len(white)))
        grown = gains > LEAST_GAIN
        if not grown.any():
            break
        spread = np.column_stack([spread, root @ (axes[:, grown] * np.sqrt(gains[grown]))])
    return spread


def _valley(
    elements: Sequence[Element],
    normal: Normal,
    bottom: _Stop,
    direction: Floats,
    std: float,
    sigma: float,
) -> list[_Stop]:
    """Points along the valley in order, the optimum among them."""
    level = _cost(elements, normal.points)
    sides = list[list[_Stop]]()
    for step in (-STEP * std, STEP * std):
        stops = [bottom]
        ahead = step * direction.reshape(-1, 3)
        while len(stops) <= MAX_STEPS and stops[-1].rise < MAX_RISE:
            last, offset = stops[-1].points, stops[-1].offset + step
            try:
                found = _settled(elements, normal, direction, offset, last + ahead, sigma)
                covariance = found.covariance(sigma)
            except (DegenerateGeometry, np.linalg.LinAlgError):
                break
            rise = (_cost(elements, found.points) - level) / sigma**2
            if not np.isfinite(rise):
                break
            stops.append(_Stop(found.points, covariance, offset, rise))
            ahead = found.points - last
        sides.append(stops)
    return [*reversed(sides[0][1:]), *sides[1]]


def _settled(
    elements: Sequence[Element],
    bottom: Normal,
    direction: Floats,
    offset: float,
    points: Floats,
    sigma: float,
) -> Normal:
    """Cheapest landmarks among those displaced from the bottom by `offset` along `direction`."""
    for _ in range(SETTLING_STEPS):
        current = _linearised(elements, points, bottom)
        null = gauge_basis(points, bottom.gauge)
        weight = float(np.mean(np.diag(current.information)))
        fixed = current.information + weight * null @ null.T
        factor = scipy.linalg.cho_factor(fixed, check_finite=False)
        free, pulled = scipy.linalg.cho_solve(
            factor, np.column_stack([-current.gradient, direction]), check_finite=False
        ).T
        missing = offset - direction @ ((points - bottom.points).ravel() + free)
        step = free + missing / (direction @ pulled) * pulled
        points = points + step.reshape(-1, 3)
        if step @ fixed @ step < SETTLED * sigma**2:
            break
    return _linearised(elements, points, bottom)


def _linearised(elements: Sequence[Element], points: Floats, like: Normal) -> Normal:
    placements = [element.place(points) for element in elements]
    return normal_equations(elements, points, placements, like.gauge)


def _cost(elements: Sequence[Element], points: Floats) -> float:
    residuals = [element.residuals(element.place(points)) for element in elements]
    return float(sum(e @ e for e in residuals))


def _second_moments(
    stops: Sequence[_Stop], bottom: Normal, direction: Floats, white: Floats
) -> Floats:
    """
    About the optimum (3n, 3n): of the valley, and of what each of its points leaves open.

    Its points are weighed by exp(-rise / 2T), with T = 1 for a straight valley.
    """
    weights = alignment_weights(bottom.triangle()[0])
    displacements, across = [], []
    null = gauge_basis(bottom.points, bottom.gauge)
    for stop in stops:
        S_bottom_stop = align(
            bottom.points,
            stop.points,
            gauge=bottom.gauge,
            weights=weights,
            scale='tangent',
        ).S_target_source
        moved = (S_bottom_stop.apply(stop.points) - bottom.points).ravel()
        displacements.append(moved - null @ (null.T @ moved))
        across.append(_across(stop.covariance, direction))
    rises = np.array([stop.rise for stop in stops])
    by_ellipsoid = np.sum((white @ np.array(displacements).T) ** 2, axis=0)
    ends = by_ellipsoid[[0, -1]] / np.maximum(rises[[0, -1]], 1.0)
    temperature = float(np.clip(ends.max(), 1.0, WIDEST))
    shares = np.exp(-rises / (2.0 * temperature))
    shares /= shares.sum()
    moved = np.array(displacements)
    moments: Floats = (shares[:, None] * moved).T @ moved
    for share, covariance in zip(shares, across, strict=True):
        moments += share * covariance
    return moments


def _across(covariance: Floats, direction: Floats) -> Floats:
    """Covariance with the displacement along `direction` given."""
    along = covariance @ direction
    across: Floats = covariance - np.outer(along, along) / (direction @ along)
    return across
