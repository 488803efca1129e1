# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
How close the merge of real sub-maps comes to the full bundle of all their images.

    python benchmarks/real_data.py ../shared/data --markdown docs/real_data.md

Every session is compressed by itself to the landmarks that it shares with another one, through
the encoded message; the merge is compared with the gold bundle, after a similarity.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from data_sets import data_sets
from documents import published

from mapmerge_ros.bundle import Bundle, MapName, compress
from mapmerge_ros.bundle.selection import matched
from mapmerge_ros.fusion import Fusion, fuse
from mapmerge_ros.fusion.refine import Robot, refine
from mapmerge_ros.geometry import Gauge, align, align_robustly, scene_radius
from mapmerge_ros.io import decode_submap, encode_submap, load_colmap
from mapmerge_ros.simulation import join, solve
from mapmerge_ros.submap import SubMap

CAPS: dict[str, int | None] = {'caliterra_drone': 600, 'boruszyn_kite': 1000}
"""Landmarks per sub-map where all shared ones are thousands; None = all."""


@dataclass(frozen=True)
class Row:
    """One data set."""

    name: str
    sessions: int
    merged: int
    landmarks: int
    kilobytes: float
    raw_kilobytes: float
    variance_factor: float
    procrustes: float
    merge: float
    seconds: float


def error_ratio(points: np.ndarray, gold: np.ndarray) -> float:
    """Median distance to gold after a robust similarity, in scene radii."""
    found = align_robustly(
        gold, points, gauge=Gauge.SIMILARITY, weights=np.ones(len(gold)), steps=30
    )
    distances = np.linalg.norm(found.S_target_source.apply(points) - gold, axis=1)
    return float(np.median(distances)) / scene_radius(gold)


def procrustes_and_averaging(submaps: list[SubMap], ids: np.ndarray) -> np.ndarray:
    """Baseline of the paper: each map onto the mean of the others, matching points averaged."""
    rows = [np.searchsorted(ids, submap.compressed_ids) for submap in submaps]
    known = [np.isin(submap.compressed_ids, ids) for submap in submaps]
    points = np.full((len(ids), 3), np.nan)
    waiting = list(range(len(submaps)))
    while waiting:
        seen = ~np.isnan(points[:, 0])
        common = [(seen[rows[k][known[k]]]).sum() for k in waiting]
        k = waiting.pop(int(np.argmax(common)))
        at, own = rows[k][known[k]], submaps[k].compressed_points[known[k]]
        both = seen[at]
        placed = (
            align(points[at[both]], own[both]).S_target_source.apply(own) if seen.any() else own
        )
        points[at[~both]] = placed[~both]
    for _ in range(20):
        total, count = np.zeros_like(points), np.zeros(len(ids))
        for submap, row, keep in zip(submaps, rows, known, strict=True):
            own, at = submap.compressed_points[keep], row[keep]
            np.add.at(total, at, align(points[at], own).S_target_source.apply(own))
            np.add.at(count, at, 1)
        points = total / count[:, None]
    return points


def compress_sessions(folder: Path, cap: int | None) -> tuple[list[SubMap], list[Bundle]]:
    """Every session by itself, through the message as it would go over the air."""
    bundles = [load_colmap(path) for path in sorted(folder.glob('session_*'))]
    submaps = [
        decode_submap(
            encode_submap(
                compress(
                    bundle,
                    MapName(f'session_{k}', 'robot', id_space='truth'),
                    ids,
                    catalogue=False,
                )
            )
        )
        for k, (bundle, ids) in enumerate(zip(bundles, matched(bundles, cap), strict=True))
    ]
    return submaps, bundles


def evaluate(folder: Path, cap: int | None = None) -> tuple[Row, Fusion]:
    """Compress, merge and compare one data set."""
    submaps, bundles = compress_sessions(folder, cap)
    begin = time.perf_counter()
    fusion = fuse(submaps)
    seconds = time.perf_counter() - begin
    component, gold_bundle = fusion.components[0], load_colmap(folder / 'gold')
    landmarks = component.landmarks
    views = np.bincount(landmarks.member_rows, minlength=len(landmarks.ids))
    compared = (views > 1) & np.isin(landmarks.ids, gold_bundle.point_ids)
    ids = landmarks.ids[compared]
    gold = gold_bundle.points[gold_bundle.rows_of(ids)]
    raw = sum(16 * len(bundle.observations_px) for bundle in bundles)
    row = Row(
        name=folder.name,
        sessions=len(submaps),
        merged=len(component.map_ids),
        landmarks=len(ids),
        kilobytes=sum(len(encode_submap(submap)) for submap in submaps) / 1e3,
        raw_kilobytes=raw / 1e3,
        variance_factor=component.verdict.variance_factor,
        procrustes=error_ratio(procrustes_and_averaging(submaps, ids), gold),
        merge=error_ratio(landmarks.points_global[compared], gold),
        seconds=seconds,
    )
    return row, fusion


