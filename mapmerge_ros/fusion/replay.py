# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The engine driven by a recording: the timer of the node, in the time of the recording."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from mapmerge_ros.errors import InvalidValue, MapMergeError
from mapmerge_ros.fusion.accumulate import Receipt
from mapmerge_ros.fusion.engine import FusionEngine
from mapmerge_ros.fusion.outcome import Fusion
from mapmerge_ros.submap import SubMap

OnFusion = Callable[[int, Fusion], None]
"""Called with the time [ns] of a fusion and what it found."""

OnReceipt = Callable[[SubMap, Receipt], None]
"""Called with every sub-map and what the engine said to it."""


class EmptyReplayError(MapMergeError):
    """A recording without a single sub-map that the engine took in."""


class BagTimer:
    """
    Ticks at start + k period, k = 1, 2, …, driven by the times of messages.

    A message at the very time of a tick comes before the tick. Of the ticks inside a gap only
    the first one counts: nothing can have changed at the others.
    """

    def __init__(self, start_ns: int, period_ns: int) -> None:
        if period_ns <= 0:
            raise InvalidValue(f'period_ns: {period_ns} is not positive')
        self._period_ns = period_ns
        self._next_ns = start_ns + period_ns

    def due(self, now_ns: int) -> int | None:
        """Time of the first tick before a message at `now_ns` that is still to come, if any."""
        tick_ns = self._next_ns
        if tick_ns >= now_ns:
            return None
        self._next_ns += -((tick_ns - now_ns) // self._period_ns) * self._period_ns
        return tick_ns


def replay(
    messages: Iterable[tuple[int, SubMap]],
    engine: FusionEngine,
    period_ns: int,
    on_fusion: OnFusion | None = None,
    on_receipt: OnReceipt | None = None,
) -> Fusion:
    """
    Feed (time_ns, sub-map) in time order to an engine, and fuse as the node would.

    At each tick of a timer in message time, and after the last message, the engine fuses if
    anything has changed. The same messages give the same fusions, however fast they come.

    Returns
    -------
    Fusion
        The last one.

    Raises
    ------
    EmptyReplayError
        The engine took in none of the messages; the reasons are in the text.
    InvalidValue
        The period is not positive.

    """
    timer: BagTimer | None = None
    fusion: Fusion | None = None
    reasons: list[str] = []
    time_ns = 0

    def fuse(at_ns: int) -> Fusion:
        found = engine.fuse()
        if on_fusion:
            on_fusion(at_ns, found)
        return found

    for time_ns, submap in messages:
        timer = timer or BagTimer(time_ns, period_ns)
        tick_ns = timer.due(time_ns)
        if tick_ns is not None and engine.changed:
            fusion = fuse(tick_ns)
        receipt = engine.add(submap)
        if not receipt.accepted:
            reasons.append(f'{submap.map_id}: {receipt.reason}')
        if on_receipt:
            on_receipt(submap, receipt)
    if engine.changed:
        fusion = fuse(time_ns)
    if fusion is None:
        raise EmptyReplayError('; '.join(dict.fromkeys(reasons)) or 'no message')
    return fusion
