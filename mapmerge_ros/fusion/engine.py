# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
The engine: accumulate → associate → align → merge → verify → compress.

`fuse` is a pure function of a set of sub-maps. `FusionEngine` holds the only state: what has
arrived, and where the global frame is.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from mapmerge_ros.fusion.accumulate import Receipt, Store, without_duplicates
from mapmerge_ros.fusion.asking import Asking
from mapmerge_ros.fusion.associate import associate_by_id, split_contradictions
from mapmerge_ros.fusion.component import Anchor, Merged
from mapmerge_ros.fusion.config import FusionConfig
from mapmerge_ros.fusion.groups import Problem, merge_groups
from mapmerge_ros.fusion.outcome import (
    Contradiction,
    Fusion,
    MapAlignment,
    Pair,
    Refusal,
    State,
    Timing,
)
from mapmerge_ros.fusion.overlap import Link, find_links
from mapmerge_ros.fusion.requests import Denial
from mapmerge_ros.fusion.stopwatch import Stopwatch
from mapmerge_ros.fusion.tracks import track_ids
from mapmerge_ros.geometry import Similarity
from mapmerge_ros.submap import Request, SubMap

NO_COMPONENT = -1


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """All that a fusion depends on."""

    submaps: tuple[SubMap, ...]
    anchor: Anchor | None = None
    revision: int = 1
    denied: Mapping[str, Denial] = field(default_factory=dict)
    """By map_id, how far its robot could not do what it was asked for"""


def fuse(submaps: Iterable[SubMap] | Snapshot, config: FusionConfig | None = None) -> Fusion:
    """
    Merge sub-maps into one map per connected component, and test each.

    The result does not depend on the order of the sub-maps, nor on any of their frames and
    scales (the frame of the result is that of the oldest sub-map of the smallest gauge).
    """
    config = config or FusionConfig()
    snapshot = submaps if isinstance(submaps, Snapshot) else Snapshot(tuple(submaps))
    stopwatch = Stopwatch()
    with stopwatch.measure('associate'):
        kept, refusals = without_duplicates(snapshot.submaps)
        usable = tuple(submap for submap in kept if submap.compressed_count)
        association = associate_by_id(usable)
        links = find_links(usable, association, config)
        ids = track_ids(usable, association)
        association = split_contradictions(
            association, [(link.a, link.b, link.contradicting) for link in links]
        )
    merged, failures = merge_groups(
        Problem(
            usable,
            association,
            links,
            snapshot.anchor,
            config,
            snapshot.revision,
            stopwatch,
        )
    )
    alignments = [
        *_aligned(usable, links, merged),
        *_left_out(snapshot.submaps, [*refusals, *failures]),
    ]
    return Fusion(
        components=tuple(part.component for _, part in merged),
        alignments=tuple(sorted(alignments, key=lambda item: item.submap.map_id)),
        pairs=tuple(Pair(usable[x.a].map_id, usable[x.b].map_id, x.shared) for x in links),
        contradictions=tuple(
            Contradiction(int(ids[track]), usable[link.a].map_id, usable[link.b].map_id)
            for link in links
            for track in link.contradicting
        ),
        timing=Timing(
            stopwatch['associate'],
            stopwatch['merge'] + stopwatch['compress'],
            stopwatch['test'],
            stopwatch.total_s,
        ),
    )


class FusionEngine:
    """Takes sub-maps in as they come and fuses what is there. Not thread-safe: one owner."""

    def __init__(self, config: FusionConfig | None = None, revision: int = 0) -> None:
        """`revision` is that of the last map that went out under this name."""
        self.config = config or FusionConfig()
        self._store = Store(self.config.map_id)
        self.asking = Asking(self.config)
        self._anchor: Anchor | None = None
        self._revision = revision
        self.changed = False
        """Whether anything has come or gone since the last snapshot"""

    def add(self, submap: SubMap) -> Receipt:
        """Take in a sub-map; a refusal says why and changes nothing."""
        receipt = self._store.add(submap)
        if receipt.accepted:
            self.changed = True
            self.asking.hear(submap)
        return receipt

    def remove(self, map_ids: Iterable[str]) -> int:
        """Forget sub-maps; return how many were known."""
        names = tuple(map_ids)
        count = self._store.remove(names)
        self.asking.forget(names)
        self.changed |= count > 0
        return count

    def reset(self) -> None:
        """Forget everything but the revision, which must go on rising."""
        self.remove([submap.map_id for submap in self._store.snapshot()])
        self._anchor = None

    def snapshot(self) -> Snapshot:
        """Everything the next fusion depends on; it may run in another thread."""
        self.changed = False
        self._revision += 1
        return Snapshot(self._store.snapshot(), self._anchor, self._revision, self.asking.denied)

    def commit(self, fusion: Fusion) -> None:
        """Remember where the global frame is, so that it does not jump at the next merge."""
        for item in fusion.alignments:
            if fusion.components and item.submap.map_id == fusion.components[0].anchor:
                self._anchor = Anchor(item.submap.map_id, item.S_global_map)

    def wish(self, requests: Iterable[Request]) -> None:
        """Take what a fusion would have the robots asked for, as far as it still holds."""
        newest = {submap.map_id: submap.revision for submap in self._store.snapshot()}
        self.asking.wish(requests, newest)

    def fuse(self) -> Fusion:
        """Fuse what is there, in this thread."""
        fusion = fuse(self.snapshot(), self.config)
        self.commit(fusion)
        return fusion


def _aligned(
    submaps: Sequence[SubMap],
    links: Sequence[Link],
    merged: Sequence[tuple[tuple[int, ...], Merged]],
) -> list[MapAlignment]:
    """Sub-maps that are in a component: merged in the published one, else detached."""
    published = merged[0][0] if merged else ()
    return [
        MapAlignment(
            submaps[k],
            State.MERGED if index == 0 and len(published) > 1 else State.DETACHED,
            '' if index == 0 and len(published) > 1 else _why_detached(k, submaps, links),
            index,
            part.S_global_maps[slot],
            part.covariances[slot],
        )
        for index, (group, part) in enumerate(merged)
        for slot, k in enumerate(group)
    ]


def _why_detached(k: int, submaps: Sequence[SubMap], links: Sequence[Link]) -> str:
    own = [link for link in links if k in (link.a, link.b)]
    joined = [link for link in own if link.S_a_b is not None]
    if joined:
        return f'joined with {len(joined)} sub-maps, but not with the published map'
    if own:
        best = max(own, key=lambda link: link.shared)
        other = submaps[best.b if best.a == k else best.a].map_id
        return f'best overlap is with {other}: {best.reason}'
    if not submaps[k].id_space:
        return 'its landmark ids are private (id_space is empty)'
    if len(submaps) == 1:
        return 'it is the only sub-map so far'
    return f'no landmark in common with any other sub-map of id space {submaps[k].id_space!r}'


def _left_out(submaps: Iterable[SubMap], refusals: Iterable[Refusal]) -> list[MapAlignment]:
    """Sub-maps that no component has: refused ones, and bare announcements."""
    reasons = {refusal.map_id: refusal.reason for refusal in refusals}
    left_out = []
    for submap in submaps:
        if submap.map_id in reasons:
            state, reason = State.REFUSED, reasons[submap.map_id]
        elif not submap.compressed_count:
            state, reason = State.DETACHED, 'an announcement: none of its landmarks is compressed'
        else:
            continue
        left_out.append(
            MapAlignment(
                submap, state, reason, NO_COMPONENT, Similarity.identity(), np.zeros((7, 7))
            )
        )
    return left_out
