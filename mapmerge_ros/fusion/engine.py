# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
The engine: accumulate → associate → align → merge → verify → compress.

`fuse` is a pure function of a set of sub-maps. `FusionEngine` holds the only state: what has
arrived, and where the global frame is.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from mapmerge_ros.association import Correspondences, associate
from mapmerge_ros.errors import InvalidValue
from mapmerge_ros.fusion.accumulate import Receipt, Store, without_duplicates
from mapmerge_ros.fusion.asking import Asking
from mapmerge_ros.fusion.associate import Association, of_compressed, split_contradictions
from mapmerge_ros.fusion.catalogues import Tracks
from mapmerge_ros.fusion.config import FusionConfig
from mapmerge_ros.fusion.copies import without_copies
from mapmerge_ros.fusion.groups import Problem, merge_groups
from mapmerge_ros.fusion.links import find_links
from mapmerge_ros.fusion.moved_far import with_moved_far
from mapmerge_ros.fusion.noise import noise_notes
from mapmerge_ros.fusion.outcome import Contradiction, Fusion, Match, Pair, Timing
from mapmerge_ros.fusion.overlap import Link
from mapmerge_ros.fusion.requests import Denial, plan_requests
from mapmerge_ros.fusion.solution import Anchor
from mapmerge_ros.fusion.states import aligned, left_out
from mapmerge_ros.fusion.stopwatch import Stopwatch
from mapmerge_ros.fusion.warm import Warm
from mapmerge_ros.geometry import Similarity
from mapmerge_ros.submap import Request, SubMap


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """All that a fusion depends on."""

    submaps: tuple[SubMap, ...]
    anchor: Anchor | None = None
    revision: int = 1
    denied: Mapping[str, Denial] = field(default_factory=dict)
    """By map_id, how far its robot could not do what it was asked for"""
    frames: Mapping[str, Similarity] = field(default_factory=dict)
    """By map_id, S_global_map in the last fusion: who holds the frame if the anchor goes"""


