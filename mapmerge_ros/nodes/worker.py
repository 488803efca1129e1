# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""One merge at a time, away from the thread that receives messages."""

from __future__ import annotations

import queue
import threading
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from threadpoolctl import threadpool_limits

from mapmerge_ros.fusion import Snapshot

T = TypeVar('T')


@dataclass(frozen=True, slots=True, eq=False)
class MergeResult(Generic[T]):
    """What became of one merge: a product, or the reason why there is none."""

    product: T | None
    error: str = ''
    """One line; empty when there is a product"""
    trace: str = ''
    """Where it failed, for the log"""


class MergeWorker(Generic[T]):
    """
    Runs a merge in a thread of its own; every method belongs to the one thread that owns it.

    `wake` is called from the other thread when a result is ready to be taken. That thread is a
    daemon: a merge cannot be interrupted, and must not keep a node from ending.
    """

    def __init__(self, merge: Callable[[Snapshot], T], wake: Callable[[], None]) -> None:
        self._merge = merge
        self._wake = wake
        self._results: queue.SimpleQueue[MergeResult[T]] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._closing = threading.Lock()
        self._closed = False

    @property
    def busy(self) -> bool:
        """Whether a merge runs, or its result has not been taken yet."""
        return self._thread is not None

    def start(self, snapshot: Snapshot) -> None:
        """Begin to merge a snapshot; the former result has to be taken before."""
        if self.busy:
            raise RuntimeError('a merge is running')
        self._thread = threading.Thread(
            target=self._run, args=(snapshot,), name='merge', daemon=True
        )
        self._thread.start()

    def take(self) -> MergeResult[T] | None:
        """Return the result of a merge that has ended, None when there is none."""
        try:
            result = self._results.get_nowait()
        except queue.Empty:
            return None
        self._thread = None
        return result

    def close(self, timeout_s: float = 1.0) -> bool:
        """Let the thread wake nobody any more, and wait for it; whether it has ended."""
        with self._closing:
            self._closed = True
        if self._thread is None:
            return True
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self, snapshot: Snapshot) -> None:
        self._results.put(self._result(snapshot))
        with self._closing:
            if not self._closed:
                self._wake()

    def _result(self, snapshot: Snapshot) -> MergeResult[T]:
        try:
            # Two BLAS threads on small fronts cost many times what they save.
            with threadpool_limits(1):
                return MergeResult(self._merge(snapshot))
        except Exception as err:  # a bug shall be seen, and the last good map stay published
            reason = f'{type(err).__name__}: {" ".join(str(err).split())}'
            return MergeResult(None, reason, traceback.format_exc())
