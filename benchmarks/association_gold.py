# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Robots without ids, end to end: how close to the full bundle of all images their merge comes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
from real_data import error_ratio, procrustes_and_averaging
from scoring import Scorer

from mapmerge_ros.arrays import Floats, Mask
from mapmerge_ros.bundle import MapName, compress
from mapmerge_ros.bundle.lens_prior import with_lens_prior
from mapmerge_ros.bundle.quality import TrackQuality
from mapmerge_ros.fusion import fuse
from mapmerge_ros.fusion.offline import choose_for_bundles
from mapmerge_ros.fusion.outcome import Landmarks, State
from mapmerge_ros.io import decode_submap, encode_submap
from mapmerge_ros.submap import SubMap

CAP = 300
"""Compressed landmarks of a map, at most."""
ASKED = {'euroc_v101_maplab': 5.0, 'brighton_drone': 5.0}
"""Times nearer to gold than Procrustes and averaging; ELSEWHERE where not named."""
ELSEWHERE = 2.0
QUALITIES = {'good ones': TrackQuality(), 'all': None}
LENSES_PX = (0.0, 0.12)
FIRST_UNLINKED = 1 << 40


@dataclass(frozen=True)
class Setup:
    """How robots choose and compress."""

    quality: str
    lens_px: float


def gold(sets: dict[str, list[SubMap]], data: Path) -> str:
    """Markdown: one line per set and per way of compressing."""
    lines = [
        '| set | tracks | lens known to [px] | maps merged | landmarks | links right by id | '
        'ã/(dof σ²) | Procrustes and averaging | merge | gain | asked |',
        '|---' * 11 + '|',
    ]
    for name in sets:
        scorer = Scorer(data / name)
        for quality, lens_px in product(QUALITIES, LENSES_PX):
            lines.append(evaluate(scorer, Setup(quality, lens_px)))
    return '\n'.join(lines)


def evaluate(scorer: Scorer, setup: Setup) -> str:
    """One line of the table."""
    name = scorer.folder.name
    submaps = compressed(scorer, setup)
    fusion = fuse(submaps)
    component = fusion.components[0]
    linked, placed = gold_positions(scorer, component.landmarks)
    rows = np.flatnonzero(linked)
    renamed = [_named_by_row(submap, component.landmarks) for submap in submaps]
    procrustes = error_ratio(
        procrustes_and_averaging(
            [own for own in renamed if own.map_id in component.map_ids], rows.astype(np.uint64)
        ),
        placed[rows],
    )
    merge = error_ratio(component.landmarks.points_global[rows], placed[rows])
    asked = ASKED.get(name, ELSEWHERE)
    return (
        f'| {name} | {setup.quality} | {setup.lens_px:g} | '
        f'{len(fusion.in_state(State.MERGED))} of {len(submaps)} | {len(rows)} | '
        f'{right_share(scorer, component.landmarks):.3f} | '
        f'{component.verdict.variance_factor:.2f} | {procrustes:.1e} | {merge:.1e} | '
        f'{procrustes / merge:.1f} × | {asked:g} × |'
    )


def compressed(scorer: Scorer, setup: Setup) -> list[SubMap]:
    """Every session by itself, private ids, through the message as it would go over the air."""
    names = [MapName(f'{k}', f'robot{k}') for k in range(len(scorer.bundles))]
    bundles = [with_lens_prior(bundle, setup.lens_px) for bundle in scorer.bundles]
    chosen = choose_for_bundles(bundles, names, CAP, QUALITIES[setup.quality])
    return [
        decode_submap(encode_submap(compress(bundle, name, ids)))
        for bundle, name, ids in zip(bundles, names, chosen, strict=True)
    ]


def gold_positions(scorer: Scorer, landmarks: Landmarks) -> tuple[Mask, Floats]:
    """Landmarks (n,) of several maps, and where the gold bundle has them: their members' mean."""
    total = np.zeros_like(landmarks.points_global)
    for map_id, rows, ids in _members(landmarks):
        session = int(map_id)
        np.add.at(total, rows, scorer.gold_points(session, scorer.bundles[session].rows_of(ids)))
    views = np.bincount(landmarks.member_rows, minlength=len(total))
    return views > 1, total / np.maximum(views, 1)[:, None]


def right_share(scorer: Scorer, landmarks: Landmarks) -> float:
    """Share of the merged landmarks whose members' gold positions are all as good as one."""
    linked, middle = gold_positions(scorer, landmarks)
    worst = np.zeros(len(middle))
    for map_id, rows, ids in _members(landmarks):
        session = int(map_id)
        points = scorer.gold_points(session, scorer.bundles[session].rows_of(ids))
        np.maximum.at(worst, rows, np.linalg.norm(points - middle[rows], axis=1))
    return float(np.mean(worst[linked] <= scorer.near))


def _members(landmarks: Landmarks) -> list[tuple[str, np.ndarray, np.ndarray]]:
    """Per map its name, the rows of the merged landmarks that it has, its own ids of them."""
    owners = np.array(landmarks.member_maps)
    return [
        (str(own), landmarks.member_rows[owners == own], landmarks.member_ids[owners == own])
        for own in np.unique(owners)
    ]


def _named_by_row(submap: SubMap, landmarks: Landmarks) -> SubMap:
    """Ids that say which merged landmark it is, for the baseline."""
    owned = np.array(landmarks.member_maps) == submap.map_id
    own_ids, rows = landmarks.member_ids[owned], landmarks.member_rows[owned]
    ids = FIRST_UNLINKED + np.arange(len(submap.landmark_ids), dtype=np.uint64)
    order = np.argsort(submap.landmark_ids)
    ids[order[np.searchsorted(submap.landmark_ids, own_ids, sorter=order)]] = rows
    return replace(submap, landmark_ids=ids)
