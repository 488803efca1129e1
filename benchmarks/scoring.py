# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How right links between real sub-maps are: by id, by position and by joint triangulation."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.spatial

from mapmerge_ros.bundle import Bundle
from mapmerge_ros.geometry import scene_radius
from mapmerge_ros.io import load_colmap

FIRST_PRIVATE_ID = 100_000_000
"""point3D ids below are the same point in every session of a set (../shared/data/README.md)."""
TOLERANCE_PX = 4.0
"""One point explains all observations of both members of a link within this distance."""
NEAR_RATIO = {'euroc_v101_maplab': 0.005}
"""Gold positions nearer than this share of the scene radius are one point; 0.001 elsewhere."""


@dataclass(frozen=True, eq=False)
class Links:
    """Landmarks (rows of the bundles) of two sessions that are said to be one point."""

    a: int
    b: int
    rows_a: np.ndarray
    rows_b: np.ndarray


@dataclass(frozen=True)
class Score:
    """Shares of the links of a set."""

    links: int
    precision_by_id: float
    precision_by_triangulation: float
    recall: float


class Scorer:
    """Truth of one real set."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.bundles = [load_colmap(path) for path in sorted(folder.glob('session_*'))]
        gold, table = load_colmap(folder / 'gold'), np.load(folder / 'gold' / 'links.npz')
        self._gold = gold
        points = table['points']
        self.radius = scene_radius(points)
        self.near = NEAR_RATIO.get(folder.name, 0.001) * self.radius
        frames = [np.flatnonzero(table['session_of_image'] == k) for k in range(len(self.bundles))]
        self._cameras = [
            own[np.asarray(bundle.keyframe_ids, np.int64) - 1]
            for own, bundle in zip(frames, self.bundles, strict=True)
        ]
        self._points = []
        for k, bundle in enumerate(self.bundles):
            ids, rows = table[f'session_{k}_point3D_id'], table[f'session_{k}_row']
            order = np.argsort(ids)
            found = order[np.searchsorted(ids[order], bundle.point_ids.astype(np.int64))]
            self._points.append(points[rows[found]])

    def score(self, links: list[Links]) -> Score:
        """Precision and recall of links between all pairs of sessions."""
        by_id = np.concatenate([np.zeros(0, bool), *(self.right_by_id(x) for x in links)])
        passing = np.concatenate([np.zeros(0, bool), *(self.explained(x) for x in links)])
        true = [self.true_links(x.a, x.b) for x in links]
        right_rate = np.concatenate([self.explained(x) for x in true]).mean()
        wrong_rate = np.concatenate(
            [self.explained(self.false_neighbours(x)) for x in true]
        ).mean()
        corrected = (passing.mean() - wrong_rate) / (right_rate - wrong_rate)
        count = len(self.bundles)
        all_true = sum(
            len(self.true_links(a, b).rows_a) for a in range(count) for b in range(a + 1, count)
        )
        found = sum(int(self._same_id(x).sum()) for x in links)
        return Score(len(by_id), float(by_id.mean()), float(min(corrected, 1.0)), found / all_true)

    def gold_points(self, session: int, rows: np.ndarray) -> np.ndarray:
        """Where the gold bundle has landmarks (rows of the bundle) of a session, (n, 3)."""
        return np.asarray(self._points[session][rows])

    def true_links(self, a: int, b: int) -> Links:
        """Links that ids give."""
        ids_a, ids_b = self.bundles[a].point_ids, self.bundles[b].point_ids
        common, rows_a, rows_b = np.intersect1d(ids_a, ids_b, return_indices=True)
        keep = common < FIRST_PRIVATE_ID
        return Links(a, b, rows_a[keep], rows_b[keep])

    def right_by_id(self, links: Links) -> np.ndarray:
        """Whether ids agree, or the gold positions are as good as equal."""
        distance = np.linalg.norm(
            self._points[links.a][links.rows_a] - self._points[links.b][links.rows_b], axis=1
        )
        return np.asarray(self._same_id(links) | (distance < self.near))

    def false_neighbours(self, links: Links) -> Links:
        """For each link the landmark of b that is nearest to the right one, but is another."""
        points = self._points[links.b]
        _, nearest = scipy.spatial.KDTree(points).query(points[links.rows_b], k=2)
        wrong = np.where(nearest[:, 0] == links.rows_b, nearest[:, 1], nearest[:, 0])
        return Links(links.a, links.b, links.rows_a, wrong)

    def explained(self, links: Links) -> np.ndarray:
        """(n,) whether one point explains all observations of both members in the gold cameras."""
        points = 0.5 * (self._points[links.a][links.rows_a] + self._points[links.b][links.rows_b])
        parts = [
            self._observations(links.a, links.rows_a),
            self._observations(links.b, links.rows_b),
        ]
        slot, camera, pixel = (np.concatenate(items) for items in zip(*parts, strict=True))
        damping = 1e-6
        for _ in range(15):
            residual, jacobian, _ = self._project(points[slot], camera, pixel)
            normal = np.zeros((len(points), 3, 3))
            gradient = np.zeros((len(points), 3))
            np.add.at(normal, slot, np.einsum('nij,nik->njk', jacobian, jacobian))
            np.add.at(gradient, slot, np.einsum('nij,ni->nj', jacobian, residual))
            normal += damping * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(3)
            points = points - np.linalg.solve(normal, gradient[:, :, None])[:, :, 0]
        residual, _, depth = self._project(points[slot], camera, pixel)
        worst = np.zeros(len(points))
        np.maximum.at(worst, slot, np.where(depth > 0.0, np.linalg.norm(residual, axis=1), np.inf))
        return worst <= TOLERANCE_PX

    def _same_id(self, links: Links) -> np.ndarray:
        ids_a = self.bundles[links.a].point_ids[links.rows_a]
        return np.asarray(
            (ids_a == self.bundles[links.b].point_ids[links.rows_b]) & (ids_a < FIRST_PRIVATE_ID)
        )

    def _observations(
        self, session: int, rows: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        bundle = self.bundles[session]
        order = np.argsort(bundle.observation_points, kind='stable')
        sorted_points = bundle.observation_points[order]
        begin = np.searchsorted(sorted_points, rows, 'left')
        count = np.searchsorted(sorted_points, rows, 'right') - begin
        slot = np.repeat(np.arange(len(rows)), count)
        offset = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        picked = order[np.repeat(begin, count) + offset]
        camera = self._cameras[session][bundle.observation_keyframes[picked]]
        return slot, camera, bundle.observations_px[picked]

    def _project(
        self, points: np.ndarray, camera: np.ndarray, pixel: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        gold: Bundle = self._gold
        fx, fy, cx, cy = gold.intrinsics[gold.keyframe_cameras[camera]].T
        rotation = gold.rotations_camera_map[camera]
        local = np.einsum('nij,nj->ni', rotation, points)
        local += gold.translations_camera_map[camera]
        x, y, depth = local.T
        safe = np.where(np.abs(depth) < 1e-9, 1e-9, depth)
        residual = np.stack([fx * x / safe + cx, fy * y / safe + cy], axis=1) - pixel
        zero = np.zeros_like(safe)
        across = np.stack([fx / safe, zero, -fx * x / safe**2], axis=1)
        down = np.stack([zero, fy / safe, -fy * y / safe**2], axis=1)
        return residual, np.stack([across, down], axis=1) @ rotation, depth
