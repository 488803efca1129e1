# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
Which sub-maps have to be left out for the rest to be believed: as few as possible.

The paper's 'Using merging for increased robustness': merge without what is suspected, and test
again. One wrong sub-map is found among those that cost most; of several, ever more are left out at
a time, and given back by halves, so that the number of merges grows with the logarithm of theirs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from mapmerge_ros.distributions import chi2_tail
from mapmerge_ros.fusion.misfit import Misfits
from mapmerge_ros.fusion.outgoing import Merged

Group = tuple[int, ...]
Parts = Sequence[tuple[Group, Merged]]
"""What a group falls into, the largest part first."""

TRIED_ALONE = 4
"""
Suspects that are left out one at a time, to compare.

What a wrong map pulls away looks wrong as well: of four strips in a row the culprit was second.
"""

MAX_CHANCE = 1e-6
"""
Probability, among all sub-maps, of what the culprits add to the price, if they were right.

One unchanged merge in a hundred is refused by chance; that is no reason to send somebody away.
"""

MIN_RATIO = 2.0
"""What they add, over what noise as large as that of the others would: real maps differ by 1.8."""


PRICE_OF_A_CHANGE = 30.0
"""
χ² that a landmark counts for that had to be taken out, or parted, for the rest to be believed.

Without an innocent sub-map fewer are left to contradict the culprit; what is wrong with it is then
taken out landmark by landmark.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """A group merged without some of its sub-maps."""

    without: Group
    parts: Parts
    price_ratio: float
    """What they add to the price, over what noise as large as that of the rest would add"""
    p_value: float
    """Of so high an addition"""
    unexplained: float
    """Price of the rest over its expectation [σ²], and what had to be taken out of it"""
    spread: float
    """How far chance takes that: two standard deviations"""
    suspicion: str = ''
    """Why the culprit was suspected from the start, if it was"""

    @property
    def explains_all(self) -> bool:
        """Whether the rest is as good as noise of the size that is claimed."""
        whole = len(self.parts) == 1
        return whole and self.unexplained <= self.spread

    @property
    def costs_too_much(self) -> bool:
        """Whether what they add is more than noise like that of the rest, and chance, would."""
        count = len(self.without) + sum(len(group) for group, _ in self.parts)
        by_chance = self.p_value * count > MAX_CHANCE * len(self.without)
        return self.price_ratio >= MIN_RATIO and not by_chance

    @property
    def main(self) -> Merged:
        """Largest part."""
        return self.parts[0][1]

    @property
    def size(self) -> int:
        """Sub-maps of the largest part."""
        return len(self.parts[0][0])


@dataclass(frozen=True, slots=True, eq=False)
class Search:
    """Looks for the culprits of one group that is not believed."""

    group: Group
    whole: Merged
    """The group, all of it merged"""
    merge_without: Callable[[Group], Parts]
    """Merge what is left of the group; none: it fails"""
    is_certain: Callable[[Group], bool]
    """Whether the geometry of sub-maps is: else a refusal may be about a wrong basin"""
    contradictions: Callable[[Group], int]
    """Landmarks that were parted before sub-maps were merged, since pairs of them contradict"""
    misfits: Misfits = lambda slots: ()
    """Of the whole group, while the search goes on"""

    def culprits(self) -> Trial | None:
        """Fewest sub-maps without which most of the others are believed; None: nobody can tell."""
        order = _strangest_first(self.group, self.whole)
        alone, believed = list[Trial | None](), list[Trial]()
        for k in order[:TRIED_ALONE]:
            trial = self._without((k,))
            alone.append(trial)
            if trial and self._believes(trial):
                believed.append(trial)
                if trial.explains_all:
                    break
        if believed:
            return self._likeliest(believed)
        trial, step = alone[0], 1
        while trial is not None:
            room = (len(self.group) - 1) // 2 - len(trial.without)
            more = _strangest_first(*trial.parts[0])[: min(step, room)]
            if not more:
                return None
            trial, step = self._without((*trial.without, *more)), 2 * step
            if trial and self._believes(trial):
                return self._given_back(trial, trial.without)
        return None

    def _likeliest(self, trials: Sequence[Trial]) -> Trial:
        """
        Most left over; of those the one that fits the others worst, if worse than right ones do.

        What is left unexplained of real maps is more the more are left to contradict each other:
        where errors of the size that is claimed explain it, it decides, within chance. And then
        who costs most.
        """
        size = max(trial.size for trial in trials)
        largest = [trial for trial in trials if trial.size == size]
        best = min(largest, key=lambda trial: trial.unexplained)
        if len(largest) > 1 and not best.explains_all:
            misfits = self.misfits([self.group.index(x.without[0]) for x in largest])
            if np.isfinite(misfits).all() and max(misfits, default=0.0) > 1.0:
                return largest[int(np.argmax(misfits))]
        alike = [each for each in largest if each.unexplained <= best.unexplained + best.spread]
        return max(alike, key=lambda trial: trial.price_ratio)

    def _given_back(self, trial: Trial, some: Group) -> Trial:
        """Give back all of `some` that the rest agrees with."""
        if len(trial.without) == 1:
            return trial
        left = tuple(k for k in trial.without if k not in some)
        fewer = self._without(left) if left else None
        if fewer and self._believes(fewer):
            return fewer
        if len(some) > 1:
            half = len(some) // 2
            for part in (some[:half], some[half:]):
                trial = self._given_back(trial, part)
        return trial

    def _without(self, culprits: Group) -> Trial | None:
        parts = self.merge_without(culprits)
        if not parts:
            return None
        verdict, rest = self.whole.component.verdict, [part.component.verdict for _, part in parts]
        dof = verdict.dof - sum(each.dof for each in rest)
        price = verdict.a_tilde - sum(each.a_tilde for each in rest)
        noise = verdict.sigma**2 * max(1.0, rest[0].variance_factor)
        statistic = max(price, 0.0) / noise
        p_value = float(chi2_tail(statistic, max(dof, 1)))
        left = sum(each.a_tilde / verdict.sigma**2 - each.dof for each in rest)
        left += PRICE_OF_A_CHANGE * sum(
            len(part.component.changes) + self.contradictions(group) for group, part in parts
        )
        spread = 2.0 * float(np.sqrt(2.0 * sum(each.dof for each in rest)))
        names = [self.whole.component.map_ids[self.group.index(k)] for k in culprits]
        suspicion = verdict.reason if names == [verdict.suspect] else ''
        return Trial(culprits, parts, statistic / max(dof, 1), p_value, left, spread, suspicion)

    def _believes(self, trial: Trial) -> bool:
        """Whether most are believed without the culprits, who cost more than chance may."""
        most = 2 * trial.size > len(self.group)
        # who was suspected was so by a test that does not leave it to chance
        wrong = bool(trial.suspicion) or trial.costs_too_much
        accepted = trial.main.component.verdict.accepted
        return most and wrong and accepted and self.is_certain(trial.parts[0][0])


def _strangest_first(group: Group, merged: Merged) -> Group:
    """Sub-maps that the test suspects, then by what they cost."""
    suspect, ratios = merged.component.verdict.suspect, merged.cost_ratios
    if len(ratios) != len(group):
        return group
    is_suspect = np.array([name == suspect for name in merged.component.map_ids])
    return tuple(group[slot] for slot in np.lexsort((-ratios, ~is_suspect)))
