# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Merges that are exactly linear and exactly Gaussian, with what is true about them."""

from __future__ import annotations

import numpy as np
import scipy.linalg

from mapmerge_ros.fusion.quadratic import Members, Quadratic
from mapmerge_ros.geometry import Gauge, gauge_basis, generators


def scene(rng, maps=4, landmarks=60, views=(2, 4), gauge=Gauge.SIMILARITY):
    """Points, members by sub-map, and the information of each sub-map's shape."""
    points = rng.uniform([-30.0, -20.0, -2.0], [30.0, 20.0, 2.0], (landmarks, 3))
    counts = rng.integers(views[0], views[1] + 1, landmarks)
    owners = np.array([rng.permutation(maps) for _ in range(landmarks)])
    held = [
        np.flatnonzero([k in own[:count] for own, count in zip(owners, counts, strict=True)])
        for k in range(maps)
    ]
    members = Members(
        np.repeat(np.arange(maps), [len(own) for own in held]),
        np.concatenate([np.arange(len(own)) for own in held]),
        np.concatenate(held),
    )
    return points, members, [information(rng, points[own], gauge) for own in held]


def information(rng, points, gauge):
    """Random, with landmarks of different quality, and blind to the frames of the gauge."""
    size = points.size
    root = rng.normal(size=(2 * size, size)) / np.sqrt(size)
    root *= np.repeat(rng.uniform(3.0, 30.0, len(points)), 3)
    if gauge is not Gauge.NONE:
        basis = np.linalg.qr(generators(points, gauge).reshape(size, -1))[0]
        root -= root @ basis @ basis.T
    return root.T @ root


def covariance(points, matrix, gauge):
    """Of the shape that the information is about."""
    if gauge is Gauge.NONE:
        return np.linalg.inv(matrix)
    basis = np.linalg.qr(generators(points, gauge).reshape(points.size, -1))[0]
    weight = np.diag(matrix).mean()
    return np.linalg.inv(matrix + weight * basis @ basis.T) - basis @ basis.T / weight


def merged(points, members, matrices, errors, gauge=Gauge.SIMILARITY):
    """Linear merge of sub-maps whose landmarks are off by `errors` (s, 3): exact optimum."""
    size, maps = points.size, len(matrices)
    hessian, right = np.zeros((size, size)), np.zeros(size)
    parts = [members.of_map(k) for k in range(maps)]
    at = [(3 * members.tracks[part][:, None] + np.arange(3)).ravel() for part in parts]
    for matrix, part, rows in zip(matrices, parts, at, strict=True):
        hessian[np.ix_(rows, rows)] += matrix
        right[rows] += matrix @ errors[part].ravel()
    null = gauge_basis(points, gauge)
    shift = scipy.linalg.solve(hessian + np.diag(hessian).mean() * null @ null.T, right)
    gradients, price = [], 0.0
    for matrix, part, rows in zip(matrices, parts, at, strict=True):
        residual = shift[rows] - errors[part].ravel()
        gradients.append((matrix @ residual).reshape(-1, 3))
        price += float(residual @ matrix @ residual)
    return Quadratic(
        members,
        tuple(matrices),
        np.concatenate(gradients),
        points,
        (gauge,) * maps,
        gauge,
        price,
    )


def noise(rng, points, members, matrices, gauge=Gauge.SIMILARITY):
    """Errors (s, 3) as the information of each sub-map says."""
    errors = np.zeros((len(members), 3))
    for k, matrix in enumerate(matrices):
        part = members.of_map(k)
        own = covariance(points[members.tracks[part]], matrix, gauge)
        values, vectors = np.linalg.eigh(own)
        white = rng.normal(size=len(own)) * np.sqrt(np.maximum(values, 0.0))
        errors[part] = (vectors @ white).reshape(-1, 3)
    return errors


def draw(seed, **settings):
    """One merge under the null hypothesis."""
    rng = np.random.default_rng(seed)
    points, members, matrices = scene(rng, **settings)
    gauge = settings.get('gauge', Gauge.SIMILARITY)
    errors = noise(rng, points, members, matrices, gauge)
    return merged(points, members, matrices, errors, gauge)
