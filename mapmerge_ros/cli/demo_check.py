# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What arrived over the topics against the same messages merged offline, and against truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from mapmerge_ros.cli import console
from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.fusion import Fusion, State
from mapmerge_ros.geometry import Gauge, align
from mapmerge_ros.io.truth import RecordingTruth, TruthComparison, compare_with_truth
from mapmerge_ros.io.wording import against_truth, verdict_sentences
from mapmerge_ros.submap import SubMap

NUMERICAL = 1e-6
"""
Relative difference that is only rounding.

The node merges after every arrival and starts each merge in the frame of the last one; the
replay may take other steps to the same optimum.
"""

TRUE_RATIO = 0.01
"""Median error as a share of the scene that a right map stays below; 0.002 is usual."""

MapStates = Mapping[str, tuple[int, int]]
"""map_id to revision and state."""


@dataclass(frozen=True, slots=True)
class Check:
    """One property that was checked."""

    name: str
    passed: bool
    detail: str


@dataclass(frozen=True, slots=True, eq=False)
class Arrived:
    """What a fusion node has published about one merge."""

    global_map: SubMap
    status: Any
    """FusionStatus"""
    states: MapStates


def states_of(fusion: Fusion) -> MapStates:
    """Revision and state of every sub-map of a fusion."""
    return {
        item.submap.map_id: (item.submap.revision, int(item.state)) for item in fusion.alignments
    }


def compare_with_replay(arrived: Arrived, fusion: Fusion) -> list[Check]:
    """Check states, evidence and landmarks."""
    verdict, status = fusion.verdict, arrived.status
    same_states = arrived.states == states_of(fusion)
    same_test = bool(
        status.dof == verdict.dof
        and np.isclose(status.a_tilde, verdict.a_tilde, rtol=NUMERICAL, atol=0.0)
        and np.isclose(status.p_value, verdict.p_value, rtol=1e3 * NUMERICAL)
    )
    distance = _distance(arrived.global_map, fusion)
    return [
        Check('sub-maps as in the replay', same_states, f'{len(arrived.states)} sub-maps'),
        Check(
            'test as in the replay',
            same_test,
            f'ã/σ² = {status.a_tilde / status.sigma**2:.1f} for {status.dof} expected',
        ),
        Check('landmarks as in the replay', distance < NUMERICAL, f'{distance:.1e} of the scene'),
    ]


def compare_arrived_with_truth(
    arrived: Arrived, fusion: Fusion, truth: RecordingTruth
) -> tuple[Check, TruthComparison | None]:
    """Check the landmarks that arrived; `fusion` says which sub-maps have them."""
    try:
        found = compare_with_truth(_as_arrived(arrived.global_map, fusion), truth)
    except DegenerateGeometry as err:
        return Check('landmarks as in truth', False, str(err)), None
    ratio = found.median_error / found.radius
    detail = f'{found.median_error:.3g} m off (median), {100 * ratio:.2g} % of the scene'
    return Check('landmarks as in truth', ratio < TRUE_RATIO, detail), found


def show(
    screen: Console,
    fusion: Fusion,
    truth: TruthComparison | None,
    checks: list[Check],
    files: tuple[Path, ...],
) -> None:
    """Show what was checked, what was found, and where it lies."""
    shown = console.table('check', 'result', 'what')
    for check in checks:
        shown.add_row(check.name, 'passed' if check.passed else 'FAILED', check.detail)
    screen.print(shown)
    screen.print(verdict_sentences(fusion), soft_wrap=True)
    if truth:
        screen.print(against_truth(truth), soft_wrap=True)
    if len(fusion.in_state(State.MERGED)) < len(fusion.alignments):
        for item in fusion.alignments:
            if item.reason:
                screen.print(f'{item.submap.map_id}: {item.reason}', soft_wrap=True)
    names = ' '.join(path.name for path in files)
    screen.print(f'{files[0].parent}: {names}', soft_wrap=True)


def _distance(global_map: SubMap, fusion: Fusion) -> float:
    """Largest distance of a landmark from the replay's, as a share of the scene."""
    expected = fusion.global_map
    if expected is None or not np.array_equal(global_map.landmark_ids, expected.landmark_ids):
        return float('inf')
    # Which sub-map holds the frame may depend on which one was heard first.
    S_replay_node = align(
        expected.compressed_points, global_map.compressed_points, gauge=Gauge.SIMILARITY
    ).S_target_source
    off = S_replay_node.apply(global_map.compressed_points) - expected.compressed_points
    spread = expected.compressed_points - expected.compressed_points.mean(axis=0)
    return float(np.linalg.norm(off, axis=1).max() / np.linalg.norm(spread, axis=1).mean())


def _as_arrived(global_map: SubMap, fusion: Fusion) -> Fusion:
    """Return the fusion with the landmarks where the message has them."""
    if not fusion.components:
        return fusion
    first, *others = fusion.components
    rows = {int(own): row for row, own in enumerate(first.landmarks.ids)}
    points = np.full_like(first.landmarks.points_global, np.nan)
    for own, point in zip(global_map.landmark_ids, global_map.points, strict=True):
        if int(own) in rows:
            points[rows[int(own)]] = point
    if np.isnan(points).any():
        raise DegenerateGeometry('merged landmarks are missing from the global map')
    landmarks = replace(first.landmarks, points_global=points)
    return replace(fusion, components=(replace(first, landmarks=landmarks), *others))
