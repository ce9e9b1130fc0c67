# SPDX-License-Identifier: Apache-2.0
"""Recordings of three good frames, and after them a bad one: of each kind that a door must refuse."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from entrance_cases import good

from stereovox.mapping.entrance import CLOUD, IMAGE
from stereovox.sources.poses.trajectory import write_trajectory

PER_METRE = 5000
GOOD = 3


@dataclass(frozen=True)
class Fault:
    """What is wrong with the last frame. reason: in a recording. kind: what it is of."""

    reason: str
    kind: str = IMAGE


FAULTS = {
    "nothing": Fault(""),
    "nan-pose": Fault("bad_pose_file"),
    "no-pose": Fault("no_pose"),
    "shape": Fault("bad_shape"),
    "units": Fault("bad_units"),
    "frozen": Fault("frozen_image"),
    "damaged": Fault("unreadable"),
    "empty": Fault("no_valid_depth"),
    "noise": Fault("no_surfaces"),
    "cloud": Fault("", CLOUD),
    "cloud-millimetres": Fault("bad_units", CLOUD),
    "cloud-noise": Fault("no_surfaces", CLOUD),
    "cloud-nan": Fault("no_valid_point", CLOUD),
}


def bad_depth(name: str) -> np.ndarray:
    """Return the last image of a recording, uint16."""
    depth = np.rint(PER_METRE * good(IMAGE, 2 if name == "frozen" else GOOD).depth).astype(np.uint16)
    if name == "shape":
        return depth[:40].copy()
    if name == "units":
        return np.maximum(depth // 2000, 1)
    if name == "empty":
        return np.zeros_like(depth)
    if name == "noise":
        return np.random.default_rng(3).integers(1500, 22500, depth.shape).astype(np.uint16)
    return depth


def bad_points(name: str) -> np.ndarray:
    """Return the last cloud of a recording, (N, 3) metres."""
    points = good(CLOUD, GOOD).points
    if name == "cloud-millimetres":
        return 1000 * points
    if name == "cloud-noise":
        return np.random.default_rng(3).uniform(-5, 5, points.shape).astype(np.float32)
    return np.full_like(points, np.nan) if name == "cloud-nan" else points


def write_faulty(folder: Path, name: str, frames: int = GOOD + 1) -> Path:
    """Write a recording, whose last frame is bad as is said in FAULTS; returns its folder."""
    (_images if FAULTS[name].kind == IMAGE else _clouds)(folder, name, frames)
    return folder


def _stamp(n: int) -> int:
    return 10**9 + 10**8 * n


def _images(folder: Path, name: str, count: int) -> None:
    (folder / "depth").mkdir(parents=True)
    lines, frames = [], [good(IMAGE, n) for n in range(GOOD + 1)]
    for n, frame in enumerate(frames[:count]):
        stamp_s = _stamp(n) / 1e9 + (n == GOOD and name == "no-pose")
        depth = bad_depth(name) if n == GOOD else np.rint(PER_METRE * frame.depth).astype(np.uint16)
        path = folder / "depth" / f"{stamp_s:.9f}.png"
        cv2.imwrite(str(path), depth)
        if n == GOOD and name == "damaged":
            path.write_bytes(path.read_bytes()[:200])
        lines.append(f"{stamp_s:.9f} depth/{stamp_s:.9f}.png")
    (folder / "depth.txt").write_text("\n".join(lines) + "\n")
    poses = np.array([frame.T_world_sensor for frame in frames])
    if name == "frozen":
        poses[GOOD, 0, 3] += 0.1
    write_trajectory(folder / "groundtruth.txt", [_stamp(n) for n in range(GOOD + 1)], poses, "camera")
    if name == "nan-pose":
        text = (folder / "groundtruth.txt").read_text().splitlines()
        text[-1] = " ".join([text[-1].split()[0], "nan", *text[-1].split()[2:]])
        (folder / "groundtruth.txt").write_text("\n".join(text) + "\n")
    camera = frames[0].camera
    names = "width", "height", "fx", "fy", "cx", "cy"
    (folder / "camera.toml").write_text("".join(f"{one} = {getattr(camera, one)}\n" for one in names))


def _clouds(folder: Path, name: str, count: int) -> None:
    folder.mkdir(parents=True)
    clouds = [*(good(CLOUD, n).points for n in range(GOOD)), bad_points(name)]
    for n, points in enumerate(clouds[:count]):
        np.column_stack([points, np.zeros(len(points))]).astype("<f4").tofile(folder / f"{_stamp(n) / 1e9:.6f}.bin")
    poses = np.array([good(CLOUD, n).T_world_sensor for n in range(GOOD + 1)])
    write_trajectory(folder / "poses.txt", [_stamp(n) for n in range(GOOD + 1)], poses, "lidar")
