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
    """It is about a catalogue of an earlier life"""


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
        self._first = self._newest = revision
        self._answered: Request | None = None
        self.raw = encode_submap(self._announced)
        """The newest revision, as it was sent"""

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
        self._first = self._newest = min(revision, MAX_REVISION)
        self._announced = reannounce(self._announced, self._newest)
        self._answered = None
        self.raw = encode_submap(self._announced)

    def sent(self, revision: int) -> bool:
        """Whether a revision is of this bundle."""
        return self._first <= revision <= self._newest

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
        self._newest, self._answered, self.raw = done.job.revision, done.job.request, done.raw
        self._bundle = done.job.bundle
        return True


def work(job: Job) -> Done:
    """Compress; may take seconds."""
    limit = min(job.request.max_bytes or MAX_MESSAGE_BYTES, MAX_MESSAGE_BYTES)
    request = replace(job.request, max_bytes=limit)
    found = answer(job.bundle, job.announced, request, job.revision)
    return Done(job, found, b'' if found.submap is None else encode_submap(found.submap))
