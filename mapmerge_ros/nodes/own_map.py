# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""One map of a robot towards the fusion side: announced, and compressed as it is asked for."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from mapmerge_ros.bundle import Answer, Bundle, announce, answer, reannounce
from mapmerge_ros.io import MAX_MESSAGE_BYTES, NamedBundle, encode_submap
from mapmerge_ros.submap import Request, SubMap

MAX_REVISION = 2**32 - 1
"""Of the field on the wire."""

STEP = 1000
"""
How far above the last request that is known of an earlier life a robot announces itself again.

Every request may have been answered with one more revision; as many are kept for latecomers.
"""


class Response(Enum):
    """What a request calls for."""

    COMPRESS = 'compress'
    REPEAT = 'repeat'
    """The newest revision is the answer already"""
    REANNOUNCE = 'reannounce'
    """An earlier life of this robot got further: the fusion side takes nothing older"""
    OUTDATED = 'outdated'
    """It is about a catalogue of an earlier life, whose ids may mean other points"""


@dataclass(frozen=True, slots=True, eq=False)
class Job:
    """A request, with all that answering it needs."""

    bundle: Bundle
    announced: SubMap
    request: Request
    revision: int


@dataclass(frozen=True, slots=True, eq=False)
class Done:
    """The answer to a job, and its bytes."""

    job: Job
    answer: Answer
    raw: bytes


class OwnMap:
    """What one map has told and promised. Not thread-safe: one owner."""

    def __init__(self, named: NamedBundle, revision: int) -> None:
        """`revision` is the first one; it has to be above that of every earlier life."""
        self.named = named
        """As the robot made it"""
        self._bundle = named.bundle
        self._announced = announce(named.bundle, replace(named.name, revision=revision))
        self._newest = self._first_of_bundle = revision
        self._first = revision
        """Since when ids mean the same points"""
        self._answered: Request | None = None
        self._wish: Request | None = None
        """The last request that was answered from this bundle, or from an earlier one"""
        self.compressed_count = 0
        """Landmarks of the newest revision that R is about"""
        self.bare_reason = ''
        """Why it cannot be compressed to what was asked of an earlier bundle; empty: it can"""
        self.raw = encode_submap(self._announced)
        """The newest revision, as it was sent"""

    def carry_on(self, earlier: OwnMap) -> None:
        """
        Take over what was asked of an earlier bundle of this map, and answer it; takes long.

        A bare announcement would put the robot out of the global map until it is asked again,
        and a SLAM that sends a bundle every second would never come back in.
        """
        self._first, self._wish = earlier._first, earlier._wish
        if self._wish is None:
            return
        done = work(self.job(self._wish))
        self.bare_reason = done.answer.reason
        self.finish(done)

    @property
    def bundle(self) -> Bundle:
        """At its present working point."""
        return self._bundle

    @property
    def newest(self) -> int:
        """Newest revision."""
        return self._newest

    @property
    def asked(self) -> Request | None:
        """What the newest revision is the answer to; None while it is an announcement."""
        return self._answered

    @property
    def announced(self) -> SubMap:
        """The catalogue, none of it compressed."""
        return self._announced

    def respond(self, request: Request) -> Response:
        """Say what a request for this map calls for."""
        if request.revision < self._first:
            return Response.OUTDATED
        if request.revision > self._newest:
            return Response.REANNOUNCE
        old = self._answered
        is_same = old is not None and (
            old.max_bytes == request.max_bytes
            and np.array_equal(old.landmark_ids, request.landmark_ids)
        )
        return Response.REPEAT if is_same else Response.COMPRESS

    def reannounce(self, asked: int) -> None:
        """Announce above what an earlier life can have sent, which was asked at this revision."""
        self.start_at(asked + STEP)

    def start_at(self, revision: int) -> None:
        """Announce as this revision, and forget what was asked before."""
        self._first = self._first_of_bundle = self._newest = min(revision, MAX_REVISION)
        self._announced = reannounce(self._announced, self._newest)
        self._answered = self._wish = None
        self.compressed_count = 0
        self.raw = encode_submap(self._announced)

    def sent(self, revision: int) -> bool:
        """Whether a revision is of this bundle."""
        return self._first_of_bundle <= revision <= self._newest

    def job(self, request: Request, bundle: Bundle | None = None) -> Job:
        """
        Everything that is needed to answer, whatever happens to this map meanwhile.

        `bundle` is the working point to answer from, by default the present one.
        """
        return Job(bundle or self._bundle, self._announced, request, self._newest + 1)

    def finish(self, done: Done) -> bool:
        """Take the outcome of a job; whether there is a new revision to send."""
        if done.answer.submap is None or done.job.revision != self._newest + 1:
            return False
        self._newest, self.raw = done.job.revision, done.raw
        self._answered = self._wish = done.job.request
        self.compressed_count = done.answer.submap.compressed_count
        self._bundle = done.job.bundle
        return True


def work(job: Job) -> Done:
    """Compress; may take seconds."""
    limit = min(job.request.max_bytes or MAX_MESSAGE_BYTES, MAX_MESSAGE_BYTES)
    request = replace(job.request, max_bytes=limit)
    found = answer(job.bundle, job.announced, request, job.revision)
    return Done(job, found, b'' if found.submap is None else encode_submap(found.submap))
