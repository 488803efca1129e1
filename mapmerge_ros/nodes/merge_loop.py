# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""When to merge: at a tick if anything has changed, at a request always, never two at once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from mapmerge_ros.fusion import Fusion, FusionConfig, FusionEngine, Snapshot, Warm, fuse
from mapmerge_ros.io import encode_submap
from mapmerge_ros.nodes.cloud import Cloud, make_cloud
from mapmerge_ros.nodes.worker import Result, Worker


@dataclass(frozen=True, slots=True, eq=False)
class Product:
    """A fusion, and what takes long to make of it: the bytes of its map and of its points."""

    fusion: Fusion
    global_map: bytes | None
    cloud: Cloud


OnMerge = Callable[[Result[Product]], None]
"""Takes what became of a merge."""


class MergeLoop:
    """
    Owns the engine and the worker, and belongs to one thread.

    `wake` is called from the worker's thread; the owner then has to call `finish`.
    """

    def __init__(self, engine: FusionEngine, wake: Callable[[], None], on_merge: OnMerge) -> None:
        self.engine = engine
        self._worker: Worker[Snapshot, Product] = Worker(
            lambda snapshot: produce(snapshot, engine.config, engine.memory), wake
        )
        self._on_merge = on_merge
        self._served: list[OnMerge] = []
        self._requests: list[OnMerge] = []
        self._outdated = False
        self.paused = False
        """Whether ticks pass without a merge"""

    @property
    def awaited(self) -> bool:
        """Whether somebody waits for a merge."""
        return bool(self._served or self._requests)

    @property
    def running_s(self) -> float:
        """Seconds since the merge that is running began; 0 where none is."""
        return self._worker.running_s

    def tick(self) -> None:
        """Start a merge if anything has changed and none is running."""
        if self.engine.changed and not self.paused:
            self._start()

    def request(self, on_merge: OnMerge) -> None:
        """Merge all that is here now, changed or not, as soon as a running merge is done."""
        self._requests.append(on_merge)
        self._start()

    def reset(self) -> None:
        """Forget everything, the merge that is running included."""
        self.engine.reset()
        self._outdated = self._worker.busy

    def finish(self) -> None:
        """Take the result of the worker, and go on with what was asked for meanwhile."""
        result = self._worker.take()
        if result is None:
            return
        if self._outdated:
            self._requests = self._served + self._requests
        else:
            self._deliver(result)
        self._outdated, self._served = False, []
        if self._requests:
            self._start()

    def close(self) -> bool:
        """Wait for a running merge for a moment; whether it has ended."""
        return self._worker.close()

    def _start(self) -> None:
        if not self._worker.busy:
            self._served, self._requests = self._requests, []
            self._worker.start(self.engine.snapshot())

    def _deliver(self, result: Result[Product]) -> None:
        if result.product is not None:
            self.engine.commit(result.product.fusion)
        self._on_merge(result)
        for on_merge in self._served:
            on_merge(result)


def produce(snapshot: Snapshot, config: FusionConfig, warm: Warm) -> Product:
    """Fuse a snapshot and serialise the global map."""
    fusion = fuse(snapshot, config, warm)
    global_map = fusion.global_map
    raw = None if global_map is None else encode_submap(global_map)
    return Product(fusion, raw, make_cloud(fusion))
