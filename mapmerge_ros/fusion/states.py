# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What became of each sub-map, and why, in words."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from mapmerge_ros.association import Decision
from mapmerge_ros.fusion.outcome import MapAlignment, Match, State
from mapmerge_ros.fusion.outgoing import Merged
from mapmerge_ros.fusion.overlap import Link
from mapmerge_ros.fusion.refusal import Refusal
from mapmerge_ros.geometry import Similarity
from mapmerge_ros.submap import DescriptorType, SubMap

NO_COMPONENT = -1


def aligned(
    submaps: Sequence[SubMap],
    links: Sequence[Link],
    merged: Sequence[tuple[tuple[int, ...], Merged]],
    matches: Sequence[Match],
) -> list[MapAlignment]:
    """Sub-maps that are in a component: merged in the published one, else detached."""
    published = merged[0][0] if merged else ()
    return [
        MapAlignment(
            submaps[k],
            State.MERGED if index == 0 and len(published) > 1 else State.DETACHED,
            '' if index == 0 and len(published) > 1 else _why_detached(k, submaps, links, matches),
            index,
            part.S_global_maps[slot],
            part.covariances[slot],
        )
        for index, (group, part) in enumerate(merged)
        for slot, k in enumerate(group)
    ]


def _why_detached(
    k: int,
    submaps: Sequence[SubMap],
    links: Sequence[Link],
    matches: Sequence[Match],
) -> str:
    own = [link for link in links if k in (link.a, link.b)]
    joined = [link for link in own if link.S_a_b is not None]
    if joined:
        return f'joined with {len(joined)} sub-maps, but not with the published map'
    if own:
        best = max(own, key=lambda link: link.shared)
        other = submaps[best.b if best.a == k else best.a].map_id
        return f'best overlap is with {other}: {best.reason}'
    if len(submaps) == 1:
        return 'it is the only sub-map so far'
    submap = submaps[k]
    return _why_unmatched(submap, matches) or (
        f'no landmark in common with any other sub-map of id space {submap.id_space!r}'
        if submap.id_space
        else 'its landmark ids are private, and it has no descriptors'
    )


def _promise(match: Match) -> tuple[int, int, int]:
    evidence = match.found.evidence
    return match.links, evidence.inliers, evidence.candidates


def _why_unmatched(submap: SubMap, matches: Sequence[Match]) -> str:
    """What came of the most promising comparison with another sub-map."""
    own = [match for match in matches if submap.map_id in (match.a, match.b)]
    if not own:
        return ''
    best = max(own, key=_promise)
    other = best.b if best.a == submap.map_id else best.a
    if best.found.decision is Decision.JOINED:
        return f'{best.links} landmarks in common with {other}, but too few of them are compressed'
    return f'best match is with {other}, {best.found.decision.value}: {best.found.reason}'


def left_out(
    submaps: Iterable[SubMap], refusals: Iterable[Refusal], matches: Sequence[Match]
) -> list[MapAlignment]:
    """Sub-maps that no component has: refused ones, and bare announcements."""
    by_name = {refusal.map_id: refusal for refusal in refusals}
    left_out = []
    for submap in submaps:
        refusal = by_name.get(submap.map_id)
        if refusal:
            state, reason = State.REFUSED, refusal.reason
        elif not submap.compressed_count:
            why = _why_unmatched(submap, matches)
            state = State.DETACHED
            reason = 'an announcement: none of its landmarks is compressed'
            if not submap.id_space and submap.descriptors.type is DescriptorType.NONE:
                why = 'its landmark ids are private, and it has no descriptors'
            reason += f'; {why}' if why else ''
        else:
            continue
        left_out.append(
            MapAlignment(
                submap,
                state,
                reason,
                NO_COMPONENT,
                Similarity.identity(),
                np.zeros((7, 7)),
                refusal.quarantine if refusal else None,
            )
        )
    return left_out
