# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
Whether one sub-map fits to what all others agree on.

A model that is fitted to all maps widens until it describes the one that is wrong as well. So the
variances are fitted without it, and then its landmarks are tested against those of the others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
import scipy.linalg
import scipy.sparse

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.fusion.contrasts import (
    MANY_CONTRASTS,
    Contrasts,
    between,
    contrasts,
    same_member_pairs,
)
from mapmerge_ros.fusion.covariance_model import TEXTBOOK, fit_model
from mapmerge_ros.fusion.element import coordinates
from mapmerge_ros.fusion.honest import MAX_CONTRASTS, MIN_GAIN
from mapmerge_ros.fusion.likelihood import Weighing, weigh
from mapmerge_ros.fusion.plausible import largest_variances
from mapmerge_ros.fusion.quadratic import Quadratic
from mapmerge_ros.fusion.sample import NOBODY

Misfits: TypeAlias = Callable[[Sequence[int]], Sequence[float]]
"""
How badly each of some sub-maps (slots of a merge) fits the others: `MapTest.excess`.

Empty where they cannot tell. It holds all of the merge, 7 MB for eight drones: nothing that
lasts may reach it.
"""

MOST_OF_ONE = 30.0
"""χ²(3) that one landmark may contribute at most: bad tracks make no wrong map."""

MIN_LANDMARKS = 8
"""Of a sub-map: of fewer, one bad track is too large a part."""

LEAST_PHI = 1.0
"""
Noise of the others in units of what they claim, at the least.

Two maps that happen to agree better (φ 0.1 on Ladybug) are no reason to expect it of a third.
"""

OF_EACH = 30
"""Landmarks that a sample of the tracks keeps of each sub-map that is asked about, if it can."""

MAX_RATIO, RATIO_OF_ONE = 2.2, 3.0
"""
Statistic per degree of freedom up to which a sub-map is believed, of very many landmarks.

And what is added for one: chance of n of them goes with √n. One landmark of EuRoC and Caliterra,
with its bad tracks, contributes 4 ± 7. None of 43 unchanged merges with up to 200 landmarks, those
of Ladybug for checking among them, has a map over it; one of Ladybug with 75 chosen ones has.
"""


@dataclass(frozen=True, slots=True)
class MapTest:
    """How one sub-map fits to the others."""

    k: int
    statistic: float
    """χ²(dof) if the variances are right for it, too"""
    dof: int
    landmarks: int

    @property
    def ratio(self) -> float:
        """Statistic per degree of freedom."""
        return self.statistic / self.dof

    @property
    def excess(self) -> float:
        """The ratio over that up to which the sub-map is believed."""
        return self.ratio / (MAX_RATIO + RATIO_OF_ONE / float(np.sqrt(self.landmarks)))

    @property
    def is_believed(self) -> bool:
        """Whether sub-maps that are right are as far off."""
        return self.excess <= 1.0


def worst_map(merge: Quadratic) -> MapTest | None:
    """
    Test the sub-map that fits worst to the letter, under variances fitted to the others.

    Nothing that moved is in the merge any more. None for fewer than three sub-maps, where nobody
    can tell.

    Raises
    ------
    DegenerateGeometry
        The differences have no definite covariance.

    """
    if len(merge.information) < 3:
        return None
    data = contrasts(merge, MAX_CONTRASTS)
    plain = weigh(data, TEXTBOOK)
    tests = [_tested(merge, data, plain, NOBODY, k) for k in range(len(merge.information))]
    price = plain.price(data)

    def unlike_the_rest(test: MapTest) -> float:
        return test.ratio * max(data.dof - test.dof, 1) / max(price - test.statistic, 1e-9)

    suspect = max((test for test in tests if test), key=unlike_the_rest, default=None)
    return None if suspect is None else _alone(merge, data, suspect.k)


def misfits(merge: Quadratic, maps: Sequence[int]) -> list[MapTest | None]:
    """
    Test some sub-maps, each under variances fitted to the others; None where these are too few.

    Raises
    ------
    DegenerateGeometry
        The differences have no definite covariance.

    """
    some = [_some_of(merge.members.of_map(k)) for k in maps]
    data = contrasts(merge, MAX_CONTRASTS, np.unique(np.concatenate(some)))
    return [_alone(merge, data, k) for k in maps]


def _some_of(part: slice) -> Ints:
    """Rows of `OF_EACH` members of a sub-map at most, spread over all of them (`part`)."""
    return np.linspace(part.start, part.stop - 1, min(OF_EACH, part.stop - part.start), dtype=int)


