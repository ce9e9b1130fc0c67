# SPDX-License-Identifier: Apache-2.0
"""Accuracy of `stereovox calibrate stereo` against OpenCV's stereoCalibrate, on simulated chessboards.

Both get the same corners and drop pairs that do not fit by the same rule. Cameras, boards and noise differ with each
seed. OpenCV's fisheye is started from each focal length that `fit_stereo` tries, and the best result counts.
Errors: rows of fresh boards after rectification, where the estimated lens sees them, and the right eye's pose.

python benchmarks/calibrate_stereo.py [SEEDS]
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from time import perf_counter
from unittest import mock

import cv2
import numpy as np

from stereovox.calibrate import stereo
from stereovox.calibrate.stereo import Board, BoardPair, calibrate_stereo, epipolar_errors
from stereovox.calibrate.stereo_fit import FULL_MODEL_VIEWS, GUESSES, Corners, Fit, fit_stereo
from stereovox.cameras.rigs import Eyes
from stereovox.cameras.wide import Lens
from stereovox.errors import StereovoxError
from stereovox.geometry.se3 import Transform, inverse, rotation_matrix, rotation_vector, transform_points

BOARD = Board(9, 6, 0.03)
SIZE = (640, 480)
CASES = {
    "0.1 px": {"noise": 0.1},
    "0.5 px": {"noise": 0.5},
    "0.1 px, 4 views": {"noise": 0.1, "views": 4},
    "2 % of corners off by 5 px": {"noise": 0.1, "wrong_corners": 0.02},
    "one pair whose board moved": {"noise": 0.1, "moved": 1},
}
FLAGS = {
    name: getattr(cv2.fisheye, name, None) or getattr(cv2, name)  # OpenCV 4 has them in `fisheye`, OpenCV 5 has not
    for name in ("CALIB_FIX_SKEW", "CALIB_RECOMPUTE_EXTRINSIC", "CALIB_USE_INTRINSIC_GUESS")
}
UNTIL = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 200, 1e-9)
Found = tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray], np.ndarray, np.ndarray, list[Transform]]
"""Camera matrix and distortion of both eyes, R and t of the right one in OpenCV's convention, and T_left_board."""


def eyes_of(model: str, rng: np.random.Generator) -> Eyes:
    """Two lenses of one make and their poses."""

    def lens() -> Lens:
        cx, cy = np.array(SIZE) / 2 + rng.uniform(-12, 12, 2)
        if model == "pinhole":
            focal = rng.uniform(0.6, 1.2) * SIZE[0]
            distortion = (rng.uniform(-0.3, 0.1), rng.uniform(0, 0.08), *rng.uniform(-1e-3, 1e-3, 2))
        else:
            focal = rng.uniform(0.32, 0.5) * SIZE[0]
            distortion = (rng.uniform(-0.04, 0.02), *rng.uniform(-0.01, 0.01, 2), rng.uniform(-0.002, 0.002))
        return Lens(model, *SIZE, focal, focal * rng.uniform(0.995, 1.005), cx, cy, distortion)

    left = lens()
    right = Lens(
        model, *SIZE, left.fx * 1.01, left.fy * 1.01, *(np.array(SIZE) / 2 + rng.uniform(-12, 12, 2)), left.distortion
    )
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = (
        rotation_matrix(rng.uniform(-0.04, 0.04, 3)),
        (rng.uniform(0.06, 0.2), *rng.uniform(-0.004, 0.004, 2)),
    )
    return Eyes(left, right, T)


def boards_of(eyes: Eyes, count: int, rng: np.random.Generator) -> list[Transform]:
    """T_left_board of boards held anywhere in both images, tilted by up to 40 degrees."""
    made: list[Transform] = []
    middle = 0.5 * BOARD.square * np.array([BOARD.columns - 1, BOARD.rows - 1, 0])
    while len(made) < count:
        T = np.eye(4)
        T[:3, :3] = rotation_matrix([*rng.uniform(-0.7, 0.7, 2), rng.uniform(-0.5, 0.5)])
        ray = eyes.left.directions(rng.uniform([0, 0], SIZE)[None])[0]
        T[:3, 3] = rng.uniform(0.25, 1.0) * ray - T[:3, :3] @ middle
        if all(
            inside(lens, corners) for lens, corners in zip((eyes.left, eyes.right), corners_of(eyes, T), strict=True)
        ):
            made.append(T)
    return made


