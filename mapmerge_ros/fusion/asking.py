# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Memory of what the robots were asked for: nothing twice in vain, nothing lost for ever."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from mapmerge_ros.arrays import Ids
from mapmerge_ros.fusion.config import FusionConfig
from mapmerge_ros.fusion.requests import Denial
from mapmerge_ros.submap import Request, SubMap

MAX_TRIES = 8
"""
Times the same request is sent, each pause twice as long as the one before.

With the default of 10 s the last one goes out after 21 minutes; where every second message is
lost, one robot in 250 stays unasked. Requests are latched: a robot that comes into reach later
gets the last one all the same.
"""

NOVELTY = 0.2
"""Share of new landmarks that makes a request another one; as `request_coverage` leaves open."""


@dataclass(frozen=True, slots=True, eq=False)
class _Sent:
    request: Request
    tries: int
    last_ns: int


class Asking:
    """What is wished for, what was sent and what was denied. Not thread-safe: one owner."""

    def __init__(self, config: FusionConfig) -> None:
        self._period_ns = int(config.request_period * 1e9)
        self._wishes: dict[str, Request] = {}
        self._sent: dict[str, _Sent] = {}
        self._denied: dict[str, Denial] = {}

    def reconfigure(self, config: FusionConfig) -> None:
        """Wait as long for answers as this says, from now on."""
        self._period_ns = int(config.request_period * 1e9)

    def restore(self, denied: Mapping[str, Denial]) -> None:
        """Remember again what robots could not do."""
        self._denied.update(denied)

    @property
    def denied(self) -> Mapping[str, Denial]:
        """By map_id, how far its robot could not do what it was asked for; a copy."""
        return dict(self._denied)

    @property
    def unanswered(self) -> int:
        """Robots' maps that were asked and have not answered yet."""
        return len(self._sent)

    @property
    def given_up(self) -> int:
        """Of those, how many are not asked again."""
        return sum(sent.tries >= MAX_TRIES for sent in self._sent.values())

    def hear(self, submap: SubMap) -> None:
        """Take note of a new revision: it may be the answer."""
        name = submap.map_id
        self._wishes.pop(name, None)
        if not submap.compressed_count:
            # A robot that begins again may well be able to do what it could not before.
            self._denied.pop(name, None)
            return
        asked = self._denied[name].landmark_ids if name in self._denied else _NO_IDS
        sent = self._sent.get(name)
        if sent is not None and sent.request.revision < submap.revision:
            asked = np.concatenate([asked, sent.request.landmark_ids])
            del self._sent[name]
        missing = np.setdiff1d(asked, submap.compressed_ids) if len(asked) else asked
        self._denied.pop(name, None)
        if len(missing):
            self._denied[name] = Denial(missing, submap.compressed_count)

    def wish(self, requests: Iterable[Request], newest: Mapping[str, int] | None = None) -> None:
        """
        Replace what is wished for by what the last fusion found.

        `newest` says which revisions are there by now: wishes about others are dropped.
        """
        wishes = {request.map_id: request for request in requests}
        # What is no longer wished for needs no answer.
        self._sent = {name: sent for name, sent in self._sent.items() if name in wishes}
        self._wishes = {
            name: request
            for name, request in wishes.items()
            if newest is None or newest.get(name) == request.revision
        }

    def due(self, now_ns: int) -> tuple[Request, ...]:
        """Requests to be sent now; they count as sent."""
        found = []
        for name, request in sorted(self._wishes.items()):
            tries = self._next_try(request, now_ns)
            if tries:
                self._sent[name] = _Sent(request, tries, now_ns)
                found.append(request)
        return tuple(found)

    def forget(self, map_ids: Iterable[str]) -> None:
        """Forget sub-maps that were removed."""
        for name in tuple(map_ids):
            self._wishes.pop(name, None)
            self._sent.pop(name, None)
            self._denied.pop(name, None)

    def _next_try(self, request: Request, now_ns: int) -> int:
        """Which try this request would be now; 0 when its time has not come."""
        sent = self._sent.get(request.map_id)
        if sent is None or _is_other(request, sent.request):
            return 1
        if sent.tries >= MAX_TRIES:
            return 0
        if request.revision != sent.request.revision:
            return sent.tries + 1  # announced again: the robot cannot know the old request
        waited_ns = now_ns - sent.last_ns
        # A clock that was set back (a recording that starts again) says nothing.
        is_due = waited_ns < 0 or waited_ns >= self._period_ns << (sent.tries - 1)
        return sent.tries + 1 if is_due else 0


_NO_IDS: Ids = np.zeros(0, np.uint64)


def _is_other(new: Request, old: Request) -> bool:
    fresh = ~np.isin(new.landmark_ids, old.landmark_ids)
    return bool(fresh.mean() > NOVELTY)