def fuse(
    submaps: Iterable[SubMap] | Snapshot,
    config: FusionConfig | None = None,
    warm: Warm | None = None,
) -> Fusion:
    """
    Merge sub-maps into one map per connected component, and test each.

    `warm` keeps what was found about pairs of sub-maps, and where the merge ended, for the next
    time. With it the result is the same but for what the merge leaves of its last step.

    The result does not depend on the order of the sub-maps, nor on any of their frames and
    scales (the frame of the result is that of the oldest sub-map of the smallest gauge).
    """
    config = config or FusionConfig()
    snapshot = submaps if isinstance(submaps, Snapshot) else Snapshot(tuple(submaps))
    stopwatch, warm = Stopwatch(), Warm() if warm is None else warm
    with stopwatch.measure('associate'):
        known, refusals = without_duplicates(snapshot.submaps)
        found = associate(known, memory=warm, by_descriptors=config.match_descriptors)
        kept, copies = without_copies(known, found)
        found = found.restricted([known.index(submap) for submap in kept])
        usable = tuple(submap for submap in kept if submap.compressed_count)
        association = of_compressed(
            usable, [found.tracks[k] for k, own in enumerate(kept) if own.compressed_count]
        )
        links = find_links(usable, association, config, warm)
        named = _named_contradictions(usable, association, links)
        joined, association = (
            association,
            split_contradictions(
                association, [(link.a, link.b, link.contradicting) for link in links]
            ),
        )
    merged, failures = merge_groups(
        Problem(
            usable,
            association,
            links,
            snapshot.anchor,
            snapshot.frames,
            config,
            snapshot.revision,
            stopwatch,
            warm,
        )
    )
    merged = [
        (group, with_moved_far(group, part, usable, joined, association, links))
        for group, part in merged
    ]
    matches = _matches(kept, found)
    alignments = [
        *aligned(usable, links, merged, matches),
        *left_out(snapshot.submaps, [*refusals, *copies, *failures], matches),
    ]
    notes = noise_notes(usable)
    return Fusion(
        components=tuple(part.component for _, part in merged),
        alignments=tuple(
            replace(item, note=notes.get(item.submap.map_id, ''))
            for item in sorted(alignments, key=lambda item: item.submap.map_id)
        ),
        pairs=tuple(Pair(usable[x.a].map_id, usable[x.b].map_id, x.shared) for x in links),
        contradictions=named,
        matches=matches,
        requests=_requests(kept, found, config, snapshot),
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
        self.memory = Warm()
        self._anchor: Anchor | None = None
        self._frames: Mapping[str, Similarity] = {}
        self._revision = revision
        self.changed = False
        """Whether anything has come or gone since the last snapshot"""

    def add(self, submap: SubMap) -> Receipt:
        """Take in a sub-map; a refusal says why and changes nothing."""
        receipt = self._store.add(submap)
        if receipt.restarted:
            self.asking.forget([submap.map_id])
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
        self._anchor, self._frames = None, {}

    def reconfigure(self, config: FusionConfig) -> None:
        """
        Fuse with other settings from now on.

        Raises
        ------
        InvalidValue
            Another name of the map: others know it by the one it has.

        """
        if config.map_id != self.config.map_id:
            raise InvalidValue(f'map_id: {config.map_id!r} instead of {self.config.map_id!r}')
        self.config = config
        self.asking.reconfigure(config)
        self.changed |= bool(self._store.snapshot())

    def state(self) -> Snapshot:
        """Everything that an engine needs to go on from here; changes nothing."""
        held = self._store.snapshot()
        return Snapshot(held, self._anchor, self._revision, self.asking.denied, self._frames)

    def restore(self, state: Snapshot) -> tuple[Receipt, ...]:
        """
        Take in the sub-maps of a state as if they had just arrived; what came of each.

        An engine that holds nothing, or has merged nothing yet, takes over the global frame too.
        """
        is_empty = not self._store.snapshot()
        receipts = tuple(self.add(submap) for submap in state.submaps)
        taken = {
            submap.map_id
            for submap, receipt in zip(state.submaps, receipts, strict=True)
            if receipt.accepted
        }
        self.asking.restore({name: x for name, x in state.denied.items() if name in taken})
        if state.anchor and (is_empty or self._anchor is None):
            self._anchor, self._frames = state.anchor, dict(state.frames)
        self._revision = max(self._revision, state.revision)
        return receipts

    def snapshot(self) -> Snapshot:
        """Everything the next fusion depends on; it may run in another thread."""
        self.changed = False
        self._revision += 1
        return self.state()

    def commit(self, fusion: Fusion) -> None:
        """Remember where the global frame is, so that it does not jump, and whom to ask."""
        newest = {submap.map_id: submap.revision for submap in self._store.snapshot()}
        self.asking.wish(fusion.requests, newest)
        for item in fusion.alignments:
            if fusion.components and item.submap.map_id == fusion.components[0].anchor:
                self._anchor = Anchor(item.submap.map_id, item.S_global_map)
        merged = [item for item in fusion.alignments if item.component == 0]
        self._frames = {item.submap.map_id: item.S_global_map for item in merged}

    def fuse(self) -> Fusion:
        """Fuse what is there, in this thread."""
        fusion = fuse(self.snapshot(), self.config, self.memory)
        self.commit(fusion)
        return fusion


def _matches(submaps: Sequence[SubMap], found: Correspondences) -> tuple[Match, ...]:
    return tuple(
        Match(submaps[a].map_id, submaps[b].map_id, found.common(a, b), match)
        for (a, b), match in sorted(found.matches.items())
    )


def _requests(
    submaps: Sequence[SubMap], found: Correspondences, config: FusionConfig, snapshot: Snapshot
) -> tuple[Request, ...]:
    if not config.ask:
        return ()
    return plan_requests(submaps, Tracks(found.tracks, found.count), config, snapshot.denied)


def _named_contradictions(
    submaps: Sequence[SubMap], association: Association, links: Sequence[Link]
) -> tuple[Contradiction, ...]:
    return tuple(
        Contradiction(
            int(submaps[link.a].compressed_ids[association.tracks[link.a] == track][0]),
            submaps[link.a].map_id,
            submaps[link.b].map_id,
        )
        for link in links
        for track in link.contradicting
    )
