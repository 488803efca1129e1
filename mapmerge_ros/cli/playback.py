# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A recording on its way to the engine: paced, counted, with a progress bar."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from mapmerge_ros.cli import console
from mapmerge_ros.errors import MapMergeError
from mapmerge_ros.fusion import Fusion, FusionConfig, FusionEngine, Receipt
from mapmerge_ros.fusion.replay import EmptyReplayError, OnFusion, replay
from mapmerge_ros.io import Recording
from mapmerge_ros.io.state import load_state
from mapmerge_ros.io.summary import Refused, Traffic
from mapmerge_ros.submap import SubMap


class PlaybackError(MapMergeError):
    """Nothing in the recordings can be used."""


class Playback:
    """One run of open recordings through a new engine."""

    def __init__(
        self,
        recording: Recording,
        bags: Sequence[Path],
        config: FusionConfig,
        period_ns: int,
        rate: float | None,
        resume: Path | None = None,
    ) -> None:
        self._recording = recording
        self._bags = bags
        self._engine = FusionEngine(config)
        if resume is not None:
            self._engine.restore(load_state(resume).state)
        self._period_ns = period_ns
        self._rate = rate
        self._refused: list[Refused] = []
        self._accepted = 0
        self._bytes_in = 0
        self._size_bytes = 0
        self._last_merge = ExitStack()

    def run(self, on_fusion: OnFusion | None = None) -> Fusion:
        """
        Replay everything; the last fusion.

        Raises
        ------
        PlaybackError
            Nothing was taken in.
        BagError
            A file is damaged further on.

        """
        try:
            with self._last_merge:
                return replay(
                    self._messages(), self._engine, self._period_ns, on_fusion, self._count
                )
        except EmptyReplayError as err:
            names = ', '.join(map(str, self._bags))
            reasons = dict.fromkeys(f'{x.name}: {x.reason}' for x in self._refused)
            why = '; '.join(list(reasons)[:3]) or 'no message'
            more = f'; and {len(reasons) - 3} more' if len(reasons) > 3 else ''
            raise PlaybackError(f'{names}: no usable sub-map: {why}{more}') from err

    @property
    def traffic(self) -> Traffic:
        """What has been replayed so far."""
        return Traffic(self._accepted, self._bytes_in, tuple(self._refused))

    def _messages(self) -> Iterator[tuple[int, SubMap]]:
        started_s, first_ns = time.monotonic(), None
        for item in console.progress(self._recording, 'replaying', self._recording.total):
            first_ns = item.log_time_ns if first_ns is None else first_ns
            if self._rate:
                due_s = started_s + (item.log_time_ns - first_ns) / 1e9 / self._rate
                time.sleep(max(due_s - time.monotonic(), 0.0))
            if item.submap is None:
                self._refused.append(Refused(item.topic, item.refusal))
                continue
            self._size_bytes = item.size_bytes
            yield item.log_time_ns, item.submap
        # Thousands of landmarks take a minute, and the bar above is gone.
        self._last_merge.enter_context(console.working('merging'))

    def _count(self, submap: SubMap, receipt: Receipt) -> None:
        if receipt.accepted:
            self._accepted += 1
            self._bytes_in += self._size_bytes
        else:
            is_own = submap.map_id == self._engine.config.map_id
            remedy = ': give the new one another --map-id' if is_own else ''
            self._refused.append(Refused(submap.map_id, receipt.reason + remedy))


@contextmanager
def play(
    bags: Sequence[Path],
    config: FusionConfig,
    period_ns: int,
    rate: float | None = None,
    resume: Path | None = None,
) -> Iterator[Playback]:
    """
    Open recordings for one run; `rate` None does not wait.

    `resume` is a saved state to go on from.

    Raises
    ------
    BagError
        A path is no recording of sub-maps.

    """
    with Recording(bags) as recording:
        yield Playback(recording, bags, config, period_ns, rate, resume)
