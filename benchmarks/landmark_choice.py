# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
What a choice of landmarks is worth, beside landmarks drawn by lot.

    python benchmarks/landmark_choice.py ../shared/data

Everything that the robots have reconstructed is judged, not the chosen landmarks alone: after the
merge each robot takes the merged landmarks back (eq. 4), and all points and all cameras of all
robots, placed in the common frame, are compared with the gold bundle of a real set, or with the
truth of a simulated one, after one similarity. The lot draws among the landmarks that two robots
have in common, each for all robots that have it, within the same budget: a lot among all landmarks
of a map would join nothing. Ids are known. Simulated robots are also compared with the merge of
all common landmarks, which is what a choice can reach: their own noise no choice takes away.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from mapmerge_ros.arrays import Floats, Ids
from mapmerge_ros.bundle import Bundle, MapName, compress
from mapmerge_ros.bundle.quality import TrackQuality
from mapmerge_ros.errors import MapMergeError
from mapmerge_ros.fusion import FusionConfig, fuse
from mapmerge_ros.fusion.offline import choose_for_bundles
from mapmerge_ros.geometry import Gauge, align, align_robustly
from mapmerge_ros.io import load_colmap
from mapmerge_ros.simulation import FleetConfig, simulate_fleet

BUDGETS = (24, 50, 100)

FLEETS = {
    '4 drones': FleetConfig(drones=4, landmarks=500, keyframes=30),
    '9 drones': FleetConfig(drones=9, landmarks=500, keyframes=30),
}

MOST = 400
"""Landmarks of a map that stand for all common ones where those are thousands."""


@dataclass(frozen=True, eq=False)
class Robots:
    """Bundles, and where their points and cameras should be."""

    name: str
    bundles: tuple[Bundle, ...]
    points: tuple[Floats, ...]
    centres: tuple[Floats, ...]
    quality: TrackQuality | None
    """Of the choice; simulated robots have no bad tracks"""

    @property
    def names(self) -> list[MapName]:
        """Equal ids are equal points."""
        return [
            MapName(f'map{k:02d}', f'robot{k:02d}', stamp_ns=k + 1, id_space='truth')
            for k in range(len(self.bundles))
        ]


@dataclass(frozen=True, eq=False)
class Placed:
    """All points and cameras of all robots in the frame of the merge."""

    points: Floats
    centres: Floats


Errors = tuple[float, float, float]
"""Points: median and root mean square of the nearest nine tenths; cameras: root mean square."""


def real_robots(folder: Path) -> Robots:
    """Sessions of a data set, with the gold bundle."""
    bundles = tuple(load_colmap(path) for path in sorted(folder.glob('session_*')))
    gold, links = load_colmap(folder / 'gold'), np.load(folder / 'gold' / 'links.npz')
    points, centres = [], []
    for k, bundle in enumerate(bundles):
        ids, rows = links[f'session_{k}_point3D_id'], links[f'session_{k}_row']
        order = np.argsort(ids)
        own = order[np.searchsorted(ids[order], bundle.point_ids.astype(np.int64))]
        points.append(links['points'][rows[own]])
        centres.append(gold.centres_map()[links['session_of_image'] == k])
    return Robots(folder.name, bundles, tuple(points), tuple(centres), TrackQuality())


def simulated_robots(name: str, config: FleetConfig, seed: int) -> Robots:
    """Drones over a yard, with the truth."""
    fleet = simulate_fleet(config, seed=seed)
    truth = fleet.truth
    points = tuple(truth.points_world(ids) for ids in truth.landmark_ids)
    centres = tuple(bundle.centres_map() for bundle in truth.bundles)
    return Robots(f'{name}, seed {seed}', fleet.bundles, points, centres, None)


def by_lot(bundles: Sequence[Bundle], budget: int, rng: np.random.Generator) -> list[Ids]:
    """Common landmarks in random order, each for all who have it and have room."""
    ids = np.unique(np.concatenate([bundle.point_ids for bundle in bundles]))
    owners = np.array([np.isin(ids, bundle.point_ids) for bundle in bundles])
    room, taken = np.full(len(bundles), budget), np.zeros_like(owners)
    for track in rng.permutation(np.flatnonzero(owners.sum(axis=0) > 1)):
        takers = owners[:, track] & (room > 0)
        if takers.sum() > 1:
            taken[takers, track] = True
            room[takers] -= 1
    return [ids[row] for row in taken]