def without_map(data: Contrasts, part: slice) -> Contrasts:
    """
    Contrasts of the other sub-maps; `part` are the members of one.

    A reflection within each track takes all that this sub-map says to the last of its contrasts.
    """
    share = np.asarray(data.from_members[:, part].sum(axis=1)).ravel()
    _, firsts, owners = np.unique(data.tracks, return_index=True, return_inverse=True)
    lasts = np.append(firsts[1:], len(data.tracks)) - 1
    lengths = np.sqrt(np.bincount(owners, weights=share**2))
    axis = share.astype(np.float64)
    axis[lasts] += np.where(share[lasts] < 0.0, -1.0, 1.0) * lengths
    norms = np.sqrt(np.bincount(owners, weights=axis**2))
    axis = axis / np.where(norms > 0.0, norms, 1.0)[owners]
    every = np.arange(len(axis))
    axes: scipy.sparse.csr_array = scipy.sparse.csr_array((axis, (every, owners)))
    reflection = _diagonal(np.ones(len(axis))) - 2.0 * (axes @ axes.T)
    rows = np.setdiff1d(every, lasts[lengths > 0.0])
    chosen = reflection[rows]
    spread = scipy.sparse.kron(chosen, np.eye(3), format='csr')
    keep = np.ones(data.from_members.shape[1])
    keep[part] = 0.0
    helmert = chosen @ data.from_members @ _diagonal(keep)
    helmert.data[np.abs(helmert.data) < 1e-12] = 0.0
    helmert.eliminate_zeros()
    owned = np.where((keep > 0.0) & np.isin(data.owners, data.tracks[rows]), data.owners, -1)
    return replace(
        data,
        from_members=helmert,
        tracks=data.tracks[rows],
        owners=owned,
        differences=spread @ data.differences,
        noise=between(spread, data.noise),
        smooth=between(chosen, data.smooth),
        frames=_basis(spread @ data.frames),
        pairs=same_member_pairs(helmert),
    )


def _diagonal(values: Floats) -> scipy.sparse.csr_array:
    """Diagonal matrix; SciPy 1.11 makes none that is an array."""
    every = np.arange(len(values))
    return scipy.sparse.csr_array((values, (every, every)))


def _alone(merge: Quadratic, data: Contrasts, k: int) -> MapTest | None:
    """Test of sub-map k under variances that are fitted to the others; theirs must be enough."""
    rest = without_map(data, merge.members.of_map(k))
    if len(rest.tracks) < MANY_CONTRASTS:
        return None
    fitted = fit_model(rest, largest_variances(data), NOBODY)
    variances = fitted.model.variances if fitted.gain >= MIN_GAIN else TEXTBOOK
    variances = np.maximum(variances, [LEAST_PHI, 0.0, 0.0])
    weighing = weigh(data, variances).unlocked(data, fitted.aside)
    return _tested(merge, data, weighing, fitted.aside, k)


def _tested(
    merge: Quadratic, data: Contrasts, weighing: Weighing, off: Ints, k: int
) -> MapTest | None:
    """Price of sub-map k being held by the others, those that are `off` unlocked already."""
    locked = data.owners >= 0
    locked[off] = False
    views = np.bincount(data.owners[locked], minlength=len(merge.points))
    own = np.arange(len(locked))[merge.members.of_map(k)]
    own = own[locked[own] & (views[data.owners[own]] > 1)]
    gauge = int(merge.gauges[k])
    if len(own) < MIN_LANDMARKS:
        return None
    columns = data.columns(own)
    information = weighing.seen(columns) @ columns
    statistic = _statistic(information, columns.T @ weighing.weighted, gauge)
    return MapTest(k, statistic, 3 * len(own) - gauge, len(own))


def _statistic(information: Floats, score: Floats, gauge: int) -> float:
    """Price s'J⁺s, J of rank 3m - gauge, of which no landmark counts more than `MOST_OF_ONE`."""
    values, vectors = scipy.linalg.eigh(information)
    white = vectors.T @ score
    price = float(np.sum(white[gauge:] ** 2 / values[gauge:]))
    count = len(score) // 3
    every, free = np.arange(count), np.zeros(count, bool)
    for _ in range(count // 2):
        blocks = information.reshape(count, 3, count, 3)[every, :, every, :][~free]
        scores = score.reshape(count, 3)[~free]
        squares = np.sum(scores * np.linalg.solve(blocks, scores[..., None])[..., 0], axis=1)
        loudest = int(np.argmax(squares))
        if squares[loudest] <= MOST_OF_ONE:
            break
        price -= float(squares[loudest]) - MOST_OF_ONE
        row = int(np.flatnonzero(~free)[loudest])
        at = coordinates(np.array([row]))
        solved = np.linalg.solve(information[np.ix_(at, at)], information[at])
        score = score - solved.T @ score[at]
        information = information - information[:, at] @ solved
        free[row] = True
    return price


def _basis(columns: Floats) -> Floats:
    """Orthonormal basis of what some columns span."""
    left, sizes, _ = np.linalg.svd(columns, full_matrices=False)  # takes none, too
    basis: Floats = left[:, sizes > 1e-9 * sizes.max(initial=0.0)]
    return basis
