# SPDX-License-Identifier: Apache-2.0
"""Poses from a tracking camera (RealSense T265 and similar): other axes, a confidence, jumps, its own clock.

Axes. The map uses optical axes: x right, y down, z forward. A T265 reports OpenGL axes: x right, y up, z backward
(Chien 2020, section 4.1 and Fig 4.1). With C = diag(1, -1, -1) for its body and its world alike,
T_map_body = C T_file C. See docs/conventions.md for the picture.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import SourceError, did_you_mean
from stereovox.geometry.se3 import Transform
from stereovox.sources.poses.poses import Poses
from stereovox.sources.poses.trajectory import FORMAT, pose_lines, pose_numbers, transforms

AXES = {
    "optical": np.eye(3),
    "opengl": np.diag([1.0, -1.0, -1.0]),
    "ros": np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]),
    "ned": np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]),
}
"""Rotations from these axes into optical ones.

`ros`: x forward, y left, z up (REP 103); `ned`: x forward, y right, z down (aircraft, AirSim).
"""
WORLDS = ("up", "optical", "file")
"""Axes of the map: z up, x forward, y left; optical (Chien 2020); or the file's own."""
HIGHEST_CONFIDENCE = 3


def read_tracker(path: Path, axes: str = "opengl", world: str = "up") -> Poses:
    """Return the poses in a file of lines `stamp tx ty tz qx qy qz qw [confidence]`, in optical axes of the body.

    The confidence is 0 (failed), 1 (low), 2 (medium) or 3 (high); either every line has one or none. T_world_body maps
    the tracker's body, in optical axes, into `world` (see `WORLDS`); axes: the file's. Raises SourceError for
    unknown axes and if the file is unreadable or has no pose; a line with a stamp but no usable pose is kept (see
    `Poses`).
    """
    _check_word("axes", axes, AXES)
    _check_word("world", world, WORLDS)
    lines = pose_lines(path, FORMAT)
    trusted = any(len(rest.split()) == 8 for _, rest, _ in lines)
    wanted = f"{FORMAT} confidence" if trusted else FORMAT
    numbers, faults = pose_numbers(lines, 8 if trusted else 7, wanted)
    confidence = numbers[:, 7].copy() if trusted else None
    if confidence is not None:
        for k in np.flatnonzero((confidence < 0) | (confidence > HIGHEST_CONFIDENCE)):
            stamp_ns, _, where = lines[k]
            faults[stamp_ns] = f"{where}: confidence {confidence[k]:g} is not 0 to 3; correct or delete the line"
            numbers[k] = np.nan
    T = turned(transforms(numbers), axes, world)
    return Poses([stamp_ns for stamp_ns, _, _ in lines], T, confidence, where=str(path), faults=faults)


def turned(T_file: NDArray[np.float64], axes: str, world: str) -> NDArray[np.float64]:
    """Return (N, 4, 4) poses of a body in optical axes in `world`, from poses whose body and world have `axes`.

    Chien 2020, section 4.1: T_map_body = C T_file C^-1, where C turns `axes` into optical ones.
    """
    C = _motion(AXES[axes])
    worlds = {"optical": C, "up": _motion(AXES["ros"].T) @ C, "file": np.eye(4)}
    return worlds[world] @ T_file @ C.T


def on_clock(poses: Poses, offset_s: float, rate: float = 1.0) -> Poses:
    """Return the poses with the times of another clock: stamp + offset_s + (rate - 1) * (stamp - first stamp)."""
    since = poses.stamps_ns - poses.stamps_ns[0]
    stamps = poses.stamps_ns + round(offset_s * 1e9) + np.rint((rate - 1) * since).astype(np.int64)
    faults = {
        int(new): poses.faults[int(old)]
        for old, new in zip(poses.stamps_ns, stamps, strict=True)
        if int(old) in poses.faults
    }
    return Poses(stamps, poses.T_world_body, poses.confidence, where=poses.where, faults=faults)


def jumps(poses: Poses, max_speed_mps: float, max_turn_dps: float) -> NDArray[np.intp]:
    """Return the numbers (K, 2) of the poses before and after each jump, between which the tracker moved or turned too
    fast.

    Speeds are over at least 1 ms, so that jitter between two nearly equal stamps is no jump. Gaps count by
    their average speed. Unusable poses are skipped: a jump may span them.
    """
    usable = np.flatnonzero(np.isfinite(poses.T_world_body).all(axis=(1, 2)))
    T, stamps_ns = poses.T_world_body[usable], poses.stamps_ns[usable]
    seconds = np.maximum(np.diff(stamps_ns) / 1e9, 1e-3)
    steps = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1)
    turns = angles(np.swapaxes(T[:-1, :3, :3], 1, 2) @ T[1:, :3, :3])
    fast = (steps > max_speed_mps * seconds) | (turns > np.radians(max_turn_dps) * seconds)
    return np.stack([usable[:-1], usable[1:]], axis=1)[fast]


def angles(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (N,) angles in radians of (N, 3, 3) rotations; exact also for very small ones, NaN for NaN."""
    skew = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    return np.arctan2(np.linalg.norm(skew, axis=1), np.trace(R, axis1=1, axis2=2) - 1)


def _motion(R: NDArray[np.float64]) -> Transform:
    T = np.eye(4)
    T[:3, :3] = R
    return T


def _check_word(key: str, word: str, known: dict[str, NDArray[np.float64]] | tuple[str, ...]) -> None:
    if word not in known:
        raise SourceError(f"{key} = '{word}' is unknown{did_you_mean(word, known)}")
