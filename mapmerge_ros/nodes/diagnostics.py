# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`/diagnostics`: whether all is well, what is there, and who sends what."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from std_msgs.msg import Header

from mapmerge_ros.fusion import Fusion, Kind, MapAlignment, State
from mapmerge_ros.nodes.ledger import Held, Ledger

REFUSAL_WARNS_NS = 10_000_000_000
"""How long a refused message keeps the node at WARN: long enough to be seen in a monitor."""


LONG_MERGE_S = 30.0
"""A merge that takes longer is told: what was found before stays published meanwhile."""


@dataclass(frozen=True, slots=True, eq=False)
class Health:
    """All that the diagnostics are made of."""

    name: str
    """Of the node"""
    now_ns: int
    ledger: Ledger
    fusion: Fusion | None
    """The last one that succeeded"""
    merged_ns: int | None
    """When"""
    error: str
    """Why the last merge failed; empty if it did not"""
    incompatible: tuple[str, ...]
    """Publishers that cannot reach the node"""
    unanswered: int = 0
    """Sub-maps that were asked for landmarks and have not answered"""
    given_up: int = 0
    """Of those, how many are not asked again"""
    robot_timeout_s: float = 0.0
    """A robot that has been away for longer is stale; 0 = none ever is"""
    mode: str = 'active'
    """active, paused or inactive"""
    merging_s: float = 0.0
    """Since the merge that is running began; 0 = none is"""

    def message(self, stamp: Any) -> Any:
        """DiagnosticArray: the node first, then each robot, then topics without one."""
        robots = [self._robot(robot_id) for robot_id in sorted(self.ledger.robots)]
        nobody = [self._topic(*item) for item in self.ledger.nobodys_troubles().items()]
        return DiagnosticArray(header=Header(stamp=stamp), status=[self._node(), *robots, *nobody])

    def _topic(self, name: str, reason: str) -> Any:
        values = {'topic': name, 'reason': reason}
        text = f'left out, from no robot that is known here: {reason}'
        return _status(DiagnosticStatus.WARN, f'{self.name}: topic {name}', text, '', values)

    def _node(self) -> Any:
        level, text = self._verdict()
        fusion, ledger = self.fusion, self.ledger
        values: dict[str, object] = {
            'mode': self.mode,
            'robots': len(ledger.robots),
            'robots_stale': sum(self._is_stale(name) for name in ledger.robots),
            'sub_maps': len(ledger.maps),
            **({} if fusion is None else _merge_values(fusion)),
            'last_merge_s_ago': self._seconds_since(self.merged_ns),
            'merging_for_s': f'{self.merging_s:.1f}',
            'messages_received': ledger.received,
            'messages_refused': ledger.refused,
            'messages_ignored': ledger.ignored,
            'last_refusal': ledger.last_refusal,
            'requests_sent': ledger.requests,
            'requests_unanswered': self.unanswered,
            'requests_given_up': self.given_up,
            'bytes_in': ledger.bytes_in,
            'bytes_out': ledger.bytes_out,
            'incompatible_publishers': '; '.join(self.incompatible),
        }
        return _status(level, f'{self.name}: fusion', text, '', values)

    def _verdict(self) -> tuple[Any, str]:
        """Level and what to say; the worst first."""
        if self.error:
            return DiagnosticStatus.ERROR, f'merge failed: {self.error}'
        if self.fusion is not None and self.fusion.quarantined:
            return DiagnosticStatus.ERROR, _quarantine(self.fusion)
        warnings = [*self._doubts(), *self.incompatible]
        if self.merging_s > LONG_MERGE_S:
            warnings.append(f'merging for {self.merging_s:.0f} s')
        refusal_ns = self.ledger.last_refusal_ns
        if refusal_ns is not None and self.now_ns - refusal_ns < REFUSAL_WARNS_NS:
            warnings.append(f'message refused: {self.ledger.last_refusal}')
        if warnings:
            return DiagnosticStatus.WARN, '; '.join(warnings)
        if self.mode != 'active':
            return DiagnosticStatus.OK, self.mode
        if self.fusion is None or not self.fusion.alignments:
            return DiagnosticStatus.OK, 'waiting for sub-maps'
        merged = len(self.fusion.in_state(State.MERGED))
        return DiagnosticStatus.OK, f'{merged} of {len(self.fusion.alignments)} sub-maps merged'

    def _doubts(self) -> list[str]:
        """Return what speaks against the last merge."""
        if self.fusion is None:
            return []
        doubts = [] if self.fusion.verdict.accepted else [self.fusion.verdict.reason]
        moved = [change for change in self.fusion.changes if change.kind is Kind.MOVED]
        if moved:
            objects = len({change.object_id for change in moved})
            doubts.append(f'{objects} objects moved ({len(moved)} landmarks)')
        detached = len(self.fusion.in_state(State.DETACHED))
        refused = len(self.fusion.in_state(State.REFUSED))
        contradictions = len(self.fusion.contradictions)
        if detached and len(self.fusion.alignments) > 1:  # a first sub-map has nobody to join
            doubts.append(f'{detached} sub-maps detached')
        if refused:
            doubts.append(f'{refused} sub-maps refused')
        if odd := sum(bool(item.note) for item in self.fusion.alignments):
            doubts.append(f'{odd} sub-maps with odd residuals')
        if contradictions:
            doubts.append(f'{contradictions} ids contradict the geometry')
        return doubts

    def _robot(self, robot_id: str) -> Any:
        record = self.ledger.robots[robot_id]
        maps = {name: x for name, x in self.ledger.maps.items() if x.robot_id == robot_id}
        found = [item for item in self._alignments() if item.submap.map_id in maps]
        worst = max(found, key=lambda x: (x.quarantine is not None, x.state), default=None)
        state = 'received' if worst is None else worst.state.name.lower()
        in_quarantine = any(item.quarantine for item in found)
        reason = '' if worst is None else worst.reason
        merged = {item.submap.map_id: item.submap.revision for item in found}
        waiting = [
            f'{name}:{held.revision}'
            for name, held in maps.items()
            if found and merged.get(name) != held.revision
        ]
        values = {
            'topic': record.topic,
            'last_heard_s_ago': f'{record.age_s(self.now_ns):.1f}',
            'absent_s': f'{record.absent_s(self.now_ns):.1f}',
            'messages': record.messages,
            'messages_per_s': f'{record.messages_per_s(self.now_ns):.3g}',
            'maps': len(maps),
            'revision': ' '.join(f'{name}:{held.revision}' for name, held in maps.items()),
            'landmarks': sum(held.landmarks for held in maps.values()),
            'bytes': record.size_bytes,
            'bytes_per_s': f'{record.bytes_per_s(self.now_ns):.0f}',
            'compression_ratio': _compression_ratio(maps.values()),
            'waiting': ' '.join(waiting),
            'ignored': record.ignored,
            'state': 'quarantined' if in_quarantine else state,
            'reason': reason,
        }
        is_fine = worst is None or worst.state is State.MERGED or len(self._alignments()) == 1
        level = DiagnosticStatus.OK if is_fine else DiagnosticStatus.WARN
        notes = [f'{item.submap.map_id}: {item.note}' for item in found if item.note]
        level = DiagnosticStatus.WARN if notes else level
        trouble = record.trouble or self.ledger.trouble_of(robot_id)
        level = DiagnosticStatus.WARN if trouble else level
        level = DiagnosticStatus.ERROR if in_quarantine else level
        text = '; '.join([reason or state, *notes])
        if waiting:
            text = f'{text}; {", ".join(waiting)} waits for the next merge'
        if trouble:
            text = f'newest message left out: {trouble}; {text}'
        if self._is_stale(robot_id):
            level = DiagnosticStatus.STALE
            text = f'left {record.absent_s(self.now_ns):.0f} s ago, its maps stay; {text}'
        return _status(level, f'{self.name}: robot {robot_id}', text, robot_id, values)

    def _is_stale(self, robot_id: str) -> bool:
        absent_s = self.ledger.robots[robot_id].absent_s(self.now_ns)
        return 0.0 < self.robot_timeout_s < absent_s

    def _alignments(self) -> tuple[MapAlignment, ...]:
        return () if self.fusion is None else self.fusion.alignments

    def _seconds_since(self, time_ns: int | None) -> str:
        return 'never' if time_ns is None else f'{max(self.now_ns - time_ns, 0) * 1e-9:.1f}'


