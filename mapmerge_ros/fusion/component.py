# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""One connected component: align → merge → verify → compress."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from mapmerge_ros.arrays import Floats
from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.fusion.associate import Association
from mapmerge_ros.fusion.changes import Change, Off, describe
from mapmerge_ros.fusion.config import FusionConfig
from mapmerge_ros.fusion.covariance_model import CovarianceModel
from mapmerge_ros.fusion.examination import Examination
from mapmerge_ros.fusion.joint.covariance import Uncertainty
from mapmerge_ros.fusion.joint.near_optimum import near_optimum
from mapmerge_ros.fusion.misfit import Misfits, misfits
from mapmerge_ros.fusion.names import Names
from mapmerge_ros.fusion.noise import Noise, pool_noise
from mapmerge_ros.fusion.outcome import Verdict
from mapmerge_ros.fusion.outgoing import Merged, compress_component
from mapmerge_ros.fusion.overlap import Link, components
from mapmerge_ros.fusion.quadratic import Quadratic
from mapmerge_ros.fusion.solution import Anchor, Solution, solve
from mapmerge_ros.fusion.stopwatch import Stopwatch
from mapmerge_ros.fusion.unlock import Examined, find_doubtful, find_off, too_much, unlocked
from mapmerge_ros.fusion.verify import Verified, unless_one_is_wrong, verify_merge
from mapmerge_ros.fusion.warm import Warm
from mapmerge_ros.geometry import Gauge, Similarity
from mapmerge_ros.submap import SubMap

MAX_ROUNDS = 3
"""Merges with ever more taken out; what is still found then is refused."""


def merge_component(
    submaps: Sequence[SubMap],
    association: Association,
    links: Sequence[Link],
    anchor: Anchor | None,
    config: FusionConfig,
    revision: int,
    stopwatch: Stopwatch,
    warm: Warm,
) -> tuple[Merged, Misfits | None]:
    """
    Merge sub-maps that hang together (indices of `links` refer to them).

    What an examination finds to have moved, and landmarks that do not fit, are taken out, and
    the rest is merged as if they had not been matched. Of a merge that is not believed, how
    badly its sub-maps fit can be asked.

    Raises
    ------
    DegenerateGeometry
        A landmark or a frame is not determined.

    """
    task = _Task(
        submaps,
        links,
        pool_noise(submaps),
        anchor or choose_anchor(submaps, min(submap.gauge for submap in submaps)),
        config,
        stopwatch,
        warm,
    )
    state = first = task.attempt(association, ())
    for _ in range(MAX_ROUNDS - 1 if config.unlock else 0):
        following = task.without_what_is_off(state)
        if following is None:
            break
        state = following
    with stopwatch.measure('test'):
        state = task.judged(state)
    with stopwatch.measure('compress'):
        merged = compress_component(
            submaps,
            state.association,
            state.solution,
            task.noise,
            state.told(),
            task.anchor,
            config,
            revision,
            state.uncertainty,
        )
    if merged.factor is not None:
        warm.learn_merge(state.solution.resumable(merged.factor))
    component = replace(
        merged.component,
        starts=first.solution.estimate.starts,
        examination=first.examination,
        changes=state.changes(submaps, merged.component.names),
    )
    merged = replace(merged, component=component, factor=None)
    if state.verdict.accepted:
        return merged, None
    merged = replace(merged, cost_ratios=_cost_ratios(state.solution))
    return merged, partial(task.misfits, state.solution)


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    """A merge with its verdict, and what was taken out before."""

    association: Association
    solution: Solution
    verified: Verified
    taken_out: tuple[Off, ...]
    uncertainty: Uncertainty | None
    """Of the solution, where the examination has come across it"""

    @property
    def verdict(self) -> Verdict:
        """Verdict on what is merged."""
        return self.verified.verdict

    @property
    def examination(self) -> Examination | None:
        """Tests of what is merged."""
        return self.verified.examination

    def told(self) -> Verdict:
        """Verdict on what is merged, with the number of landmarks that are not."""
        if not self.taken_out:
            return self.verdict
        singles = _singles(self.taken_out)
        moved = sum(map(len, self.taken_out)) - singles
        return replace(
            self.verdict,
            moved=self.verdict.moved + moved,
            set_aside=self.verdict.set_aside + singles,
        )

    def examined(self) -> Examined | None:
        """Return the examination with what relates it to the sub-maps."""
        if self.examination is None:
            return None
        return Examined(self.examination, self.association, self.solution.rows)

    def changes(self, submaps: Sequence[SubMap], names: Names) -> tuple[Change, ...]:
        """Return what was taken out, where it is now, and what is doubtful of the rest."""
        points = self.solution.state.points
        found = [
            change
            for off in self.taken_out
            for change in describe(off, submaps, points[off.own_tracks], names, merged=False)
        ]
        examined = self.examined()
        doubtful = find_doubtful(examined) if examined and self.verdict.accepted else None
        if doubtful is not None:
            S_map_globals = self.solution.state.S_map_globals
            positions = [
                S_map_globals[k].inverse().apply(submaps[k].compressed_points[row])
                for k, row in zip(doubtful.maps.tolist(), doubtful.rows.tolist(), strict=True)
            ]
            found += describe(doubtful, submaps, np.array(positions), names, merged=True)
        return tuple(found)


