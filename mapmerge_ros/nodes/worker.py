# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""One piece of work at a time, away from the thread that receives messages."""

from __future__ import annotations

import queue
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from threadpoolctl import threadpool_limits

J = TypeVar('J')
T = TypeVar('T')


@dataclass(frozen=True, slots=True, eq=False)
class Result(Generic[T]):
    """What became of one job: a product, or the reason why there is none."""

    product: T | None
    error: str = ''
    """One line; empty when there is a product"""
    trace: str = ''
    """Where it failed, for the log"""


class Worker(Generic[J, T]):
    """
    Runs jobs in a thread of its own; every method belongs to the one thread that owns it.

    `wake` is called from the other thread when a result is ready to be taken. That thread is a
    daemon: a job cannot be interrupted, and must not keep a node from ending.
    """

    def __init__(self, work: Callable[[J], T], wake: Callable[[], None]) -> None:
        self._work = work
        self._wake = wake
        self._results: queue.SimpleQueue[Result[T]] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._started_s = 0.0
        self._closing = threading.Lock()
        self._closed = False

    @property
    def busy(self) -> bool:
        """Whether a job runs, or its result has not been taken yet."""
        return self._thread is not None

    @property
    def running_s(self) -> float:
        """Seconds since the job that is running began; 0 where none is."""
        return time.monotonic() - self._started_s if self.busy else 0.0

    def start(self, job: J) -> None:
        """Begin a job; the former result has to be taken before."""
        if self.busy:
            raise RuntimeError('a job is running')
        self._started_s = time.monotonic()
        self._thread = threading.Thread(target=self._run, args=(job,), name='worker', daemon=True)
        self._thread.start()

    def take(self) -> Result[T] | None:
        """Return the result of a job that has ended, None when there is none."""
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

    def _run(self, job: J) -> None:
        self._results.put(self._result(job))
        with self._closing:
            if not self._closed:
                self._wake()

    def _result(self, job: J) -> Result[T]:
        try:
            # Two BLAS threads on small fronts cost many times what they save.
            with threadpool_limits(1):
                return Result(self._work(job))
        except Exception as err:  # a bug shall be seen, and the last good map stay published
            reason = f'{type(err).__name__}: {" ".join(str(err).split())}'
            return Result(None, reason, traceback.format_exc())
