# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
Node of a robot that has a bundle: announces all landmarks, compresses those it is asked for.

It brings the robot's path into agreement with the map of the fleet.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

from mapmerge_msgs.msg import Bundle, LandmarkRequest, SubMap
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from std_srvs.srv import Trigger

from mapmerge_ros.bundle import MapName
from mapmerge_ros.io import (
    InvalidMessage,
    NamedBundle,
    decode_bundle_name,
    decode_request,
    load_bundles,
)
from mapmerge_ros.io.wording import without_parallax
from mapmerge_ros.nodes.compressor_parameters import SETTINGS, declare_settings
from mapmerge_ros.nodes.corrections import Corrections
from mapmerge_ros.nodes.outbox import Outbox
from mapmerge_ros.nodes.own_map import Done, OwnMap, Response
from mapmerge_ros.nodes.own_maps import OwnMaps, is_newer
from mapmerge_ros.nodes.process import run_node
from mapmerge_ros.nodes.quality import BUNDLE_PROFILE, LATCHED_PROFILE, REQUESTS_PROFILE
from mapmerge_ros.nodes.way_back import STEP_RATIO, Corrected
from mapmerge_ros.nodes.worker import Result, Worker
from mapmerge_ros.submap import Request

REQUESTS_TOPIC = '/fusion_node/requests'
GLOBAL_MAP_TOPIC = '/fusion_node/global_map'
"""Where the fusion node is by default; remap both if it has another name."""

OUTBOX_S = 0.1
"""How often to look whether the radio is free again."""

Then = Callable[[], None]
"""What remains to be done in the thread of the node."""