@dataclass(frozen=True, slots=True, eq=False)
class _Task:
    """What stays the same however often a component is merged."""

    submaps: Sequence[SubMap]
    links: Sequence[Link]
    noise: Noise
    anchor: Anchor
    config: FusionConfig
    stopwatch: Stopwatch
    warm: Warm

    def attempt(
        self,
        association: Association,
        taken_out: tuple[Off, ...],
        known: CovarianceModel | None = None,
    ) -> _State:
        # A basin that was believed before is not looked for again.
        config = replace(self.config, max_starts=1) if taken_out else self.config
        with self.stopwatch.measure('merge'):
            solution = solve(
                self.submaps, association, self.links, self.noise, self.anchor, config, self.warm
            )
        learnt: list[Uncertainty] = []
        # What private landmarks are known to is not part of the inverse of the shared ones.
        learn = learnt.append if solution.reduced is solution.cost else None
        with self.stopwatch.measure('test'):
            verified = verify_merge(
                self.map_ids,
                solution.reduced,
                solution.estimate,
                self.links,
                self.gauge,
                solution.dof,
                self.noise,
                self.config,
                known,
                _singles(taken_out),
                learn,
            )
        uncertainty = learnt[-1] if learnt else None
        return _State(association, solution, verified, taken_out, uncertainty)

    def judged(self, state: _State) -> _State:
        """Ask at last whether one sub-map is wrong as a whole."""
        verdict = unless_one_is_wrong(
            state.verified, self.map_ids, partial(self._near_optimum, state.solution)
        )
        return replace(state, verified=replace(state.verified, verdict=verdict))

    def misfits(self, solution: Solution, slots: Sequence[int]) -> list[float]:
        """How badly each of some sub-maps fits the others; empty where these cannot tell."""
        try:
            with self.stopwatch.measure('test'):
                tests = misfits(self._near_optimum(solution), slots)
        except (DegenerateGeometry, np.linalg.LinAlgError):
            return []
        found = [test.excess for test in tests if test]
        return found if len(found) == len(slots) else []

    def without_what_is_off(self, state: _State) -> _State | None:
        """Merge again without it; None if nothing is, or too much for the rest to be believed."""
        examined, solution = state.examined(), state.solution
        if examined is None or state.verdict.suspect:
            return None
        before = max((int(off.objects.max()) for off in state.taken_out), default=0)
        off = find_off(examined, self.submaps, before)
        if off is None:
            return None
        if len(worst := too_much((*state.taken_out, off), solution.rows)):
            return self._refused(state, self.map_ids[int(worst[0])])
        association = unlocked(state.association, off)
        if not self._connected(association):
            return None
        try:
            return self.attempt(association, (*state.taken_out, off), examined.found.model)
        except DegenerateGeometry:
            return None

    def _refused(self, state: _State, suspect: str) -> _State:
        """Believe nothing of what is merged: too much of one sub-map is off."""
        reason = f'more of {suspect} is off than can be left out'
        if len(self.submaps) == 2:  # as much is off of the other
            reason = state.verdict.reason or reason
        verdict = replace(state.verdict, accepted=False, reason=reason, suspect=suspect)
        return replace(state, verified=replace(state.verified, verdict=verdict))

    @property
    def map_ids(self) -> list[str]:
        """In the order of the sub-maps."""
        return [submap.map_id for submap in self.submaps]

    @property
    def gauge(self) -> Gauge:
        """Of the result."""
        return min(submap.gauge for submap in self.submaps)

    def _near_optimum(self, solution: Solution) -> Quadratic:
        cost = solution.reduced
        state = cost.evaluate(solution.estimate.points)
        return near_optimum(cost, state, self.gauge, self.noise.sigma)

    def _connected(self, association: Association) -> bool:
        shared = association.shared_counts().todok()
        left = [link for link in self.links if shared[link.a, link.b] >= self.config.min_shared]
        return len(components(len(self.submaps), left)) == 1


def _singles(taken_out: Sequence[Off]) -> int:
    """How many landmarks do not fit, each by itself."""
    return sum(off.singles for off in taken_out)


def _cost_ratios(solution: Solution) -> Floats:
    """Cost (maps,) of each sub-map by coordinate, px²: who is pulled away from where it is."""
    ratios = np.zeros(len(solution.reduced))
    for k in range(len(ratios)):
        element = solution.reduced.element(k)
        residuals = element.residuals(element.place(solution.estimate.points))
        ratios[k] = residuals @ residuals / max(len(residuals), 1)
    return ratios


def choose_anchor(submaps: Sequence[SubMap], gauge: Gauge) -> Anchor:
    """Return the oldest sub-map among those whose frame means most."""
    eligible = (submap for submap in submaps if submap.gauge == gauge)
    oldest = min(eligible, key=lambda submap: (submap.stamp_ns, submap.map_id))
    return Anchor(oldest.map_id, Similarity.identity())
