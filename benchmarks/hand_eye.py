# SPDX-License-Identifier: Apache-2.0
"""Accuracy of `hand_eye` against OpenCV's calibrateHandEye, on simulated motions.

OpenCV 5 has no calibrateHandEye: this needs `opencv-python-headless<5`. It takes poses, not motions between images as
registration gives them, so it gets the accumulated motions, with their drift.

python benchmarks/hand_eye.py [SEEDS]
"""

from __future__ import annotations

import sys

import cv2
import numpy as np
from numpy.typing import NDArray

from stereovox.calibrate.pair import hand_eye
from stereovox.geometry.se3 import inverse, rotation_matrix, rotation_vector

METHODS = ("TSAI", "PARK", "HORAUD", "ANDREFF", "DANIILIDIS")
IMAGES = 60
CASES = {
    "0.1 deg, 3 mm": (0.1, 0.003, 0.0),
    "0.5 deg, 10 mm": (0.5, 0.010, 0.0),
    "0.1 deg, 3 mm, 5 % of motions wrong": (0.1, 0.003, 0.05),
}
Transforms = NDArray[np.float64]


def motion(rng: np.random.Generator, turn: float, metres: float) -> Transforms:
    """A motion whose rotation vector and translation have these standard deviations along each axis."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_matrix(turn * rng.normal(size=3)), metres * rng.normal(size=3)
    return T


def recording(rng: np.random.Generator, case: tuple[float, float, float]) -> tuple[Transforms, Transforms, Transforms]:
    """X, and the motions of tracker and camera from each image to the next, (N, 4, 4)."""
    degrees, metres, wrong = case
    X = motion(rng, 0.3, 0.1)
    A = np.array([motion(rng, 0.15, 0.1) for _ in range(IMAGES)])
    B = np.array([inverse(X) @ T @ X @ motion(rng, np.radians(degrees), metres) for T in A])
    for k in np.flatnonzero(rng.random(IMAGES) < wrong):
        B[k] = B[k] @ motion(rng, 0.1, 0.1)
    return X, A, B


def opencv(method: str, A: Transforms, B: Transforms) -> Transforms:
    """`hand_eye` by OpenCV, whose tracker is a gripper and whose world, seen from the camera, is a target."""
    tracker, camera = (np.array([np.eye(4), *accumulated(T)]) for T in (A, B))
    seen = np.linalg.inv(camera)
    R, t = cv2.calibrateHandEye(
        list(tracker[:, :3, :3]),
        list(tracker[:, :3, 3]),
        list(seen[:, :3, :3]),
        list(seen[:, :3, 3]),
        method=getattr(cv2, f"CALIB_HAND_EYE_{method}"),
    )
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = R, np.ravel(t)
    return X


def accumulated(T: Transforms) -> list[Transforms]:
    poses = [T[0]]
    for one in T[1:]:
        poses.append(poses[-1] @ one)
    return poses


def main(seeds: int = 40) -> None:
    if not hasattr(cv2, "calibrateHandEye"):
        raise SystemExit("OpenCV 5 has no calibrateHandEye; run: pip install 'opencv-python-headless<5'")
    print("median (worst): degrees, mm")
    for name, case in CASES.items():
        for who in ("ours", *METHODS):
            errors = []
            for seed in range(seeds):
                X, A, B = recording(np.random.default_rng(seed), case)
                wrong = inverse(X) @ (hand_eye(A, B) if who == "ours" else opencv(who, A, B))
                turn, place = rotation_vector(wrong[:3, :3]), wrong[:3, 3]
                errors.append((np.degrees(np.linalg.norm(turn)), 1e3 * np.linalg.norm(place)))
            text = ", ".join(f"{m:.2f} ({w:.2f})" for m, w in zip(np.median(errors, 0), np.max(errors, 0), strict=True))
            print(f"{name:38}{who:12}{text}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
