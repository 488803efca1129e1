# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`summary.json`: everything a fusion found, as plain values with stable keys."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from mapmerge_ros.fusion import Change, ErrorModel, Fusion, MapAlignment, Verdict
from mapmerge_ros.fusion.outcome import Match
from mapmerge_ros.fusion.refusal import Quarantine
from mapmerge_ros.io.codec import encode_submap
from mapmerge_ros.io.moved_objects import MovedTogether, moved_objects
from mapmerge_ros.submap import SubMap


@dataclass(frozen=True, slots=True)
class Refused:
    """A message that was not taken in."""

    name: str
    """map_id, or the topic where the message could not be read"""
    reason: str


@dataclass(frozen=True, slots=True)
class Traffic:
    """What came over the wire."""

    accepted: int
    """Messages"""
    bytes_in: int
    """Of the accepted messages, every revision counted"""
    refused: tuple[Refused, ...] = ()


def summarise(fusion: Fusion, traffic: Traffic | None = None) -> dict[str, Any]:
    """
    Plain values (str, int, float, bool, list, dict, None) of a fusion; unknown numbers are None.

    Without `traffic` the sub-maps that are inside count as one message each.
    """
    sub_maps = [_sub_map(item) for item in fusion.alignments]
    traffic = traffic or Traffic(len(sub_maps), sum(row['bytes'] for row in sub_maps))
    first = fusion.components[0] if fusion.components else None
    summary = {
        'sub_maps': sub_maps,
        'test': _test(fusion.verdict),
        'changes': [_change(change) for change in fusion.changes],
        'objects': [_object(each) for each in moved_objects(fusion.changes)],
        'components': [list(component.map_ids) for component in fusion.components],
        'pairs': [{'a': x.a, 'b': x.b, 'shared': x.shared} for x in fusion.pairs],
        'matches': [_match(match) for match in fusion.matches],
        'contradictions': [
            {'landmark': x.landmark_id, 'a': x.a, 'b': x.b} for x in fusion.contradictions
        ],
        'iterations': first.iterations if first else 0,
        'starts': first.starts if first else 0,
        'converged': first.converged if first else False,
        'anchor': first.anchor if first else None,
        'gauge': int(first.gauge) if first else None,
        'landmarks': len(first.landmarks.ids) if first else 0,
        'timing_s': {
            'associate': fusion.timing.associate_s,
            'merge': fusion.timing.merge_s,
            'test': fusion.timing.test_s,
            'total': fusion.timing.total_s,
        },
        'messages': {
            'accepted': traffic.accepted,
            'refused': [{'name': x.name, 'reason': x.reason} for x in traffic.refused],
        },
        'bytes_in': traffic.bytes_in,
        'bytes_out': len(encode_submap(fusion.global_map)) if fusion.global_map else 0,
    }
    return {key: _plain(value) for key, value in summary.items()}


def summary_json(summary: Mapping[str, Any]) -> bytes:
    """Text of a summary; floats read back to the same bits."""
    return (json.dumps(summary, indent=2, allow_nan=False) + '\n').encode()


def noise_sigma(submap: SubMap) -> float:
    """Noise of one residual [px]: as stated, or from the map's own residuals; NaN = unknown."""
    if submap.sigma:
        return submap.sigma
    if not submap.compressed_count or submap.redundancy <= 0:
        return math.nan
    return submap.a / math.sqrt(submap.redundancy)


def _sub_map(item: MapAlignment) -> dict[str, Any]:
    submap, S_global_map = item.submap, item.S_global_map
    return {
        'map_id': submap.map_id,
        'robot_id': submap.robot_id,
        'revision': submap.revision,
        'landmarks': len(submap.landmark_ids),
        'compressed': submap.compressed_count,
        'gauge': int(submap.gauge),
        'bytes': len(encode_submap(submap)),
        'sigma': noise_sigma(submap),
        'state': item.state.name.lower(),
        'reason': item.reason,
        'note': item.note,
        'quarantine': None if item.quarantine is None else _quarantine(item.quarantine),
        'component': item.component if item.component >= 0 else None,
        'global_from_map': {
            'scale': S_global_map.scale,
            'rotation': S_global_map.rotation.tolist(),
            'translation': S_global_map.translation.tolist(),
        },
    }


def _quarantine(found: Quarantine) -> dict[str, Any]:
    return {
        'contradicts': list(found.contradicts),
        'price_ratio': found.price_ratio,
        'p_value': found.p_value,
        'distance': found.distance,
        'distance_ratio': found.distance_ratio,
    }


def _match(match: Match) -> dict[str, Any]:
    evidence = match.found.evidence
    return {
        'a': match.a,
        'b': match.b,
        'decision': match.found.decision.value,
        'reason': match.found.reason,
        'candidates': evidence.candidates,
        'inliers': evidence.inliers,
        'log_nfa': evidence.log_nfa,
        'links': match.links,
    }


def _test(verdict: Verdict) -> dict[str, Any]:
    return {
        'a_tilde': verdict.a_tilde,
        'dof': verdict.dof,
        'sigma': verdict.sigma,
        'variance_factor': verdict.variance_factor,
        'p_value': verdict.p_value,
        'accepted': verdict.accepted,
        'reason': verdict.reason,
        'textbook_p_value': verdict.textbook_p_value,
        'errors': None if verdict.errors is None else _errors(verdict.errors),
        'set_aside': verdict.set_aside,
        'moved': verdict.moved,
    }


def _errors(errors: ErrorModel) -> dict[str, float]:
    return {
        'noise_factor': errors.phi,
        'floor_ratio': errors.tau_ratio,
        'warp_ratio': errors.omega_ratio,
        'tail_freedom': errors.tail_freedom,
        'price': errors.price,
        'dof': errors.dof,
    }


def _change(change: Change) -> dict[str, Any]:
    return {
        'landmark': change.landmark_id,
        'map_id': change.map_id,
        'kind': change.kind.name.lower(),
        'object': change.object_id or None,
        'merged': change.merged,
        'position': change.position_global.tolist(),
        'displacement': change.displacement_global.tolist(),
        'std': change.std.tolist(),
        'covariance': change.covariance.tolist(),
        'p_value': change.p_value,
    }


def _object(moved: MovedTogether) -> dict[str, Any]:
    return {
        'object': moved.number,
        'map_id': moved.map_id,
        'landmarks': moved.count,
        'displacement': moved.displacement_global.tolist(),
        'distance': moved.distance,
        'distance_std': moved.distance_std,
        'turn_rad': moved.turn_rad,
        'p_value': moved.p_value,
    }


def _plain(value: Any) -> Any:
    """Numpy scalars to Python's, numbers that are not finite to None."""
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(inner) for inner in value]
    value = value.item() if hasattr(value, 'item') else value
    return None if isinstance(value, float) and not math.isfinite(value) else value
