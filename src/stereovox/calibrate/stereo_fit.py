# SPDX-License-Identifier: Apache-2.0
"""Both lenses, the right eye's pose and the boards' poses from corners in images, by least squares in pixels.

Residuals are in pixels; only `Lens.project` is used of a lens, so both models are fitted alike.
Rotations are vectors, axis times angle. Parameters of a lens: fx, fy, cx, cy, then its distortion.

Not cv2.stereoCalibrate: it is as good on clean corners and faster, but has no robust loss. With 2 % of the corners off
by 5 px its error of the right eye is 1.4 mm and 0.33 deg (fisheye 0.8 mm, 0.09 deg), here 0.23 mm and 0.05 deg (0.23
mm, 0.03 deg); cv2.fisheye.stereoCalibrate fails for 1 pair of lenses in 12, this for none
(`benchmarks/calibrate_stereo.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.rigs import Eyes
from stereovox.cameras.wide import Lens
from stereovox.errors import StereovoxError
from stereovox.geometry.se3 import Transform, inverse, rotation_matrix, rotation_vector, transform_points

FULL_MODEL_VIEWS = 10
"""Fewest views to fit a fifth Brown-Conrady coefficient; with fewer it only follows noise."""
GUESSES = {"pinhole": np.geomspace(0.4, 4.0, 14), "fisheye": np.geomspace(0.25, 1.5, 14)}
"""Initial focal lengths tried, in image widths."""
UNSEEN_PX = 1e3
"""Residual in pixels of a corner that the lens cannot see; it steers away from such lenses."""
STEP = 1e-6
MAX_STEPS, MIN_GAIN = 60, 1e-6
"""The search ends after this many steps, or when one improves the cost by a smaller share."""
Vector = NDArray[np.float64]
Missed = Callable[[Vector, Vector], Vector]
Corners = Sequence[NDArray[np.float64]]
"""(N, 2) pixels for each view."""


@dataclass(frozen=True, eq=False)
class Fit:
    """The result: both lenses, the right eye's pose, and T_left_board (4, 4) of each view."""

    eyes: Eyes
    T_left_board: list[Transform]


def fit_stereo(model: str, size: tuple[int, int], board: NDArray[np.float64], left: Corners, right: Corners) -> Fit:
    """Return lenses of `model` and their poses from the corners of one board in each view.

    size: width and height of the images. board: (N, 3) metres. Raises StereovoxError if nothing fits.
    """
    lens_left, T_left = fit_lens(model, size, board, left)
    lens_right, T_right = fit_lens(model, size, board, right)
    moves = [a @ inverse(b) for a, b in zip(T_left, T_right, strict=True)]
    T_left_right = _motion(np.median([_vector(T) for T in moves], axis=0))
    return refined(lens_left, lens_right, T_left_right, T_left, board, left, right)


def refined(
    lens_left: Lens,
    lens_right: Lens,
    T_left_right: Transform,
    T_left_board: Sequence[Transform],
    board: NDArray[np.float64],
    left: Corners,
    right: Corners,
) -> Fit:
    """Return the best fit to all corners of both eyes at once, starting from the given values."""
    count = len(_numbers(lens_left))

    def parts(shared: Vector) -> tuple[Lens, Lens, Transform]:
        a, b = _lens(lens_left, shared[:count]), _lens(lens_right, shared[count : 2 * count])
        return a, b, _motion(shared[2 * count :])

    def missed(shared: Vector, places: Vector) -> Vector:
        a, b, T_left_right = parts(shared)
        boards = [_motion(place) for place in places]
        theirs = [inverse(T_left_right) @ T for T in boards]
        return np.concatenate([missed_pixels(a, boards, board, left), missed_pixels(b, theirs, board, right)], axis=1)

    start = np.concatenate([_numbers(lens_left), _numbers(lens_right), _vector(T_left_right)])
    shared, places = _least_squares(missed, start, np.array([_vector(T) for T in T_left_board]))
    a, b, T_left_right = parts(shared)
    return Fit(Eyes(a, b, T_left_right), [_motion(place) for place in places])


def fit_lens(
    model: str, size: tuple[int, int], board: NDArray[np.float64], corners: Corners
) -> tuple[Lens, list[Transform]]:
    """Return the lens and T_camera_board of each view, from one eye's images alone."""
    start, T = _guess(model, size, board, corners)

    def missed(shared: Vector, places: Vector) -> Vector:
        return missed_pixels(_lens(start, shared), [_motion(place) for place in places], board, corners)

    shared, places = _least_squares(missed, _numbers(start), np.array([_vector(one) for one in T]))
    return _lens(start, shared), [_motion(place) for place in places]


