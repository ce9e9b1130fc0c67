# SPDX-License-Identifier: Apache-2.0
"""Robust least squares for a pose near the expected one, from several kinds of evidence."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.geometry.se3 import Transform, rotation_matrix, rotation_vector

STEPS = 6
"""Steps of least squares in each stage."""
CONTRARY = 100.0
"""Squared deviations, of six, beyond which two poses contradict each other, such as those of two stages."""
HOLDS = 1.0
"""Information, relative to that of the expectation, below which a direction is unconstrained."""
RIGID = 0.01
"""Largest rigidity error of a given pose, motion or mount."""

LOST = "tracking_lost"
"""Reason of refusal of frames whose pose is not known."""

Equations = Callable[[Transform], tuple[NDArray[np.float64], NDArray[np.float64]]]
"""Normal equations at a pose: information (6, 6) and gradient (6,) of a small motion, a rotation about the camera in
radians, then a shift in metres, along the map's axes."""


class Stage(NamedTuple):
    """One stage of least squares, from coarse to fine: its equations, and the step (metres, radians) that ends it."""

    equations: Equations
    converged: float


class Fit(NamedTuple):
    """How an image fits the earlier ones.

    T_map_camera: the pose (4, 4). covariance: (6, 6), rotation about the camera (radians), then shift (metres), along
    the map's axes. known: share of the image's parts that were seen before. inlier_share: share of those that fit.
    fine: share of the roughly known parts that are closely known too; a warped image fits at large scale only.
    """

    T_map_camera: Transform
    covariance: NDArray[np.float64]
    known: float
    inlier_share: float
    fine: float = 1.0


class Limits(NamedTuple):
    """How a kind of evidence is used.

    spread: (6,) radians and metres by which a camera may leave constant velocity from one image to the next. unsure:
    the standard deviations, radians and metres, above which a pose is not accepted; adrift: above which it is lost.
    """

    spread: NDArray[np.float64]
    unsure: tuple[float, float]
    adrift: tuple[float, float]


def both(one: Equations, other: Equations) -> Equations:
    """Return the equations of two kinds of evidence together."""

    def together(T: Transform) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        (information, gradient), (more, pull) = one(T), other(T)
        return information + more, gradient + pull

    return together


def holding(equations: Equations, doubt: NDArray[np.float64]) -> Equations:
    """Return equations without their unconstrained directions, to be added to others.

    In such a direction, information minus the share that noise creates may be negative. It must not cancel the
    constraints of other evidence. doubt: as in `solve_stages`.
    """
    scale = np.asarray(np.linalg.cholesky(doubt), np.float64)

    def held(T: Transform) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        information, gradient = equations(T)
        much, directions = _held(information, scale)
        across = np.asarray(np.linalg.inv(directions), np.float64)  # its rows give a motion along the directions
        return across.T @ (much[:, None] * across), across.T @ np.where(much > 0, directions.T @ gradient, 0.0)

    return held


def solve_stages(
    stages: Iterable[Stage], expected: Transform, doubt: NDArray[np.float64], start: Transform | None = None
) -> tuple[Transform, NDArray[np.float64]]:
    """Return the pose (4, 4) that the stages converge to, and its covariance (6, 6) by the last one.

    Unconstrained directions stay as expected. The covariance is the widest that the last stage saw while converging.
    If the last stage contradicts the one before it, the earlier pose is returned, and its covariance is `doubt`: the
    pose is open.

    stages: each is requested once the earlier ones have converged. doubt: (6, 6) covariance of the expectation. start:
    the initial pose, if not `expected`.
    """
    scale = np.asarray(np.linalg.cholesky(doubt), np.float64)
    T, covariance = expected if start is None else start, doubt
    before, agreed, number = T, doubt, 0
    for stage in stages:
        before, agreed, number, widest = T, covariance, number + 1, 0.0
        for _ in range(STEPS):
            information, gradient = stage.equations(T)
            held, directions = _held(information, scale)
            if float(np.sum(1 / (held + 1.0))) > widest:
                widest = float(np.sum(1 / (held + 1.0)))
                covariance = (directions / (held + 1.0)) @ directions.T
            asked = np.where(held > 0, directions.T @ gradient, 0.0) - np.linalg.solve(
                directions, motion_between(expected, T)
            )
            motion = directions @ (asked / (held + 1.0))
            T = _moved(T, motion)
            if np.abs(motion).max() < stage.converged:
                break
    if number > 1 and contrary(before, T, agreed + covariance):
        return before, doubt
    return T, covariance


def contrary(one: Transform, other: Transform, covariance: NDArray[np.float64]) -> bool:
    """Return whether two poses are farther apart than errors of this covariance (6, 6) can explain."""
    moved = motion_between(one, other)
    return bool(moved @ np.linalg.solve(covariance, moved) > CONTRARY)


def deviations(covariance: NDArray[np.float64]) -> tuple[float, float]:
    """Return the standard deviations of a pose along its least constrained directions: radians and metres."""
    turn, shift = (float(np.sqrt(np.linalg.eigvalsh(part)[-1])) for part in (covariance[:3, :3], covariance[3:, 3:]))
    return turn, shift


def motion_between(one: Transform, other: Transform) -> NDArray[np.float64]:
    """Return the motion (6,) from one pose to another: rotation in radians, shift in metres, along the map's axes."""
    return np.concatenate([rotation_vector(other[:3, :3] @ one[:3, :3].T), other[:3, 3] - one[:3, 3]])


def _held(
    information: NDArray[np.float64], scale: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the information along each direction of motion (6,), 0 if none, and the directions (6, 6), columns.

    scale: (6, 6), a square root of the covariance of the expectation; each direction is one deviation long.
    """
    held, directions = np.linalg.eigh(scale.T @ information @ scale)
    return np.where(held > HOLDS, held, 0.0), scale @ directions


def _moved(T: Transform, motion: NDArray[np.float64]) -> Transform:
    moved = np.eye(4)
    moved[:3, :3] = rotation_matrix(motion[:3]) @ T[:3, :3]
    moved[:3, 3] = T[:3, 3] + motion[3:]
    return moved
