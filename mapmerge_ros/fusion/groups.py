# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Connected sub-maps merged group by group, without those that break a merge or contradict it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from mapmerge_ros.errors import MapMergeError
from mapmerge_ros.fusion.associate import Association
from mapmerge_ros.fusion.component import merge_component
from mapmerge_ros.fusion.config import FusionConfig
from mapmerge_ros.fusion.contradiction import refusals
from mapmerge_ros.fusion.misfit import Misfits
from mapmerge_ros.fusion.outgoing import Merged
from mapmerge_ros.fusion.overlap import Link, components
from mapmerge_ros.fusion.quarantine import Group, Parts, Search
from mapmerge_ros.fusion.refusal import Refusal
from mapmerge_ros.fusion.search import is_certain
from mapmerge_ros.fusion.solution import Anchor
from mapmerge_ros.fusion.stopwatch import Stopwatch
from mapmerge_ros.fusion.warm import Warm
from mapmerge_ros.geometry import Similarity
from mapmerge_ros.submap import SubMap

Attempt: TypeAlias = tuple[Merged, Misfits | None]
"""A merge and, if it is not believed, how badly its sub-maps fit"""

FAILURES = (MapMergeError, np.linalg.LinAlgError, ArithmeticError)
"""
What numbers can do to a merge although each message keeps its contract: R of rank zero, points
that are all one, sizes that overflow.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """All usable sub-maps with their tracks and links, and how to merge them."""

    submaps: tuple[SubMap, ...]
    association: Association
    links: tuple[Link, ...]
    anchor: Anchor | None
    frames: Mapping[str, Similarity]
    """By map_id, S_global_map where that is known"""
    config: FusionConfig
    revision: int
    stopwatch: Stopwatch
    warm: Warm


def merge_groups(problem: Problem) -> tuple[list[tuple[Group, Merged]], list[Refusal]]:
    """Every group of sub-maps that hang together as one map, largest first, and the refused."""
    merged: list[tuple[Group, Merged]] = []
    refused: list[Refusal] = []
    for group in components(len(problem.submaps), problem.links):
        believed, without = _merge_rightly(group, problem)
        merged += believed
        refused += without
    merged.sort(key=lambda part: (-len(part[0]), part[0]))
    return merged, refused


def _merge_rightly(
    group: Group, problem: Problem
) -> tuple[list[tuple[Group, Merged]], list[Refusal]]:
    """Merge a group without what breaks it or is wrong, and forget how each part was merged."""
    merged: list[tuple[Group, Merged]] = []
    parts, refused = _merge_or_isolate(group, problem)
    for part, (whole, misfits) in parts:
        believed, contradicting = _without_wrong_maps(part, whole, misfits, problem)
        merged += believed
        refused += contradicting
    return merged, refused


def _merge_or_isolate(
    group: Group, problem: Problem
) -> tuple[list[tuple[Group, Attempt]], list[Refusal]]:
    """Merge a group; if that fails, without sub-maps that are broken or that break it."""
    try:
        return [(group, _merge(group, problem))], []
    except FAILURES as err:
        failure = _in_words(err)
    if len(group) == 1:
        return [], [Refusal(problem.submaps[group[0]].map_id, failure)]
    broken = tuple(k for k in group if not _works((k,), problem))
    for culprits in [broken] if broken else [(k,) for k in _strangest_first(group, problem)]:
        try:
            parts = [(part, _merge(part, problem)) for part in _without(group, culprits, problem)]
        except FAILURES:
            continue
        names = [problem.submaps[k].map_id for k in culprits]
        return parts, [Refusal(name, f'with it the merge fails: {failure}') for name in names]
    return [], [Refusal(problem.submaps[k].map_id, failure) for k in group]


def _without_wrong_maps(
    group: Group, whole: Merged, misfits: Misfits | None, problem: Problem
) -> tuple[Parts, list[Refusal]]:
    """
    Leave out what is wrong as a whole, where that is certain.

    Two sub-maps that disagree stay refused together, nobody can tell which is wrong. So does a
    merge whose geometry may be in a wrong basin.
    """
    if misfits is None or len(group) < 3 or not problem.config.unlock:
        return [(group, whole)], []

    def merge_without(culprits: Group) -> Parts:
        try:
            # How badly anybody fits is asked of the whole only: nothing of a trial is held for it.
            return [
                (part, _merge(part, problem)[0]) for part in _without(group, culprits, problem)
            ]
        except FAILURES:
            return []

    def certain(part: Group) -> bool:
        return is_certain(_within(part, problem.links), len(part))

    def contradictions(part: Group) -> int:
        return sum(len(link.contradicting) for link in _within(part, problem.links))

    search = Search(group, whole, merge_without, certain, contradictions, misfits)
    trial = search.culprits()
    if trial is None:
        return [(group, whole)], []
    return trial.parts, refusals(trial, problem.submaps, problem.association)


def _strangest_first(group: Group, problem: Problem) -> list[int]:
    """Sub-maps whose R is of another order of magnitude than that of the others come first."""
    sizes = {k: np.log10(np.abs(problem.submaps[k].packed_r).max()) for k in group}
    usual = np.median(list(sizes.values()))
    return sorted(group, key=lambda k: -abs(sizes[k] - usual))


def _works(group: Group, problem: Problem) -> bool:
    try:
        _merge(group, problem)
    except FAILURES:
        return False
    return True


def _merge(group: Group, problem: Problem) -> Attempt:
    members = [problem.submaps[k] for k in group]
    return merge_component(
        members,
        problem.association.restricted(group),
        _within(group, problem.links),
        _still(problem, members),
        problem.config,
        problem.revision,
        problem.stopwatch,
        problem.warm,
    )


def _without(group: Group, culprits: Group, problem: Problem) -> list[Group]:
    """What a group falls into when some sub-maps are taken away."""
    rest = tuple(k for k in group if k not in culprits)
    parts = components(len(rest), _within(rest, problem.links))
    return [tuple(rest[slot] for slot in part) for part in parts]


def _within(group: Sequence[int], links: Sequence[Link]) -> tuple[Link, ...]:
    """Links inside a group, renumbered to the group."""
    slot = {k: position for position, k in enumerate(group)}
    return tuple(
        replace(link, a=slot[link.a], b=slot[link.b])
        for link in links
        if link.a in slot and link.b in slot
    )


def _still(problem: Problem, members: Sequence[SubMap]) -> Anchor | None:
    """
    Return the previous anchor if this group has it and nothing knows the frame better.

    Where the anchor has gone, or into quarantine, the oldest that was there with it holds still.
    """
    smallest, anchor = min(submap.gauge for submap in members), problem.anchor
    frames = dict(problem.frames) | ({anchor.map_id: anchor.S_global_map} if anchor else {})
    known = [x for x in members if x.gauge == smallest and x.map_id in frames]
    if not known:
        return None
    if anchor and anchor.map_id in {submap.map_id for submap in known}:
        return anchor
    oldest = min(known, key=lambda submap: (submap.stamp_ns, submap.map_id))
    return Anchor(oldest.map_id, frames[oldest.map_id])


def _in_words(err: Exception) -> str:
    if isinstance(err, MapMergeError):
        return str(err)
    return f'its numbers cannot be computed with ({str(err).lower() or type(err).__name__})'