def _compression_ratio(maps: Iterable[Held]) -> str:
    held = tuple(maps)
    size_bytes = sum(item.size_bytes for item in held)
    return f'{sum(item.observation_bytes for item in held) / max(size_bytes, 1):.3g}'


def _quarantine(fusion: Fusion) -> str:
    found = '; '.join(f'{item.submap.map_id} {item.reason}' for item in fusion.quarantined)
    return f'{len(fusion.quarantined)} of {len(fusion.alignments)} sub-maps kept out: {found}'


def _merge_values(fusion: Fusion) -> dict[str, object]:
    verdict, components = fusion.verdict, fusion.components
    return {
        'merged': len(fusion.in_state(State.MERGED)),
        'detached': len(fusion.in_state(State.DETACHED)),
        'refused': len(fusion.in_state(State.REFUSED)),
        'quarantined': len(fusion.quarantined),
        'landmarks': len(components[0].landmarks.ids) if components else 0,
        'contradictions': len(fusion.contradictions),
        'moved': sum(change.kind is Kind.MOVED for change in fusion.changes),
        'doubtful': sum(change.kind is Kind.DOUBTFUL for change in fusion.changes),
        'accepted': verdict.accepted,
        'a_tilde': f'{verdict.a_tilde:.6g}',
        'dof': verdict.dof,
        'variance_factor': f'{verdict.variance_factor:.4g}',
        'p_value': f'{verdict.p_value:.4g}',
        'merge_associate_s': f'{fusion.timing.associate_s:.3f}',
        'merge_solve_s': f'{fusion.timing.merge_s:.3f}',
        'merge_test_s': f'{fusion.timing.test_s:.3f}',
        'merge_total_s': f'{fusion.timing.total_s:.3f}',
    }


def _status(
    level: Any, name: str, text: str, hardware_id: str, values: Mapping[str, object]
) -> Any:
    return DiagnosticStatus(
        level=level,
        name=name,
        message=text,
        hardware_id=hardware_id,
        values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
    )