def _guess(
    model: str, size: tuple[int, int], board: NDArray[np.float64], corners: Corners
) -> tuple[Lens, list[Transform]]:
    """Return the best undistorted lens of all focal lengths tried, with the boards' poses."""
    best, found = np.inf, None
    count = 4 if model == "fisheye" or len(corners) < FULL_MODEL_VIEWS else 5
    for share in GUESSES[model]:
        focal = share * size[0]
        lens = Lens(model, *size, focal, focal, (size[0] - 1) / 2, (size[1] - 1) / 2, (0.0,) * count)
        T = [_place(lens, board, pixels) for pixels in corners]
        missed = np.median(np.abs(missed_pixels(lens, T, board, corners)))
        if missed < best:
            best, found = missed, (lens, T)
    if found is None:
        raise StereovoxError(f"no {model} lens fits the corners at all; check --board and --lens")
    return found


def _place(lens: Lens, board: NDArray[np.float64], pixels: NDArray[np.float64]) -> Transform:
    """Return the approximate pose of the board (Zhang's homography between the board and the rays' slopes)."""
    import cv2

    rays = lens.directions(pixels)
    ahead = rays[:, 2] > 0.05
    T = np.eye(4)
    T[2, 3] = 1.0
    if ahead.sum() < 6:
        return T
    slopes = np.ascontiguousarray(rays[ahead, None, :2] / rays[ahead, None, 2:])
    done, turn, place = cv2.solvePnP(board[ahead], slopes, np.eye(3), np.zeros(4), flags=cv2.SOLVEPNP_IPPE)
    if done:
        T[:3, :3], T[:3, 3] = rotation_matrix(np.ravel(turn)), np.ravel(place)
    return T


def missed_pixels(lens: Lens, T: Sequence[Transform], board: NDArray[np.float64], corners: Corners) -> Vector:
    """Return (views, 2 N) pixels by which each corner is missed."""
    seen = lens.project(np.concatenate([transform_points(one, board) for one in T]))
    missed = (seen - np.concatenate(list(corners))).reshape(len(T), -1)
    return np.where(np.isfinite(missed), missed, UNSEEN_PX)


def _least_squares(missed: Missed, shared: Vector, places: Vector) -> tuple[Vector, Vector]:
    """Return the `shared` numbers and the (views, 6) `places` that minimise `missed` (views, residuals).

    Levenberg-Marquardt steps. Residuals far above a pixel count linearly, not squared, so that an outlier view does not
    bend the others.
    """
    damping, residuals = 1e-3, missed(shared, places)
    for _ in range(MAX_STEPS):
        J, r = _rates(missed, shared, places, residuals), residuals.ravel()
        weighted = J * (1 / np.sqrt(1 + r * r))[:, None]
        A, g = weighted.T @ J, weighted.T @ r
        before, after = _cost(residuals), np.inf
        while damping < 1e9:
            step = np.linalg.solve(A + np.diag(damping * np.diag(A) + 1e-12), -g)
            tried = shared + step[: len(shared)], places + step[len(shared) :].reshape(places.shape)
            there = missed(*tried)
            after = _cost(there)
            if after < before:
                (shared, places), residuals, damping = tried, there, max(damping / 5, 1e-9)
                break
            damping *= 4
        if not after < before * (1 - MIN_GAIN):
            break
    return shared, places


def _rates(missed: Missed, shared: Vector, places: Vector, here: Vector) -> Vector:
    """Return the (views * residuals, parameters) derivatives by differences.

    A view's residuals depend only on its own pose, so one step of all poses at once gives a column of each.
    """
    count, views = len(shared), len(places)
    J = np.zeros((*here.shape, count + 6 * views))
    for k in range(count):
        step = STEP * max(1.0, abs(shared[k]))
        J[:, :, k] = (missed(shared + step * (np.arange(count) == k), places) - here) / step
    for k in range(6):
        change = (missed(shared, places + STEP * (np.arange(6) == k)) - here) / STEP
        for view in range(views):
            J[view, :, count + 6 * view + k] = change[view]
    return J.reshape(-1, count + 6 * views)


def _cost(residuals: Vector) -> float:
    return float((np.sqrt(1 + residuals**2) - 1).sum())


def _numbers(lens: Lens) -> Vector:
    return np.array([lens.fx, lens.fy, lens.cx, lens.cy, *lens.distortion])


def _lens(like: Lens, numbers: Vector) -> Lens:
    fx, fy, cx, cy, *distortion = map(float, numbers)
    return replace(like, fx=max(fx, 1.0), fy=max(fy, 1.0), cx=cx, cy=cy, distortion=tuple(distortion))


def _vector(T: Transform) -> Vector:
    return np.concatenate([rotation_vector(T[:3, :3]), T[:3, 3]])


def _motion(vector: Vector) -> Transform:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_matrix(vector[:3]), vector[3:]
    return T
