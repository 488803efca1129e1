# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Restricted likelihood (REML) of three variances: noise, ground floor, smooth field."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from mapmerge_ros.arrays import Floats, Ints, Mask
from mapmerge_ros.blas import cholesky, inverse_of_factored
from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.fusion.contrasts import Contrasts, Sparse

LEAST = 1e-4
"""Variance, of the typical one of a difference, that is as good as zero."""

USUAL_PHI, LOG_PHI_STD = 0.6, 0.5
"""
φ of maps of real cameras (0.4 to 0.7 on EuRoC and Caliterra), and how much its logarithm varies.

As much as eight degrees of freedom say: nothing beside the hundreds of most merges.
"""

SEEN = 1e-9
"""
Share of what is known of a displacement that frames must leave, or all that is left is rounding.

A map with three members in a sample is explained by its frame, whatever they are.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Weighing:
    """
    Differences weighed with P, their inverse covariance at some variances, blind to frames.

    P = V⁻¹ - R'R is never formed: what is asked of it costs less with few more rows in R than it
    would cost to take their square away.
    """

    inverse: Floats
    """V⁻¹ (3t, 3t)"""
    root: Floats
    """R (u, 3t) of what P does not see: frames, displacements of members"""
    weighted: Floats
    """P w (3t,)"""
    log_likelihood: float
    """Restricted; comparable between variances, not between sets of what is unlocked"""

    def unlocked(self, data: Contrasts, members: Ints) -> Weighing:
        """Blind to displacements of some members as well."""
        return self.blind_to(data.columns(members)) if len(members) else self

    def blind_to(self, columns: Floats | Sparse) -> Weighing:
        """
        Blind to what `columns` (3t, m) can explain as well: P - P C (C'P C)⁻¹ C'P.

        Raises
        ------
        numpy.linalg.LinAlgError
            P sees some of it as little as it is.

        """
        if not columns.shape[1]:
            return self
        seen = self.seen(columns)
        factor = scipy.linalg.cholesky(np.asarray(seen @ columns), lower=True)
        rows = scipy.linalg.solve_triangular(factor, seen, lower=True)
        white = scipy.linalg.solve_triangular(factor, columns.T @ self.weighted, lower=True)
        return Weighing(
            self.inverse,
            np.vstack([self.root, rows]),
            self.weighted - white @ rows,
            self.log_likelihood + 0.5 * float(white @ white) - _log_det(factor),
        )

    def seen(self, columns: Floats | Sparse) -> Floats:
        """C'P (m, 3t) of some columns C (3t, m)."""
        return np.asarray(columns.T @ self.inverse - (columns.T @ self.root.T) @ self.root)

    def blocks(self, data: Contrasts) -> tuple[Floats, Mask]:
        """Blocks (s, 3, 3) of C'P C of each member with itself; whether P sees all of it."""
        unseen, whole = data.by_member(self.root), data.blocks(self.inverse)
        blocks = whole - unseen @ unseen.swapaxes(1, 2)
        sizes = np.einsum('sii->s', whole)
        return blocks, np.linalg.eigvalsh(blocks)[:, 0] > SEEN * sizes

    def price(self, data: Contrasts) -> float:
        """Price w'P w, χ²(dof) if the variances are right."""
        return float(data.differences @ self.weighted)


def weigh(data: Contrasts, variances: Floats) -> Weighing:
    """
    Weigh the differences: P = V⁻¹ - V⁻¹G (G'V⁻¹G)⁻¹ G'V⁻¹.

    Raises
    ------
    DegenerateGeometry
        The covariance is not definite.

    """
    factor = _factored(data, variances)
    log_det = _log_det(factor)
    inverse = inverse_of_factored(factor).T
    weighted = inverse @ data.differences
    log_likelihood = -log_det - 0.5 * float(data.differences @ weighted)
    nothing = np.zeros((0, len(weighted)))
    return Weighing(inverse, nothing, weighted, log_likelihood).blind_to(data.frames)


def log_likelihood(data: Contrasts, variances: Floats, unlocked: Ints) -> float:
    """
    Compute that of `weigh` with some members (m,) unlocked, without the inverse: half the work.

    Raises
    ------
    DegenerateGeometry
        The covariance is not definite.

    """
    factor = _factored(data, variances)
    explained = np.column_stack([data.frames, data.columns(unlocked).toarray()])
    both = np.column_stack([explained, data.differences])
    white = scipy.linalg.solve_triangular(factor, both, lower=True)
    # The last pivot is the length of what the others do not explain of the differences.
    sizes = np.abs(np.linalg.qr(white)[1].diagonal())
    return -_log_det(factor) - float(np.log(sizes[:-1]).sum()) - 0.5 * float(sizes[-1] ** 2)


def _factored(data: Contrasts, variances: Floats) -> Floats:
    """Cholesky factor of V, in its lower triangle."""
    # symmetric: its rows are its columns, and nothing is copied
    factor = np.asfortranarray(data.covariance(variances).T)
    try:
        cholesky(factor)
    except np.linalg.LinAlgError:
        raise DegenerateGeometry(
            'the differences of the sub-maps have no definite covariance'
        ) from None
    return factor


def _log_det(factor: Floats) -> float:
    return float(np.log(np.diag(factor)).sum())


def derivatives(data: Contrasts, weighing: Weighing) -> tuple[Floats, Floats]:
    """Gradient (3,) and average information (3, 3) of the restricted log-likelihood."""
    traces = data.traces(weighing.inverse) - data.traces_of_square(weighing.root)
    parts = data.parts(weighing.weighted)
    gradient = 0.5 * (parts @ weighing.weighted - traces)
    return gradient, 0.5 * weighing.seen(parts.T) @ parts.T


def with_usual_phi(
    variances: Floats, gradient: Floats, information: Floats
) -> tuple[Floats, Floats]:
    """
    Gradient (3,) and information (3, 3) with what is known of φ before: log φ is Gaussian.

    A few differences alone would let their bulk be as narrow as it likes, and all others be wrong.
    """
    phi = max(float(variances[0]), LEAST)
    pull, weight = np.zeros(3), np.zeros((3, 3))
    pull[0] = -np.log(phi / USUAL_PHI) / (LOG_PHI_STD**2 * phi)
    weight[0, 0] = 1.0 / (LOG_PHI_STD * phi) ** 2
    return gradient + pull, information + weight


def step(variances: Floats, gradient: Floats, information: Floats, highest: Floats) -> Floats:
    """
    Next variances within 0 … `highest`: Newton with the average information.

    A variance at a bound that wants to go beyond it is held there. None falls below a tenth of
    what it was, nor rises beyond four times: the information is that of the old place. The others
    go where they are best given those that were held or stopped.
    """
    is_nothing = variances <= LEAST
    lowest = np.where(is_nothing, 0.0, 0.1 * variances)
    limit = np.minimum(4.0 * variances + 0.1, highest)
    free = ~(is_nothing & (gradient <= 0.0)) & ~((variances >= highest) & (gradient >= 0.0))
    wanted = np.where(is_nothing, 0.0, np.minimum(variances, highest))
    while free.any():
        at, held = np.flatnonzero(free), np.flatnonzero(~free)
        inner = information[np.ix_(at, at)]
        inner = inner + 1e-9 * np.diag(np.diag(inner))
        pull = gradient[at] - information[np.ix_(at, held)] @ (wanted - variances)[held]
        wanted[at] = variances[at] + np.linalg.solve(inner, pull)
        stopped = free & ((wanted < lowest) | (wanted > limit))
        if not stopped.any():
            break
        wanted[stopped] = np.clip(wanted, lowest, limit)[stopped]
        free &= ~stopped
    wanted[wanted <= LEAST] = 0.0
    nothing = wanted[:2].sum() <= 0.0
    wanted[0] = max(wanted[0], LEAST if nothing else 0.0)
    return np.asarray(np.minimum(wanted, highest))
