# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What a fusion found, drawn for RViz and Foxglove: frames, links between them, uncertainty."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from geometry_msgs.msg import Pose, Vector3
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from mapmerge_ros.arrays import Floats
from mapmerge_ros.fusion import Fusion, MapAlignment, State
from mapmerge_ros.geometry import scene_radius
from mapmerge_ros.geometry.rotations import as_rotation
from mapmerge_ros.io.palette import SHARED, Rgb
from mapmerge_ros.nodes.cloud import robot_colours
from mapmerge_ros.nodes.frames import point, quaternion, vector
from mapmerge_ros.nodes.outgoing import covariance_of_parts

TEXT_RATIO, FRAME_RATIO, LINK_RATIO = 0.03, 0.015, 0.004
"""Sizes, of the extent of the map: a monocular map may be a thousand units wide, or one."""

STANDARD_DEVIATIONS = 2.0
"""Half axis of an ellipsoid: about three quarters of the truth lie inside in space."""

CERTAIN, DOUBTFUL = (220, 30, 30), (240, 180, 60)
LEAST_LOG_P = -12.0
"""Colour of a change, by its p-value: from 1 to a millionth of a millionth."""

LARGEST_RATIO = 0.25
"""Largest half axis drawn, of the extent of the map: a point near infinity must not hide it."""


@dataclass(frozen=True, slots=True, eq=False)
class Drawing:
    """The markers of one fusion."""

    fusion: Fusion
    header: Any
    """in the global frame"""
    max_ellipsoids: int

    def message(self) -> Any:
        """A MarkerArray that takes the place of the one before."""
        clear = Marker(header=self.header, action=Marker.DELETEALL)
        return MarkerArray(markers=[clear, *self._markers()])

    def _markers(self) -> Iterator[Any]:
        merged = self.fusion.in_state(State.MERGED)
        if not merged:
            return
        extent, colours = self._extent(), robot_colours(self.fusion)
        yield self._links(merged, extent)
        for k, item in enumerate(merged):
            colour = colours[item.submap.robot_id]
            yield self._frame(k, item, colour, extent)
            yield self._label(k, item, extent)
            covariance = covariance_of_parts(item.S_global_map, item.covariance)[3:6, 3:6]
            if covariance.any():
                at = item.S_global_map.translation
                yield self._ellipsoid('frame_std', k, at, covariance, colour, extent)
        yield from self._landmarks(extent)
        yield from self._changes(extent)

    def _extent(self) -> float:
        """Twice the radius of the scene, global units."""
        points = self.fusion.components[0].landmarks.points_global
        return max(scene_radius(points), np.finfo(float).tiny) * 2.0

    def _marker(self, namespace: str, number: int, kind: int, colour: Rgb, alpha: float) -> Any:
        r, g, b = (value / 255.0 for value in colour)
        marker = Marker(header=self.header, ns=namespace, id=number, type=kind, action=Marker.ADD)
        marker.color = ColorRGBA(r=r, g=g, b=b, a=alpha)
        marker.pose.orientation.w = 1.0
        return marker

    def _links(self, merged: tuple[MapAlignment, ...], extent: float) -> Any:
        """One line for each pair of merged sub-maps with landmarks in common."""
        origins = {item.submap.map_id: point(item.S_global_map.translation) for item in merged}
        marker = self._marker('links', 0, Marker.LINE_LIST, SHARED, 0.8)
        marker.scale.x = LINK_RATIO * extent
        marker.points = [
            origins[name]
            for pair in self.fusion.pairs
            if pair.shared and pair.a in origins and pair.b in origins
            for name in (pair.a, pair.b)
        ]
        return marker

    def _frame(self, number: int, item: MapAlignment, colour: Rgb, extent: float) -> Any:
        marker = self._marker('frames', number, Marker.SPHERE, colour, 1.0)
        marker.pose = Pose(position=point(item.S_global_map.translation))
        marker.pose.orientation = quaternion(item.S_global_map.rotation)
        size = FRAME_RATIO * extent
        marker.scale = Vector3(x=size, y=size, z=size)
        return marker

    def _label(self, number: int, item: MapAlignment, extent: float) -> Any:
        marker = self._marker('labels', number, Marker.TEXT_VIEW_FACING, SHARED, 1.0)
        above = item.S_global_map.translation + np.array([0.0, 0.0, TEXT_RATIO * extent])
        marker.pose.position = point(above)
        marker.scale.z = TEXT_RATIO * extent
        marker.text = item.submap.map_id
        return marker

    def _landmarks(self, extent: float) -> Iterator[Any]:
        """Ellipsoids of the least certain landmarks; the cloud has the rest as numbers."""
        landmarks = self.fusion.components[0].landmarks
        sizes = np.linalg.norm(landmarks.std, axis=1)
        known = np.flatnonzero(np.isfinite(sizes))
        order = known[np.argsort(-sizes[known], kind='stable')][: self.max_ellipsoids]
        for k, row in enumerate(order):
            covariance = np.diag(landmarks.std[row] ** 2)
            at = landmarks.points_global[row]
            yield self._ellipsoid('landmark_std', k, at, covariance, SHARED, extent)

    def _changes(self, extent: float) -> Iterator[Any]:
        """Arrows from where the others have a landmark to where one sub-map has it."""
        for k, change in enumerate(self.fusion.changes):
            colour = colour_of(change.p_value)
            marker = self._marker('changes', k, Marker.ARROW, colour, 1.0)
            tip = change.position_global
            marker.points = [point(tip - change.displacement_global), point(tip)]
            width = LINK_RATIO * extent
            marker.scale = Vector3(x=width, y=3.0 * width, z=0.0)
            yield marker
            if k < self.max_ellipsoids:
                yield self._ellipsoid('change_std', k, tip, change.covariance, colour, extent)

    def _ellipsoid(
        self,
        namespace: str,
        number: int,
        position: Floats,
        covariance: Floats,
        colour: Rgb,
        extent: float,
    ) -> Any:
        marker = self._marker(namespace, number, Marker.SPHERE, colour, 0.3)
        diameters, rotation = axes(covariance, LARGEST_RATIO * extent)
        marker.pose.position = point(position)
        marker.pose.orientation = quaternion(rotation)
        marker.scale = vector(diameters)
        return marker


def colour_of(p_value: float) -> Rgb:
    """Colour of a change: the redder, the less it may be chance."""
    share = min(float(np.log10(max(p_value, 1e-300))) / LEAST_LOG_P, 1.0)
    r, g, b = (round(a + share * (b - a)) for a, b in zip(DOUBTFUL, CERTAIN, strict=True))
    return r, g, b


def axes(covariance: Floats, largest: float) -> tuple[Floats, Floats]:
    """Diameters (3,) of an ellipsoid of `STANDARD_DEVIATIONS`, and its rotation (3, 3)."""
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2.0)
    half = STANDARD_DEVIATIONS * np.sqrt(np.maximum(values, 0.0))
    # A flat ellipsoid is not drawn at all; one of no thickness is refused by RViz.
    half = np.clip(half, 1e-6 * largest, largest)
    rotation = vectors * np.sign(np.linalg.det(vectors))
    return 2.0 * half, as_rotation(rotation).as_matrix()