def corners_of(eyes: Eyes, T: Transform) -> tuple[np.ndarray, np.ndarray]:
    points = transform_points(T, BOARD.points())
    return eyes.left.project(points), eyes.right.project(transform_points(inverse(eyes.T_left_right), points))


def inside(lens: Lens, corners: np.ndarray) -> bool:
    return bool(((corners > 3) & (corners < np.array([lens.width, lens.height]) - 4)).all())


def pairs_of(
    eyes: Eyes, rng: np.random.Generator, noise: float, views: int = 12, wrong_corners: float = 0.0, moved: int = 0
) -> list[BoardPair]:
    """Corners as detected: noise in pixels, some corners far off, some boards moved between both images."""
    pairs = []
    for k, T in enumerate(boards_of(eyes, views, rng)):
        left, right = (seen + noise * rng.normal(size=seen.shape) for seen in corners_of(eyes, T))
        for corners in (left, right):
            wrong = rng.random(len(corners)) < wrong_corners
            corners[wrong] += 5 * rng.normal(size=(wrong.sum(), 2))
        if k < moved:
            right = right + np.linspace(0, 6, len(right))[:, None]
        pairs.append(BoardPair(str(k), Path("l"), Path("r"), left, right, SIZE))
    return pairs


def opencv(model: str, size: tuple[int, int], board: np.ndarray, left: Corners, right: Corners) -> Fit:
    """`fit_stereo` by OpenCV: each lens alone, then both together."""
    fit = _fisheyes if model == "fisheye" else _pinholes
    (K_left, d_left), (K_right, d_right), R, t, T_left_board = fit(size, board, left, right)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, np.ravel(t)
    return Fit(Eyes(_lens(model, size, K_left, d_left), _lens(model, size, K_right, d_right), inverse(T)), T_left_board)


def _pinholes(size: tuple[int, int], board: np.ndarray, left: Corners, right: Corners) -> Found:
    count, flags = (4, cv2.CALIB_FIX_K3) if len(left) < FULL_MODEL_VIEWS else (5, 0)
    points = [board.astype(np.float32)] * len(left)
    a, b = ([corners.astype(np.float32) for corners in many] for many in (left, right))
    (K1, d1), (K2, d2) = (
        cv2.calibrateCamera(points, of, size, None, None, flags=flags, criteria=UNTIL)[1:3] for of in (a, b)
    )
    flags |= cv2.CALIB_USE_INTRINSIC_GUESS
    found = cv2.stereoCalibrate(points, a, b, K1, d1, K2, d2, size, flags=flags, criteria=UNTIL)
    _, K1, d1, K2, d2, R, t = found[:7]
    slopes = [cv2.undistortPoints(np.asarray(of, float)[:, None], K1, d1) for of in left]
    return (K1, np.ravel(d1)[:count]), (K2, np.ravel(d2)[:count]), R, t, [_solved(board, of) for of in slopes]


