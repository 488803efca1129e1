# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Services of the fusion node about its maps."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mapmerge_msgs.srv import MergeNow, RemoveMap
from rclpy.task import Future

from mapmerge_ros.fusion import Fusion, State
from mapmerge_ros.nodes.ledger import Ledger
from mapmerge_ros.nodes.merge_loop import MergeLoop, Product
from mapmerge_ros.nodes.outgoing import Outgoing
from mapmerge_ros.nodes.worker import Result


class Answers:
    """One method per service: request and empty response in, filled response out."""

    def __init__(
        self,
        merges: MergeLoop,
        ledger: Ledger,
        outgoing: Callable[[Fusion | None], Outgoing],
        is_active: Callable[[], bool],
        on_reset: Callable[[], None],
    ) -> None:
        self._merges = merges
        self._ledger = ledger
        self._outgoing = outgoing
        self._is_active = is_active
        self._on_reset = on_reset

    async def merge_now(self, request: Any, response: Any) -> Any:
        """Merge without waiting for the timer; messages are received meanwhile."""
        if not self._is_active():
            response.result = MergeNow.Response.RESULT_NOT_ACTIVE
            response.message = 'the node is not active'
            response.status = self._outgoing(None).status(self._ledger)
            return response
        merged: Any = Future()
        self._merges.request(merged.set_result)
        result: Result[Product] = await merged
        fusion = None if result.product is None else result.product.fusion
        response.result, response.message = _outcome(result.error, fusion)
        response.status = self._outgoing(fusion).status(self._ledger)
        return response

    def remove(self, request: Any, response: Any) -> Any:
        """Remove the sub-maps of one name or one robot; one that has none is forgotten."""
        response.result, response.message = self._why_not(request)
        if response.result == RemoveMap.Response.RESULT_SUCCESS:
            names = self._ledger.matching(request.map_id, request.robot_id)
            response.removed = self._merges.engine.remove(names)
            self._ledger.forget(names)
        return response

    def reset(self, request: Any, response: Any) -> Any:
        """Forget every sub-map; a robot that is to come back has to send again."""
        names = tuple(self._ledger.maps)
        self._merges.reset()
        self._ledger.forget(names)
        self._on_reset()
        response.success, response.message = True, f'{len(names)} sub-maps forgotten'
        return response

    def pause(self, request: Any, response: Any) -> Any:
        """Merge no more by itself, or again; messages are received all the same."""
        self._merges.paused = bool(request.data)
        response.success, response.message = True, 'paused' if request.data else 'going on'
        return response

    def _why_not(self, request: Any) -> tuple[int, str]:
        codes, map_id, robot_id = RemoveMap.Response, request.map_id, request.robot_id
        if not map_id and not robot_id:
            return codes.RESULT_EMPTY_REQUEST, 'map_id and robot_id are both empty'
        # A robot whose maps were all left out has nothing here but its entry.
        if robot_id and robot_id not in self._ledger.robots:
            return codes.RESULT_UNKNOWN_ROBOT, f'no sub-map of robot {robot_id!r}'
        if map_id and not self._ledger.matching(map_id, robot_id):
            return codes.RESULT_UNKNOWN_MAP, f'no sub-map {map_id!r}'
        return codes.RESULT_SUCCESS, ''


def _outcome(error: str, fusion: Fusion | None) -> tuple[int, str]:
    codes = MergeNow.Response
    if fusion is None:
        return codes.RESULT_MERGE_FAILED, error
    if fusion.components:
        return codes.RESULT_SUCCESS, ''
    refused = fusion.in_state(State.REFUSED)
    if refused:
        return codes.RESULT_MERGE_FAILED, f'{refused[0].submap.map_id}: {refused[0].reason}'
    return codes.RESULT_NOTHING_TO_MERGE, 'no sub-map with compressed landmarks'