def merge(robots: Robots, chosen: Sequence[Ids]) -> Placed | None:
    """Merge, and bring every robot's map into agreement; None if they do not all come together."""
    submaps = [
        compress(*own, catalogue=False)
        for own in zip(robots.bundles, robots.names, chosen, strict=True)
    ]
    # Taking out what does not fit would judge the test, not the choice.
    fusion = fuse(submaps, FusionConfig(unlock=False, ask=False))
    component = fusion.components[0]
    if len(component.map_ids) < len(submaps):
        return None
    landmarks = component.landmarks
    members = np.array(landmarks.member_maps)
    points, centres = [], []
    for bundle, name in zip(robots.bundles, robots.names, strict=True):
        own = members == name.map_id
        updated = bundle.update(
            landmarks.member_ids[own], landmarks.points_global[landmarks.member_rows[own]]
        )
        S_global_map = updated.S_map_global.inverse()
        points.append(S_global_map.apply(updated.bundle.points))
        centres.append(S_global_map.apply(updated.bundle.centres_map()))
    return Placed(np.concatenate(points), np.concatenate(centres))


def errors(found: Placed, right: Placed) -> Errors:
    """How far everything is from where it should be, after a similarity."""
    weights = np.ones(len(right.points))
    S_right_found = align_robustly(
        right.points, found.points, gauge=Gauge.SIMILARITY, weights=weights, steps=30
    ).S_target_source
    distances = np.sort(np.linalg.norm(S_right_found.apply(found.points) - right.points, axis=1))
    S_right_found = align(right.centres, found.centres).S_target_source
    moved = S_right_found.apply(found.centres) - right.centres
    most = distances[: int(0.9 * len(distances))]
    return (
        float(np.median(distances)),
        float(np.sqrt(np.mean(most**2))),
        float(np.sqrt(np.mean(np.sum(moved**2, axis=1)))),
    )


def compare(robots: Robots, budgets: Sequence[int], draws: int) -> Iterator[str]:
    """Lines of the table: error of the choice over the median error of the lot."""
    right = Placed(np.concatenate(robots.points), np.concatenate(robots.centres))
    references = {'gold' if robots.quality else 'truth': right}
    if robots.quality is None:
        everything = merge(robots, by_lot(robots.bundles, MOST, np.random.default_rng(0)))
        if everything is not None:
            references['all common landmarks'] = everything
    for budget in budgets:
        chosen = choose_for_bundles(robots.bundles, robots.names, budget, robots.quality)
        merged = merge(robots, chosen)
        drawn = [
            merge(robots, by_lot(robots.bundles, budget, np.random.default_rng([budget, draw])))
            for draw in range(draws)
        ]
        joined = [item for item in drawn if item is not None]
        for name, reference in references.items():
            lot = np.median([errors(item, reference) for item in joined], axis=0)
            own = np.full(3, np.nan) if merged is None else np.array(errors(merged, reference))
            ratios = ' | '.join(f'{ratio:.2f}' for ratio in own / lot)
            yield (
                f'| {robots.name} | {name} | {budget} | {ratios} | '
                f'{"–" if merged is None else "yes"} | {len(joined)} of {draws} |'
            )


HEAD = """\
| robots | compared with | landmarks | points, median | points, RMS of 90 % | cameras, RMS \
| joined | by lot joined |
|---|---|---|---|---|---|---|---|"""


def every(data: Path, seeds: int) -> Iterator[Robots]:
    """Real sets first, one after the other."""
    for folder in sorted(path.parent for path in data.glob('*/gold')):
        yield real_robots(folder)
    for name, config in FLEETS.items():
        for seed in range(seeds):
            yield simulated_robots(name, config, seed)


def main(argv: list[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('data', type=Path, help='folder with one folder per data set')
    parser.add_argument('--draws', type=int, default=5)
    parser.add_argument('--seeds', type=int, default=1, help='of each simulated fleet')
    args = parser.parse_args(argv)
    print(HEAD)
    try:
        with threadpool_limits(1):
            for robots in every(args.data, args.seeds):
                for line in compare(robots, BUDGETS, args.draws):
                    print(line, flush=True)
    except MapMergeError as err:
        print(err, file=sys.stderr)
        return 1
    return 0


if __name__ == '__main__':
    sys.exit(main())