class CompressorNode(Node):  # type: ignore[misc]
    """The maps of one robot; the fusion side decides which landmarks are worth their bytes."""

    def __init__(self, **options: Any) -> None:
        super().__init__('compressor_node', **options)
        self._settings = settings = declare_settings(self)
        # Above every revision of an earlier life of this robot, as long as its clock is right.
        self._maps = OwnMaps(settings.robot_id, int(time.time()))
        # One publisher each: the latest of every map is there for those who come late.
        self._submaps: dict[str, Any] = {}
        self._outbox = Outbox(settings.max_bytes_per_s, self._publish)
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._corrections = Corrections(self)
        self._rounds_left: dict[str, int] = {}
        self._waiting: dict[str, MapName] = {}
        """Of each map, the bundle that was put last into the tasks"""
        self._tasks: dict[str, Callable[[], Then]] = {}
        self._running = ''
        """Name of the task that was started last"""
        wake = self.create_guard_condition(self._on_wake)
        self._worker: Worker[Callable[[], Then], Then] = Worker(lambda task: task(), wake.trigger)
        if settings.bundle:
            for named in load_bundles(
                settings.bundle, settings.robot_id, settings.id_space, settings.gauge
            ):
                self._take(self._maps.prepare(named))
        self._listen()

    def close(self) -> None:
        """End the worker."""
        self._worker.close()

    def _listen(self) -> None:
        subscribe = self.create_subscription
        subscribe(LandmarkRequest, REQUESTS_TOPIC, self._on_request, REQUESTS_PROFILE, raw=True)
        subscribe(SubMap, GLOBAL_MAP_TOPIC, self._on_global_map, LATCHED_PROFILE, raw=True)
        # Whoever latches is heard by both, and what comes twice is not newer.
        for profile in (LATCHED_PROFILE, BUNDLE_PROFILE):
            subscribe(Bundle, 'bundle', self._on_bundle, profile, raw=True)
        self.create_service(Trigger, '~/relinearise', self._on_relinearise)
        if self._settings.max_bytes_per_s:
            self.create_timer(OUTBOX_S, self._on_outbox, clock=self._steady)

    def _send(self, map_id: str) -> None:
        self._outbox.put(map_id, self._maps[map_id].raw, self._now_s)

    def _publish(self, map_id: str, raw: bytes) -> None:
        if map_id not in self._submaps:
            self._submaps[map_id] = self.create_publisher(SubMap, 'submap', LATCHED_PROFILE)
        self._submaps[map_id].publish(raw)

    @property
    def _now_s(self) -> float:
        return float(self._steady.now().nanoseconds) * 1e-9

    def _on_outbox(self) -> None:
        self._outbox.flush(self._now_s)

    def _on_bundle(self, raw: bytes) -> None:
        try:
            name = decode_bundle_name(raw)
        except InvalidMessage as err:
            self.get_logger().warning(f'refused: {err}')
            return
        task, waiting = f'bundle of {name.map_id}', self._waiting.get(name.map_id)
        # Only the newest one counts that waits: a SLAM may be faster than this robot compresses.
        is_overtaken = task in self._tasks and waiting and not is_newer(name, waiting)
        if is_overtaken or not self._maps.wants(name):
            return
        self._waiting[name.map_id] = name
        # Decoding and announcing a large bundle takes seconds.
        self._later(task, lambda: self._new_bundle(raw))

    def _new_bundle(self, raw: bytes) -> Then:
        try:
            named = self._maps.decode(raw)
            prepared = None if named is None else self._maps.prepare(named)
        except InvalidMessage as err:
            reason = str(err)
            return lambda: self.get_logger().warning(f'refused: {reason}')
        return (lambda: self._take(prepared)) if prepared else (lambda: None)

    def _take(self, own: OwnMap) -> None:
        self._warn_of(own)
        map_id, log = self._maps.take(own), self.get_logger()
        self._rounds_left[map_id] = self._settings.relinearise_rounds if own.asked else 0
        self._send(map_id)
        if own.asked:
            self._tell_sent(own)
        else:
            log.info(f'announced {len(own.announced.landmark_ids)} landmarks of {map_id}')

    def _warn_of(self, own: OwnMap) -> None:
        """Say once what is wrong with the bundles of a map, not with each of them."""
        map_id, log = own.announced.map_id, self.get_logger()
        before = self._maps.get(map_id)
        count = own.named.undetermined
        if count and (before is None or before.named.undetermined != count):
            log.warning(f'{map_id}: {without_parallax(count)}')
        if own.bare_reason and (before is None or before.bare_reason != own.bare_reason):
            log.warning(f'{map_id}: cannot compress what was asked for: {own.bare_reason}')

    def _tell_sent(self, own: OwnMap) -> None:
        count, map_id, size = own.compressed_count, own.announced.map_id, len(own.raw)
        self.get_logger().info(f'sent {count} compressed landmarks of {map_id}, {size} bytes')

    def _on_request(self, raw: bytes) -> None:
        try:
            request = decode_request(raw)
        except InvalidMessage as err:
            self.get_logger().warning(f'refused: {err}')
            return
        own = self._maps.get(request.map_id)
        if own is None:
            return  # of another robot
        if request.robot_id != own.announced.robot_id:
            self.get_logger().warning(
                f'ignored a request for {request.map_id} of robot {request.robot_id!r}'
            )
            return
        self._respond(own, self._settings.limited(request))

    def _respond(self, own: OwnMap, request: Request) -> None:
        response, map_id = own.respond(request), request.map_id
        self.get_logger().debug(f'{map_id}, revision {request.revision}: {response.value}')
        if response is Response.COMPRESS:  # a newer one takes the place of an older
            self._later(f'answer of {map_id}', lambda: self._answer(request))
        elif response is Response.REANNOUNCE:
            own.reannounce(request.revision)
            self._send(map_id)
        elif response is Response.REPEAT:
            self._send(map_id)

    def _answer(self, request: Request) -> Then:
        done = self._maps.answer(request)
        return lambda: self._finish(done, self._settings.relinearise_rounds)

    def _on_global_map(self, raw: bytes) -> None:
        self._later(self._correction, lambda: self._correct(raw, False))

    def _on_relinearise(self, request: Any, response: Any) -> Any:
        raw = self._maps.global_map
        response.success = raw is not None
        response.message = 'no global map has arrived yet' if raw is None else 'will be sent'
        if raw is not None:
            self._later(self._correction, lambda: self._correct(raw, True))
        return response

    @property
    def _correction(self) -> str:
        return f'correction of {", ".join(self._maps)}'

    def _correct(self, raw: bytes, is_asked: bool) -> Then:
        try:
            found = self._maps.correct(raw)
        except InvalidMessage as err:
            reason = str(err)
            return lambda: self.get_logger().warning(f'refused: {reason}')
        again = {
            named.name.map_id: self._maps.answer_again(corrected)
            for named, corrected in found
            if is_asked or self._is_worth_a_round(corrected)
        }
        return lambda: self._take_back(found, again)

    def _is_worth_a_round(self, corrected: Corrected) -> bool:
        left = self._rounds_left.get(corrected.map_id, 0)
        return left > 0 and corrected.step_ratio > STEP_RATIO

    def _take_back(
        self, found: Sequence[tuple[NamedBundle, Corrected]], again: dict[str, Done | None]
    ) -> None:
        for named, corrected in found:
            self._corrections.publish(named, corrected)
            self.get_logger().debug(
                f'{corrected.map_id}: {corrected.shared} landmarks moved by up to '
                f'{corrected.step_ratio:.2g} standard deviations'
            )
        for map_id, done in again.items():
            if done is not None:
                self._finish(done, self._rounds_left.get(map_id, 0) - 1)

    def _finish(self, done: Done, rounds_left: int) -> None:
        map_id, found, log = done.job.request.map_id, done.answer, self.get_logger()
        if len(found.unknown):
            log.warning(
                f'{map_id}: asked for {len(found.unknown)} unknown landmarks, '
                f'the first is {found.unknown[0]}'
            )
        if found.dropped:
            log.warning(f'{map_id}: {found.dropped} landmarks dropped to keep the size')
        if found.submap is None:
            log.warning(f'{map_id}: cannot compress what was asked for: {found.reason}')
        elif self._maps[map_id].finish(done):
            self._rounds_left[map_id] = max(rounds_left, 0)
            self._send(map_id)
            self._tell_sent(self._maps[map_id])

    def _later(self, name: str, task: Callable[[], Then]) -> None:
        """Do this apart from the node's thread; it takes the place of one of its name."""
        self._tasks[name] = task
        self._start()

    def _start(self) -> None:
        if self._tasks and not self._worker.busy:
            self._running = next(iter(self._tasks))
            self._worker.start(self._tasks.pop(self._running))

    def _on_wake(self) -> None:
        result: Result[Then] | None = self._worker.take()
        if result is None:
            return
        if result.product is None:
            self.get_logger().error(f'{self._running} failed: {result.error}\n{result.trace}')
        else:
            result.product()
        self._start()


def main(args: Sequence[str] | None = None) -> int:
    """Run the robot until it is stopped."""
    return run_node(CompressorNode, args, SETTINGS)


if __name__ == '__main__':
    raise SystemExit(main())
