# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A radio that must not be filled: what waits to be sent, and when it may go."""

from __future__ import annotations

from collections.abc import Callable

Publish = Callable[[str, bytes], None]
"""Sends the bytes of a map."""


class Outbox:
    """
    Sends the newest bytes of each map, and no more than a budget over time.

    After n bytes it is silent for n / budget seconds; one message may be larger than a second's
    budget. A newer revision takes the place of one that still waits.
    """

    def __init__(self, bytes_per_s: float, publish: Publish) -> None:
        """`bytes_per_s` 0 is no limit."""
        self._bytes_per_s = bytes_per_s
        self._publish = publish
        self._waiting: dict[str, bytes] = {}
        self._free_s = 0.0

    @property
    def waiting(self) -> int:
        """Number of maps that wait."""
        return len(self._waiting)

    def put(self, map_id: str, raw: bytes, now_s: float) -> None:
        """Send at once if there is room, else later; times are those of a steady clock."""
        self._waiting.setdefault(map_id, raw)  # it keeps its place in the row
        self._waiting[map_id] = raw
        self.flush(now_s)

    def flush(self, now_s: float) -> None:
        """Send what may go now."""
        while self._waiting and (not self._bytes_per_s or now_s >= self._free_s):
            map_id = next(iter(self._waiting))
            raw = self._waiting.pop(map_id)
            if self._bytes_per_s:
                self._free_s = now_s + len(raw) / self._bytes_per_s
            self._publish(map_id, raw)
