# SPDX-License-Identifier: Apache-2.0
"""The pose that several kinds of evidence ask for, near one that is expected."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.se3 import Transform, rotation_matrix, rotation_vector

STEPS = 6
"""Steps of least squares in each stage."""
HOLDS = 1.0
"""Information, by that of what is expected, below which a direction is not held."""

Equations = Callable[[Transform], tuple[NDArray[np.float64], NDArray[np.float64]]]
"""Normal equations at a pose: information (6, 6) and gradient (6,) of a small motion, a rotation about the camera in
radians, then a shift in metres, along the map's axes."""


class Stage(NamedTuple):
    """One stage of least squares, from coarse to fine: its equations, and the step (metres, radians) that ends it."""

    equations: Equations
    converged: float


class Fit(NamedTuple):
    """How an image fits what was seen before.

    T_map_camera: the pose (4, 4). covariance: (6, 6), rotation about the camera (radians), then shift (metres), along
    the map's axes. known: share of the image's parts that were seen before. usual: share of those that fit.
    """

    T_map_camera: Transform
    covariance: NDArray[np.float64]
    known: float
    usual: float


class Limits(NamedTuple):
    """How a kind of evidence is used.

    spread: (6,) radians and metres by which a camera may leave its even motion from one image to the next. unsure: the
    standard deviations, radians and metres, beyond which a pose is not believed; adrift: up to which it is followed.
    """

    spread: NDArray[np.float64]
    unsure: tuple[float, float]
    adrift: tuple[float, float]


def settled(
    stages: Sequence[Stage], expected: Transform, doubt: NDArray[np.float64], start: Transform | None = None
) -> tuple[Transform, NDArray[np.float64]]:
    """Return the pose (4, 4) that the stages lead to, and its covariance (6, 6) by the last one.

    Directions that nothing holds stay as expected. doubt: (6, 6) covariance of the expectation. start: where to begin
    if not there.
    """
    covariance = doubt
    T, scale = expected if start is None else start, np.asarray(np.linalg.cholesky(doubt), np.float64)
    for stage in stages:
        for _ in range(STEPS):
            information, gradient = stage.equations(T)
            held, directions = _held(information, scale)
            off = np.concatenate([rotation_vector(T[:3, :3] @ expected[:3, :3].T), T[:3, 3] - expected[:3, 3]])
            asked = np.where(held > 0, directions.T @ gradient, 0.0) - np.linalg.solve(directions, off)
            covariance = (directions / (held + 1.0)) @ directions.T
            motion = directions @ (asked / (held + 1.0))
            T = _moved(T, motion)
            if np.abs(motion).max() < stage.converged:
                break
    return T, covariance


def _held(
    information: NDArray[np.float64], scale: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return what holds each direction of motion (6,), 0: nothing, and the directions (6, 6), columns.

    scale: (6, 6), times its transpose the covariance of what is expected; a direction is one deviation long.
    """
    held, directions = np.linalg.eigh(scale.T @ information @ scale)
    return np.where(held > HOLDS, held, 0.0), scale @ directions


def _moved(T: Transform, motion: NDArray[np.float64]) -> Transform:
    moved = np.eye(4)
    moved[:3, :3] = rotation_matrix(motion[:3]) @ T[:3, :3]
    moved[:3, 3] = T[:3, 3] + motion[3:]
    return moved
