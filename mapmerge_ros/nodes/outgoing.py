# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What a fusion found, as messages."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from mapmerge_msgs.msg import Alignment, AlignmentArray, Change, ChangeArray, FusionStatus
from std_msgs.msg import Header

from mapmerge_ros import fusion
from mapmerge_ros.arrays import Floats
from mapmerge_ros.fusion import Fusion, FusionConfig, MapAlignment, State
from mapmerge_ros.geometry import Similarity, skew
from mapmerge_ros.nodes.frames import point, quaternion, vector
from mapmerge_ros.nodes.ledger import Ledger

NO_COMPONENT = 2**32 - 1
"""`Alignment.component` of a sub-map that is in none."""


@dataclass(frozen=True, slots=True, eq=False)
class Outgoing:
    """A fusion with its stamp: all that is published of it."""

    fusion: Fusion
    stamp: Any
    """builtin_interfaces/Time, node time of the end of the merge"""
    config: FusionConfig

    @property
    def header(self) -> Any:
        """Header in the global frame."""
        return Header(stamp=self.stamp, frame_id=self.config.global_frame)

    def alignments(self) -> Any:
        """Alignments of every sub-map that the engine held."""
        found = [_alignment(item) for item in self.fusion.alignments]
        return AlignmentArray(header=self.header, alignments=found)

    def changes(self) -> Any:
        """Changes, that is what was taken out of the merge."""
        found = [_change(change) for change in self.fusion.changes]
        return ChangeArray(header=self.header, changes=found)

    def status(self, ledger: Ledger) -> Any:
        """Status with the evidence of this fusion and the counters of the node."""
        message = FusionStatus(header=self.header, global_map_id=self.config.map_id)
        fill_counters(message, ledger)
        _fill_counts(message, self.fusion)
        _fill_evidence(message, self.fusion)
        return message


def fill_counters(message: Any, ledger: Ledger) -> None:
    """Write the counters of the node into a FusionStatus."""
    message.bytes_in = ledger.bytes_in
    message.bytes_out = ledger.bytes_out
    message.messages_received = ledger.received
    message.messages_refused = ledger.refused


def _fill_counts(message: Any, fusion: Fusion) -> None:
    message.sub_maps = len(fusion.alignments)
    message.merged = len(fusion.in_state(State.MERGED))
    message.detached = len(fusion.in_state(State.DETACHED))
    message.refused = len(fusion.in_state(State.REFUSED))
    if fusion.components:
        component = fusion.components[0]
        message.revision = component.submap.revision
        message.landmarks = len(component.landmarks.ids)
        views = np.bincount(component.landmarks.member_rows)
        message.shared_landmarks = int(np.count_nonzero(views > 1))
        message.iterations = component.iterations
        message.starts = component.starts
        message.converged = bool(component.converged)


def _fill_evidence(message: Any, fusion: Fusion) -> None:
    verdict, timing = fusion.verdict, fusion.timing
    message.a_tilde = float(verdict.a_tilde)
    message.dof = int(verdict.dof)
    message.sigma = float(verdict.sigma)
    message.variance_factor = float(verdict.variance_factor)
    message.p_value = float(verdict.p_value)
    message.accepted = bool(verdict.accepted)
    message.reason = verdict.reason
    message.associate_s = timing.associate_s
    message.merge_s = timing.merge_s
    message.test_s = timing.test_s
    message.total_s = timing.total_s


def _alignment(item: MapAlignment) -> Any:
    S_global_map = item.S_global_map
    return Alignment(
        map_id=item.submap.map_id,
        robot_id=item.submap.robot_id,
        revision=item.submap.revision,
        frame_id=item.submap.frame_id,
        state=int(item.state),
        reason=item.reason,
        component=item.component if item.component >= 0 else NO_COMPONENT,
        scale=S_global_map.scale,
        rotation=quaternion(S_global_map.rotation),
        translation=vector(S_global_map.translation),
        covariance=covariance_of_parts(S_global_map, item.covariance).ravel(),
    )


def _change(change: fusion.Change) -> Any:
    return Change(
        map_id=change.map_id,
        revision=change.revision,
        landmark_id=change.landmark_id,
        global_landmark_id=change.global_id,
        position=point(change.position_global),
        displacement=vector(change.displacement_global),
        covariance=change.covariance.ravel(),
        p_value=change.p_value,
        object_id=change.object_id,
        kind=int(change.kind),
    )


def covariance_of_parts(S_global_map: Similarity, covariance: Floats) -> Floats:
    """
    Covariance (7, 7) of rotation, translation and log scale, each by itself.

    The engine's is that of the left tangent of the whole transform, in which a turn about the
    global origin moves the translation too.
    """
    parts = np.eye(7)
    parts[3:6, :3] = -skew(S_global_map.translation)
    parts[3:6, 6] = S_global_map.translation
    return np.asarray(parts @ covariance @ parts.T, np.float64)
