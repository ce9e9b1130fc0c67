# SPDX-License-Identifier: Apache-2.0
"""The pose that several kinds of evidence ask for, near one that is expected."""

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
"""Information, by that of what is expected, below which a direction is not held."""
RIGID = 0.01
"""Largest rigidity error of a pose, motion or place of a camera that is given."""

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
    """How an image fits what was seen before.

    T_map_camera: the pose (4, 4). covariance: (6, 6), rotation about the camera (radians), then shift (metres), along
    the map's axes. known: share of the image's parts that were seen before. usual: share of those that fit. fine: share
    of what is known roughly that is known closely too; a warped image fits in the large and not in the small.
    """

    T_map_camera: Transform
    covariance: NDArray[np.float64]
    known: float
    inlier_share: float
    fine: float = 1.0


class Limits(NamedTuple):
    """How a kind of evidence is used.

    spread: (6,) radians and metres by which a camera may leave its even motion from one image to the next. unsure: the
    standard deviations, radians and metres, beyond which a pose is not believed; adrift: up to which it is followed.
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
    """Return equations without the directions that they do not hold, to be added to others.

    There information that is less what noise feigns may be below 0: alone it holds nothing, and it must not take away
    what other evidence holds. doubt: as that of `solve_stages`.
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
    """Return the pose (4, 4) that the stages lead to, and its covariance (6, 6) by the last one.

    Directions that nothing holds stay as expected. The covariance is the widest of those that the last stage saw on its
    way. Where that stage contradicts the one before it, the pose is that of the one before, and open: its covariance is
    `doubt`.

    stages: each is asked for once those before it have settled. doubt: (6, 6) covariance of the expectation. start:
    where to begin if not there.
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
    """Return whether two poses are farther apart than errors of this covariance (6, 6) can be."""
    moved = motion_between(one, other)
    return bool(moved @ np.linalg.solve(covariance, moved) > CONTRARY)


def deviations(covariance: NDArray[np.float64]) -> tuple[float, float]:
    """Return the standard deviations of a pose along the directions that are held least: radians and metres."""
    turn, shift = (float(np.sqrt(np.linalg.eigvalsh(part)[-1])) for part in (covariance[:3, :3], covariance[3:, 3:]))
    return turn, shift


def motion_between(one: Transform, other: Transform) -> NDArray[np.float64]:
    """Return the motion (6,) from one pose to another: rotation in radians, shift in metres, along the map's axes."""
    return np.concatenate([rotation_vector(other[:3, :3] @ one[:3, :3].T), other[:3, 3] - one[:3, 3]])


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
