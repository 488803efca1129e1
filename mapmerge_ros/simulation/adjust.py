# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment of simulated sessions: Ceres through pycolmap, on `linearise`'s residual."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mapmerge_ros.arrays import Ints
from mapmerge_ros.bundle import Bundle
from mapmerge_ros.errors import InvalidValue, MapMergeError
from mapmerge_ros.simulation.frames import anchored

MAX_ITERATIONS = 100
"""Simulated sessions start near the truth and need 5 to 20; more means that they diverge."""

FUNCTION_TOLERANCE = 1e-14
"""
Relative decrease of the cost at which the solver stops.

Two steps before, the gradient already is below 1e-4 sigma; the next change of the cost would
drown in rounding.
"""

GRADIENT_TOLERANCE = 1e-10
"""Largest gradient entry [px² / parameter] at which it stops: for data without noise."""


class AdjustmentError(MapMergeError):
    """The bundle cannot be adjusted; the message says what to do."""


class BehindCamera(AdjustmentError):
    """A point ended behind a camera that observes it: its track is too weak."""


@dataclass(frozen=True, slots=True, eq=False)
class Adjustment:
    """An adjusted bundle with its evidence."""

    bundle: Bundle
    iterations: int
    """Steps that were taken."""
    converged: bool
    """False: stopped by the limit on iterations."""
    cost_px2: float
    """r'r"""


def adjust(bundle: Bundle, *, max_iterations: int = MAX_ITERATIONS) -> Bundle:
    """Return the bundle at its optimum: see `solve`."""
    return solve(bundle, max_iterations=max_iterations).bundle


def solve(
    bundle: Bundle,
    *,
    max_iterations: int = MAX_ITERATIONS,
    function_tolerance: float = FUNCTION_TOLERANCE,
    gradient_tolerance: float = GRADIENT_TOLERANCE,
    trust_radius: float | None = None,
    linear_solver: str = '',
    max_seconds: float = 1e9,
    progress: bool = False,
) -> Adjustment:
    """
    Minimise the reprojection error over all poses and points; the intrinsics stay.

    The frame is free during the iterations and then put back to where the key frames were: mean
    position, mean heading and extent of the poses do not change. So a metric map keeps its scale
    and a gravity-aligned one its vertical, and the rows of the frame prior stay at zero.

    With `trust_radius` the trust region is held at that size and does not grow. `linear_solver`
    is one of Ceres by name (SPARSE_SCHUR, …); COLMAP chooses by the number of images if it is
    empty. With `progress` Ceres writes its table of steps to the standard output.

    Raises
    ------
    AdjustmentError
        pycolmap is not installed, or the solver failed.
    BehindCamera
        A point without parallax has its optimum behind a camera that observes it.

    """
    colmap = _library()
    model = _to_colmap(bundle, colmap)
    options = _options(colmap, max_iterations, function_tolerance, gradient_tolerance)
    if trust_radius is not None:
        solver = options.ceres.solver_options
        solver.initial_trust_region_radius = solver.max_trust_region_radius = trust_radius
    options.ceres.solver_options.max_solver_time_in_seconds = max_seconds
    if progress:
        solver = options.ceres.solver_options
        solver.minimizer_progress_to_stdout = True
        solver.logging_type = type(solver.logging_type).PER_MINIMIZER_ITERATION
    if linear_solver:
        solver, options.ceres.auto_select_solver_type = options.ceres.solver_options, False
        solver.linear_solver_type = getattr(type(solver.linear_solver_type), linear_solver)
    config = colmap.BundleAdjustmentConfig()
    for row in range(len(bundle.keyframe_ids)):
        config.add_image(row + 1)
    adjuster = colmap.create_default_ceres_bundle_adjuster(options, config, model)
    summary = adjuster.solve().ceres_summary
    if not summary.IsSolutionUsable():
        raise AdjustmentError(f'bundle adjustment failed: {summary.message}')
    return Adjustment(
        bundle=anchored(_in_front(bundle, model), bundle),
        iterations=summary.num_successful_steps,
        converged=summary.termination_type.name == 'CONVERGENCE',
        cost_px2=2.0 * summary.final_cost,
    )


def _library() -> Any:
    try:
        import pycolmap
    except ImportError as err:
        raise AdjustmentError(
            'bundle adjustment needs pycolmap: pip install mapmerge_ros[colmap]'
        ) from err
    # A damped step that fails is tried again by Ceres; its warnings would drown the progress bar.
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
    return pycolmap


def _options(
    colmap: Any, max_iterations: int, function_tolerance: float, gradient_tolerance: float
) -> Any:
    options = colmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = False
    options.refine_principal_point = options.print_summary = False
    solver = options.ceres.solver_options
    solver.num_threads = 1  # sums in a fixed order: the same seed gives the same bits
    solver.max_num_iterations = max_iterations
    solver.function_tolerance = function_tolerance
    solver.gradient_tolerance = gradient_tolerance
    solver.parameter_tolerance = 0.0
    return options


def _to_colmap(bundle: Bundle, colmap: Any) -> Any:
    """Reconstruction in memory; ids are rows + 1."""
    model = colmap.Reconstruction()
    for row, params in enumerate(bundle.intrinsics):
        camera = colmap.Camera(
            camera_id=row + 1, model='PINHOLE', width=1, height=1, params=params.tolist()
        )
        model.add_camera_with_trivial_rig(camera)
    slots = np.empty(len(bundle.observation_points), np.int64)
    poses = np.concatenate(
        [bundle.rotations_camera_map, bundle.translations_camera_map[:, :, None]], axis=2
    )
    for row, seen in enumerate(_groups(bundle.observation_keyframes, len(poses))):
        slots[seen] = np.arange(len(seen))
        image = colmap.Image(
            name=str(row),
            keypoints=bundle.observations_px[seen],
            camera_id=int(bundle.keyframe_cameras[row]) + 1,
            image_id=row + 1,
        )
        model.add_image_with_trivial_frame(image, colmap.Rigid3d(poses[row]))
    images = bundle.observation_keyframes + 1
    for row, seen in enumerate(_groups(bundle.observation_points, len(bundle.points))):
        pairs = zip(images[seen].tolist(), slots[seen].tolist(), strict=True)
        track = colmap.Track([colmap.TrackElement(*pair) for pair in pairs])
        model.add_point3D(bundle.points[row], track)
    return model


def _in_front(bundle: Bundle, model: Any) -> Bundle:
    try:
        return _from_colmap(bundle, model)
    except InvalidValue as err:  # all else about the bundle is as it was
        raise BehindCamera(f'bundle adjustment: {err}') from err


def _from_colmap(bundle: Bundle, model: Any) -> Bundle:
    m, n = len(bundle.keyframe_ids), len(bundle.point_ids)
    poses = np.array([model.images[row + 1].cam_from_world().matrix() for row in range(m)])
    return replace(
        bundle,
        rotations_camera_map=poses[:, :, :3],
        translations_camera_map=poses[:, :, 3],
        points=np.array([model.points3D[row + 1].xyz for row in range(n)]),
    )


def _groups(rows: Ints, count: int) -> list[Ints]:
    """Positions of each row number 0..count-1 in `rows`."""
    order = np.argsort(rows, kind='stable')
    return np.split(order, np.searchsorted(rows[order], np.arange(1, count)))
