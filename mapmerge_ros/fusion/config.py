# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Every threshold of the fusion, in one immutable place."""

from __future__ import annotations

from dataclasses import dataclass

from mapmerge_ros.errors import InvalidValue

_LOWEST = {
    'min_shared': 3,
    'max_iterations': 1,
    'max_starts': 1,
    'max_landmarks': 3,
    'max_bytes': 0,
    'request_landmarks': 3,
    'request_bytes': 0,
}


@dataclass(frozen=True, slots=True)
class FusionConfig:
    """Settings of the engine; the defaults suit four drones as well as sixty."""

    map_id: str = 'fusion/global'
    """map_id of the map that comes out; a map of this name is never taken in."""
    global_frame: str = 'global'
    """frame_id of the map that comes out."""
    min_shared: int = 4
    """
    Landmarks that two sub-maps must share to be joined directly.

    Three points fit a similarity up to 2 degrees of freedom whatever they are; the fourth
    makes the join testable.
    """
    contradiction_ratio: float = 15.0
    """
    How many times the median distance of a pair's landmarks, each in units of its own standard
    deviation, makes equal ids a contradiction.

    No true landmark of five real sets gets there; an id that was given to two different points
    lands anywhere in the scene.
    """
    contradiction_extent: float = 0.2
    """
    Share of the common area's size that the distance must have as well.

    What moved by less is a change in the scene, to be tested and not to be ignored.
    """
    significance: float = 0.01
    """The merge is not believed below this p-value (the paper takes the 99th percentile)."""
    unlock: bool = True
    """
    Whether landmarks that moved or do not fit are taken out and the rest is merged without them.

    Without it the whole-map test of the paper refuses a merge in which something moved.
    """
    max_iterations: int = 200
    """
    Gauss-Newton steps; 5 to 12 are usual.

    Along a bent valley they creep: of 60 narrow rooms 9 needed more than 50, some of them 75, and
    one of 200 was 10 σ² above its optimum after 50.
    """
    max_starts: int = 12
    """
    Starts of the merge until the test accepts it; more than one only where a rotation between
    two sub-maps is weakly determined. Of 200 narrow rooms 194 needed one, none more than four.
    """
    convergence: float = 2e-3
    """
    Standard deviations from the optimum, of whatever follows from the landmarks, that are left.

    The relative offset of Bates & Watts (1981), who take 1e-3 for the mean of all parameters: here
    in the worst direction, which for 64 drones is fifty times stricter.
    """
    max_landmarks: int = 500
    """
    Landmarks that the outgoing map stays compressed to; R is quadratic in it (4.5 MB here).

    Those beyond are eliminated exactly and go on as catalogue.
    """
    max_bytes: int = 0
    """
    Largest map that goes out [byte]; fewer landmarks stay compressed to keep it; 0 = no limit.

    The catalogue goes along if it leaves half of the bytes to what can be merged.
    """
    catalogue: bool = True
    """Whether the outgoing map carries position and descriptor of all other landmarks."""
    match_descriptors: bool = True
    """Whether landmarks without a common id space are matched by descriptors and geometry."""
    ask: bool = True
    """Whether robots are asked to compress the landmarks that their partners have too."""
    request_landmarks: int = 300
    """Landmarks that one sub-map is asked for: R is quadratic in it (1.6 MB here)."""
    request_bytes: int = 0
    """Upper limit of the answer [byte], catalogue included; 0 = none."""
    request_coverage: float = 0.8
    """
    A robot is not asked again while what it has compressed serves each of its pairs to this share
    of what it could be.

    A standard deviation goes with one over the root of the number: 0.8 is 12 % of it, less than
    the next robot brings.
    """
    request_period: float = 10.0
    """
    Seconds of node time after which an unanswered request is repeated, then doubled.

    Compressing 300 landmarks of the largest real session takes a few seconds on a small computer.
    """

    def __post_init__(self) -> None:
        if not self.map_id:
            raise InvalidValue('map_id: empty')
        if not self.global_frame:
            raise InvalidValue('global_frame: empty')
        for name, low in _LOWEST.items():
            if getattr(self, name) < low:
                raise InvalidValue(f'{name}: {getattr(self, name)} is below {low}')
        for name in ('contradiction_ratio', 'contradiction_extent'):
            if not getattr(self, name) > 0.0:
                raise InvalidValue(f'{name}: {getattr(self, name)} is not positive')
        if not 0.0 < self.request_coverage <= 1.0:
            raise InvalidValue(f'request_coverage: {self.request_coverage} is not between 0 and 1')
        if not self.request_period > 0.0:
            raise InvalidValue(f'request_period: {self.request_period} is not positive')
        if not 0.0 < self.significance < 1.0:
            raise InvalidValue(f'significance: {self.significance} is not between 0 and 1')
        if not 0.0 < self.convergence <= 0.01:
            raise InvalidValue(f'convergence: {self.convergence} is not between 0 and 0.01')
