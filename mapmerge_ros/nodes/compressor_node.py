# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Node of a robot that has a bundle: announces all landmarks, compresses those it is asked for."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

from mapmerge_msgs.msg import LandmarkRequest, SubMap
from rclpy.node import Node

from mapmerge_ros.errors import InvalidValue
from mapmerge_ros.geometry import Gauge
from mapmerge_ros.io import InvalidMessage, decode_request, load_bundles
from mapmerge_ros.nodes.own_map import Done, Job, OwnMap, Response, work
from mapmerge_ros.nodes.process import run_node
from mapmerge_ros.nodes.quality import LATCHED_PROFILE, REQUESTS_PROFILE
from mapmerge_ros.nodes.settings import Setting, declare
from mapmerge_ros.nodes.worker import Worker
from mapmerge_ros.submap import Request

SETTINGS = (
    Setting('bundle', '', 'Folder of a COLMAP model, or a recording of Bundle messages.'),
    Setting(
        'robot_id',
        '',
        'Name of the robot, by default that of the folder; in a recording: '
        'which robot to be, may be empty if there is only one.',
    ),
    Setting('id_space', '', 'For a model: its point3D ids mean the same in all of this name.'),
    Setting(
        'gauge',
        '7',
        'For a model: 7 monocular, 6 metric, 4 metric with z up.',
        choices=('7', '6', '4'),
    ),
)

REQUESTS_TOPIC = '/fusion_node/requests'
"""Where the fusion node asks by default; remap it if that has another name."""


class CompressorNode(Node):  # type: ignore[misc]
    """The maps of one robot; the fusion side decides which landmarks are worth their bytes."""

    def __init__(self, **options: Any) -> None:
        super().__init__('compressor_node', **options)
        path, robot_id, id_space, gauge = (declare(self, setting) for setting in SETTINGS)
        if not path:
            raise InvalidValue('bundle: empty; set it with -p bundle:=PATH')
        bundles = load_bundles(path, robot_id, id_space, Gauge(int(gauge)))
        # Above every revision of an earlier life of this robot, as long as its clock is right.
        start = int(time.time())
        self._maps = {
            named.name.map_id: OwnMap(named, max(start, named.name.revision)) for named in bundles
        }
        # One publisher each: the latest of every map is there for those who come late.
        self._submaps = {
            map_id: self.create_publisher(SubMap, 'submap', LATCHED_PROFILE)
            for map_id in self._maps
        }
        self._pending: dict[str, Request] = {}
        wake = self.create_guard_condition(self._on_wake)
        self._worker: Worker[Job, Done] = Worker(work, wake.trigger)
        self.create_subscription(
            LandmarkRequest, REQUESTS_TOPIC, self._on_request, REQUESTS_PROFILE, raw=True
        )
        for map_id, own in self._maps.items():
            self._send(map_id)
            count = len(own.announced.landmark_ids)
            self.get_logger().info(f'announced {count} landmarks of {map_id}')

    def close(self) -> None:
        """End the worker."""
        self._worker.close()

    def _send(self, map_id: str) -> None:
        self._submaps[map_id].publish(self._maps[map_id].raw)

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
        self._respond(own, request)

    def _respond(self, own: OwnMap, request: Request) -> None:
        response, map_id = own.respond(request), request.map_id
        self.get_logger().debug(f'{map_id}, revision {request.revision}: {response.value}')
        if response is Response.COMPRESS:
            self._pending[map_id] = request  # a newer one takes the place of an older
            self._start()
        elif response is Response.REANNOUNCE:
            own.reannounce(request.revision)
            self._send(map_id)
        elif response is Response.REPEAT:
            self._send(map_id)

    def _start(self) -> None:
        if self._pending and not self._worker.busy:
            map_id = min(self._pending)
            self._worker.start(self._maps[map_id].job(self._pending.pop(map_id)))

    def _on_wake(self) -> None:
        result = self._worker.take()
        if result is None:
            return
        if result.product is None:
            self.get_logger().error(f'compressing failed: {result.error}\n{result.trace}')
        else:
            self._finish(result.product)
        self._start()

    def _finish(self, done: Done) -> None:
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
            self._send(map_id)
            count = found.submap.compressed_count
            log.info(f'sent {count} compressed landmarks of {map_id}, {len(done.raw)} bytes')


def main(args: Sequence[str] | None = None) -> int:
    """Run the robot until it is stopped."""
    return run_node(CompressorNode, args)


if __name__ == '__main__':
    raise SystemExit(main())
