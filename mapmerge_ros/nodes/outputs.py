# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Everything that the fusion node publishes about its maps."""

from __future__ import annotations

from typing import Any

from mapmerge_msgs.msg import AlignmentArray, ChangeArray, FusionStatus, LandmarkRequest, SubMap
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from mapmerge_ros.io import encode_request
from mapmerge_ros.nodes.frames import FramePublisher
from mapmerge_ros.nodes.ledger import Ledger
from mapmerge_ros.nodes.markers import Drawing
from mapmerge_ros.nodes.merge_loop import Product
from mapmerge_ros.nodes.outgoing import Outgoing
from mapmerge_ros.nodes.quality import LATCHED_PROFILE, REQUESTS_PROFILE
from mapmerge_ros.submap import Request


class Outputs:
    """Publishers of a fusion node; every topic is latched."""

    def __init__(self, node: Any, publish_tf: bool) -> None:
        self._node = node
        self._global_map = self._global_map_publisher()
        self._has_map = False
        """Whether who comes late gets a global map"""
        self._alignments = node.create_publisher(AlignmentArray, '~/alignments', LATCHED_PROFILE)
        self._changes = node.create_publisher(ChangeArray, '~/changes', LATCHED_PROFILE)
        self._points = node.create_publisher(PointCloud2, '~/points', LATCHED_PROFILE)
        self._markers = node.create_publisher(MarkerArray, '~/markers', LATCHED_PROFILE)
        self._status = node.create_publisher(FusionStatus, '~/status', LATCHED_PROFILE)
        self._requests = node.create_publisher(LandmarkRequest, '~/requests', REQUESTS_PROFILE)
        self._frames = FramePublisher(node, publish_tf)

    @property
    def own_topics(self) -> frozenset[str]:
        """Topics of sub-maps that come from here."""
        return frozenset({self._global_map.topic_name})

    def publish(
        self, product: Product, outgoing: Outgoing, ledger: Ledger, max_ellipsoids: int
    ) -> Any:
        """Send all about one fusion; its status, which is sent last."""
        header = outgoing.header
        self._send_map(product.global_map, ledger)
        self._frames.publish(product.fusion, header)
        self._points.publish(product.cloud.message(header))
        self._markers.publish(Drawing(product.fusion, header, max_ellipsoids).message())
        self._alignments.publish(outgoing.alignments())
        self._changes.publish(outgoing.changes())
        status = outgoing.status(ledger)
        self._status.publish(status)
        return status

    def _send_map(self, raw: bytes | None, ledger: Ledger) -> None:
        if raw is not None:
            self._global_map.publish(raw)
            self._has_map = True
            ledger.bytes_out += len(raw)
        elif self._has_map:
            # No message says that there is no map: only a new publisher has nothing for who
            # comes late. All other topics have an empty one.
            self._node.destroy_publisher(self._global_map)
            self._global_map, self._has_map = self._global_map_publisher(), False

    def _global_map_publisher(self) -> Any:
        return self._node.create_publisher(SubMap, '~/global_map', LATCHED_PROFILE)

    def ask(self, request: Request, now_ns: int) -> None:
        """Send a request to a robot."""
        self._requests.publish(encode_request(request, now_ns))

    def destroy(self) -> None:
        """End all publishers."""
        self._frames.destroy()
        for publisher in (
            self._global_map,
            self._alignments,
            self._changes,
            self._points,
            self._markers,
            self._status,
            self._requests,
        ):
            self._node.destroy_publisher(publisher)
