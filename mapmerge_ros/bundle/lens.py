# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
What is uncertain about a session's lenses: seven parameters of each camera, with a prior.

A calibration that is wrong by a tenth of a pixel bends a map smoothly, by many times what the
noise of its images explains. Compression eliminates these parameters like the poses, so that R
does not claim what the lens leaves open (Brown, "Close-range camera calibration", 1971).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mapmerge_ros.arrays import Floats, Ints, frozen
from mapmerge_ros.errors import InvalidValue

PARAMETERS = ('focal', 'k1', 'k2', 'cx', 'cy', 'p1', 'p2')
COUNT = len(PARAMETERS)


def _empty() -> Floats:
    return np.zeros((0, COUNT))


@dataclass(frozen=True, slots=True, eq=False)
class Lens:
    """
    Lenses that are known up to a prior; the default is none: calibrated cameras.

    A parameter is measured by the displacement that it causes, root mean square over the
    session's own observations, so that one prior in pixels suits all seven of any camera.
    """

    cameras: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    """(l,) rows of the bundle's intrinsics"""
    scales: Floats = field(default_factory=_empty)
    """(l, 7) parameter per px of that displacement"""
    moved_px: Floats = field(default_factory=_empty)
    """(l, 7) how far each has been moved away from the calibration"""
    weight: float = 0.0
    """σ / prior: residual [px] of the prior for each px moved"""

    def __post_init__(self) -> None:
        count = len(self.cameras)
        for name, dtype, shape in (
            ('cameras', np.int64, (count,)),
            ('scales', np.float64, (count, COUNT)),
            ('moved_px', np.float64, (count, COUNT)),
        ):
            object.__setattr__(
                self, name, frozen(f'lens: {name}', getattr(self, name), dtype, shape)
            )
        if len(np.unique(self.cameras)) != count:
            raise InvalidValue('lens: cameras: one appears twice')
        if not np.isfinite(self.weight) or (count and self.weight <= 0.0):
            raise InvalidValue(f'lens: weight: {self.weight} is not positive')

    @property
    def size(self) -> int:
        """Parameters of all lenses."""
        return self.moved_px.size

    @property
    def residuals_px(self) -> Floats:
        """Residuals (7 l,) of the prior."""
        return self.weight * self.moved_px.ravel()

    def slots(self, cameras: Ints) -> Ints:
        """Position of each of these cameras (o,) in `cameras`; -1 = calibrated."""
        found = np.full(int(max(cameras.max(), self.cameras.max(initial=0))) + 1, -1)
        found[self.cameras] = np.arange(len(self.cameras))
        slots: Ints = found[cameras]
        return slots

    def derivative(self, cameras: Ints, bearings: Floats, focal_px: Floats) -> Floats:
        """Displacement (o, 2, 7 l) of image points per px of each parameter."""
        by_lens = np.zeros((len(bearings), 2, len(self.cameras), COUNT))
        slots = self.slots(cameras)
        seen = np.flatnonzero(slots >= 0)
        by_lens[seen, :, slots[seen], :] = (
            displacements(bearings[seen], focal_px[seen]) * self.scales[slots[seen], None, :]
        )
        return by_lens.reshape(len(bearings), 2, -1)

    def slopes(self, cameras: Ints, bearings: Floats, focal_px: Floats) -> Floats:
        """What the moved lenses add to d(image point) / d(bearing), (o, 2, 2)."""
        slots = self.slots(cameras)
        parameters = np.vstack([self.scales * self.moved_px, np.zeros((1, COUNT))])[slots]
        return _slopes(bearings, parameters) * focal_px[:, :, None]


def displacements(bearings: Floats, focal_px: Floats) -> Floats:
    """Image displacement (o, 2, 7) [px] per unit of each parameter, at bearings x/z y/z (o, 2)."""
    x, y = bearings.T
    r2 = x**2 + y**2
    one, zero = np.ones_like(x), np.zeros_like(x)
    by_x = np.stack([x, r2 * x, r2**2 * x, one, zero, 2 * x * y, r2 + 2 * x**2], axis=1)
    by_y = np.stack([y, r2 * y, r2**2 * y, zero, one, r2 + 2 * y**2, 2 * x * y], axis=1)
    # The principal point is in pixels, all others are in focal lengths.
    units = np.repeat(focal_px[:, :, None], COUNT, axis=2)
    units[:, :, 3:5] = 1.0
    moved: Floats = np.stack([by_x, by_y], axis=1) * units
    return moved


def _slopes(bearings: Floats, parameters: Floats) -> Floats:
    """Derivative (o, 2, 2) of the displacement, in focal lengths, with respect to the bearing."""
    x, y = bearings.T
    focal, k1, k2, _, _, p1, p2 = parameters.T
    r2 = x**2 + y**2
    straight = focal + k1 * r2 + k2 * r2**2
    radial = 2.0 * k1 + 4.0 * k2 * r2
    across = radial * x * y + 2.0 * (p1 * x + p2 * y)
    slopes = np.empty((len(x), 2, 2))
    slopes[:, 0, 0] = straight + radial * x**2 + 2.0 * p1 * y + 6.0 * p2 * x
    slopes[:, 1, 1] = straight + radial * y**2 + 6.0 * p1 * y + 2.0 * p2 * x
    slopes[:, 0, 1] = slopes[:, 1, 0] = across
    return slopes