def _fisheyes(size: tuple[int, int], board: np.ndarray, left: Corners, right: Corners) -> Found:
    """Start where OpenCV would and at the focal lengths that `fit_stereo` tries: its own start is often too far off."""
    flags = FLAGS["CALIB_FIX_SKEW"] | FLAGS["CALIB_RECOMPUTE_EXTRINSIC"]
    points = [board[None]] * len(left)
    a, b = ([corners[None].astype(float) for corners in many] for many in (left, right))

    def alone(corners: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        tried = []
        for focal in (0.0, *(GUESSES["fisheye"] * size[0])):
            K = np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]])
            guess = FLAGS["CALIB_USE_INTRINSIC_GUESS"] if focal else 0
            with suppress(cv2.error):
                tried.append(
                    cv2.fisheye.calibrate(points, corners, size, K, np.zeros(4), flags=flags | guess, criteria=UNTIL)
                )
        if not tried:
            raise StereovoxError("OpenCV's fisheye calibration fails from each focal length")
        return min(tried, key=lambda found: found[0])[1:3]

    (K1, d1), (K2, d2) = alone(a), alone(b)
    flags |= FLAGS["CALIB_USE_INTRINSIC_GUESS"]
    found = cv2.fisheye.stereoCalibrate(points, a, b, K1, d1, K2, d2, size, flags=flags, criteria=UNTIL)
    _, K1, d1, K2, d2, R, t = found[:7]
    slopes = [cv2.fisheye.undistortPoints(np.asarray(of, float)[:, None], K1, d1) for of in left]
    return (K1, np.ravel(d1)), (K2, np.ravel(d2)), R, t, [_solved(board, of) for of in slopes]


def _solved(board: np.ndarray, slopes: np.ndarray) -> Transform:
    slopes = np.ascontiguousarray(slopes)
    _, turn, place = cv2.solvePnP(board, slopes, np.eye(3), np.zeros(4), flags=cv2.SOLVEPNP_IPPE)
    _, turn, place = cv2.solvePnP(board, slopes, np.eye(3), np.zeros(4), turn, place, True)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_matrix(np.ravel(turn)), np.ravel(place)
    return T


def _lens(model: str, size: tuple[int, int], K: np.ndarray, distortion: np.ndarray) -> Lens:
    return Lens(model, *size, K[0, 0], K[1, 1], K[0, 2], K[1, 2], tuple(map(float, distortion)))


def errors(found: Eyes, true: Eyes, rng: np.random.Generator) -> list[float]:
    """Return the RMS row difference on fresh boards (px), and the right eye's position (mm) and turn (deg)."""
    fresh = [corners_of(true, T) for T in boards_of(true, 40, rng)]
    rows = np.concatenate([epipolar_errors(found, left, right) for left, right in fresh])
    T = inverse(true.T_left_right) @ found.T_left_right
    turn = np.degrees(np.linalg.norm(rotation_vector(T[:3, :3])))
    return [float(np.sqrt(np.nanmean(rows**2))), 1e3 * float(np.linalg.norm(T[:3, 3])), float(turn)]


def tried(fit: Callable[..., Fit], model: str, case: dict[str, float], seed: int) -> tuple[list[float] | None, float]:
    """Return the errors, None if it failed, and the seconds taken."""
    rng = np.random.default_rng(seed)
    true = eyes_of(model, rng)
    pairs = pairs_of(true, rng, **case)
    start = perf_counter()
    with mock.patch.object(stereo, "fit_stereo", fit), mock.patch.object(stereo, "_predict"):
        try:
            found = calibrate_stereo(pairs, BOARD, model)
        except (StereovoxError, cv2.error):
            return None, perf_counter() - start
    return errors(found.eyes, true, np.random.default_rng(seed + 10_000)), perf_counter() - start


def main(seeds: int = 12) -> None:
    print("median (worst) of each seed: rows px, right eye mm, deg; failures; seconds")
    for model in ("pinhole", "fisheye"):
        for name, case in CASES.items():
            for who, fit in (("ours", fit_stereo), ("OpenCV", opencv)):
                runs = [tried(fit, model, case, seed) for seed in range(100, 100 + seeds)]
                good = np.array([found for found, _ in runs if found is not None] or [[np.nan] * 3])
                text = ", ".join(f"{m:.3f} ({w:.3f})" for m, w in zip(np.median(good, 0), good.max(0), strict=True))
                failed, seconds = sum(found is None for found, _ in runs), np.median([s for _, s in runs])
                print(f"{model:8}{name:28}{who:7}{text}; {failed} of {seeds}; {seconds:.2f} s", flush=True)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