@dataclass(frozen=True)
class Refinement:
    """Rounds of re-linearisation on one data set."""

    name: str
    landmarks: int
    errors: list[float]
    """After each round, scene radii; to the full bundle with the very same links"""
    cost_ratio: float
    """True cost over that of the full bundle, minus 1, at the end"""
    seconds: float


def evaluate_rounds(folder: Path, cap: int | None, count: int) -> Refinement:
    """Refine one data set and compare each round with the full bundle of the same links."""
    bundles = [load_colmap(path) for path in sorted(folder.glob('session_*'))]
    robots = [
        Robot(MapName(f'session_{k}', 'robot', id_space='truth'), bundle, ids)
        for k, (bundle, ids) in enumerate(zip(bundles, matched(bundles, cap), strict=True))
    ]
    begin = time.perf_counter()
    refined, rounds = refine(robots, count)
    seconds = time.perf_counter() - begin
    frames = {item.submap.map_id: item.S_global_map for item in rounds[-1].fusion.alignments}
    # A point that is not linked stays one of its own session, as in the merge.
    apart = [
        np.where(np.isin(robot.bundle.point_ids, robot.landmark_ids), 0, k + 1) * 10**12
        for k, robot in enumerate(refined)
    ]
    full = solve(
        join(
            [robot.bundle for robot in refined],
            [frames[robot.name.map_id] for robot in refined],
            [
                robot.bundle.point_ids + offset.astype(np.uint64)
                for robot, offset in zip(refined, apart, strict=True)
            ],
        )
    )
    landmarks = rounds[-1].fusion.components[0].landmarks
    views = np.bincount(landmarks.member_rows, minlength=len(landmarks.ids))
    ids = landmarks.ids[(views > 1) & np.isin(landmarks.ids, full.bundle.point_ids)]
    gold = full.bundle.points[full.bundle.rows_of(ids)]
    errors = []
    for each in rounds:
        merged = each.fusion.components[0].landmarks
        errors.append(error_ratio(merged.points_global[np.searchsorted(merged.ids, ids)], gold))
    ratio = rounds[-1].cost_px2 / full.cost_px2 - 1.0
    return Refinement(folder.name, len(ids), errors, ratio, seconds)


def refinement_table(rows: list[Refinement], count: int) -> str:
    """Markdown table."""
    heads = ' | '.join(f'round {k + 1}' for k in range(count))
    lines = [
        f'| set | shared landmarks | {heads} | true cost, relative to the full bundle | seconds |',
        '|---' * (count + 4) + '|',
    ]
    for row in rows:
        errors = [f'{error:.1e}' for error in row.errors] + ['–'] * (count - len(row.errors))
        lines.append(
            f'| {row.name} | {row.landmarks} | {" | ".join(errors)} | {row.cost_ratio:+.1e} | '
            f'{row.seconds:.0f} |'
        )
    return '\n'.join(lines)


def table(rows: list[Row]) -> str:
    """Markdown table."""
    lines = [
        '| set | maps merged | shared landmarks | sent [kB] | ã/(dof σ²) | '
        'Procrustes and averaging | merge | gain | seconds |',
        '|---|---|---|---|---|---|---|---|---|',
    ]
    lines += [
        f'| {row.name} | {row.merged} of {row.sessions} | {row.landmarks} | {row.kilobytes:.0f} | '
        f'{row.variance_factor:.2f} | {row.procrustes:.1e} | {row.merge:.1e} | '
        f'{row.procrustes / row.merge:.0f} × | {row.seconds:.1f} |'
        for row in rows
    ]
    return '\n'.join(lines)


def main(argv: list[str] | None = None) -> int:
    """Print the table, and write it into a document when asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('data', type=Path, help='folder with one folder per data set')
    parser.add_argument('--markdown', type=Path, help='document whose table is replaced')
    parser.add_argument('--rounds', type=int, default=0, help='re-linearise so many times')
    args = parser.parse_args(argv)
    mark = 'rounds' if args.rounds else 'table'
    return published(lambda: [measure(data_sets(args.data), args.rounds)], args.markdown, mark)


def measure(folders: list[Path], rounds: int) -> str:
    """Table of the merges, or of rounds of refinement."""
    if not rounds:
        return table([evaluate(folder, CAPS.get(folder.name))[0] for folder in folders])
    caps = {name: min(cap or 10**9, 600) for name, cap in CAPS.items()}
    rows = [evaluate_rounds(folder, caps.get(folder.name), rounds) for folder in folders]
    return refinement_table(rows, rounds)


if __name__ == '__main__':
    sys.exit(main())
