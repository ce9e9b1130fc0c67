# SPDX-License-Identifier: Apache-2.0
"""How often a recording's depth unit and up direction are found: generated recordings with random parameters.

Each has a scene, an image size, a part of the path, a unit, a layout, noise of depth and poses, and a randomly turned
world. Right: found and reported as certain. Unsure: reported as uncertain. Wrong: silently wrong.

python benchmarks/guesses.py [RECORDINGS] [SEED]
"""

from __future__ import annotations

import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from stereovox import open_source
from stereovox.geometry.se3 import rotation_matrix
from stereovox.runs.survey import survey
from stereovox.simulate.simulation import Simulation

SCENES = ("room", "apartment", "aisle?speed=1", "flight?length=60", "box?size=large")
UNITS = (0.001, 0.001, 1 / 5000, 1 / 5000, 1 / 4000, 1 / 6553.5, 1 / 10000, 0.01, 1 / 256, 1.0)
"""Metres per unit; the last stands for floats in metres."""
MAX_OFF = 15.0
"""Largest error of up in degrees."""


class Case(NamedTuple):
    """Parameters of a generated recording."""

    scene: str
    width: int
    frames: int
    unit: float
    layout: str
    R_world_scene: NDArray[np.float64]


def make(folder: Path, rng: np.random.Generator) -> Case:
    """Write a recording and return its parameters."""
    scene, width = str(rng.choice(SCENES)), int(rng.choice([160, 240, 320, 424]))
    mark = "&" if "?" in scene else "?"
    noise = int(rng.random() < 0.7)
    source = Simulation(f"sim:{scene}{mark}image_width={width}&noise={noise}&seed={rng.integers(1000)}")
    count, step = int(rng.integers(15, 40)), int(rng.integers(1, 6))
    start = int(rng.integers(0, max(1, len(source) - count * step)))
    unit, layout = float(rng.choice(UNITS)), str(rng.choice(["tum", "kitti", "log"]))
    T_world_scene = np.eye(4)
    T_world_scene[:3, :3] = rotation_matrix(rng.normal(size=3)) if rng.random() < 0.5 else axes(rng)
    T_world_scene[:3, 3] = rng.normal(size=3) * 3
    jitter = float(rng.choice([0.0, 0.003, 0.01]))
    camera = source.camera
    numbers = f"{camera.fx} 0 {camera.cx} 0 {camera.fy} {camera.cy} 0 0 1"
    (folder / "depth").mkdir(parents=True)
    (folder / "camera-intrinsics.txt").write_text(numbers)
    poses = []
    for n in range(min(count, (len(source) - start + step - 1) // step)):
        frame = source.frame(start + n * step)
        metres = np.where(np.isfinite(frame.depth) & (frame.depth > 0), frame.depth * frame.depth_scale, 0)
        write(folder / "depth" / f"{n / 10:.6f}", metres, unit)
        T = T_world_scene @ frame.T_world_sensor
        T[:3, :3] = T[:3, :3] @ rotation_matrix(0.3 * jitter * rng.normal(size=3))
        T[:3, 3] += jitter * rng.normal(size=3)
        poses.append(T)
    write_poses(folder, layout, poses)
    return Case(scene, width, len(poses), unit, layout, T_world_scene[:3, :3])


def axes(rng: np.random.Generator) -> NDArray[np.float64]:
    """A turn that maps axes onto axes."""
    R = np.eye(3)[rng.permutation(3)] * rng.choice([-1, 1], size=3)
    return R * np.linalg.det(R)


def write(path: Path, metres: NDArray[np.floating], unit: float) -> None:
    """Write an image: 16-bit PNG, or NPY if the unit is a metre."""
    if unit == 1:
        np.save(path.with_name(f"{path.name}.npy"), metres.astype(np.float32))
    else:
        stored = np.where(metres / unit < 65535, np.rint(metres / unit), 0).astype(np.uint16)
        cv2.imwrite(str(path.with_name(f"{path.name}.png")), stored)


def write_poses(folder: Path, layout: str, poses: list[NDArray[np.float64]]) -> None:
    """Write poses in the form of a layout."""
    if layout == "tum":
        lines = [f"{n / 10:.6f} {' '.join(map(str, [*T[:3, 3], *quaternion(T[:3, :3])]))}" for n, T in enumerate(poses)]
        (folder / "groundtruth.txt").write_text("\n".join(lines))
    elif layout == "kitti":
        (folder / "poses.txt").write_text("\n".join(" ".join(map(str, T[:3].ravel())) for T in poses))
    else:
        rows = [f"{n} {n} {n + 1}\n" + "\n".join(" ".join(map(str, row)) for row in T) for n, T in enumerate(poses)]
        (folder / "trajectory.log").write_text("\n".join(rows))


def quaternion(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """The quaternion x, y, z, w of a rotation (3, 3)."""
    values, vectors = np.linalg.eigh(
        np.array([
            [R[0, 0] - R[1, 1] - R[2, 2], R[1, 0] + R[0, 1], R[2, 0] + R[0, 2], R[2, 1] - R[1, 2]],
            [R[1, 0] + R[0, 1], R[1, 1] - R[0, 0] - R[2, 2], R[2, 1] + R[1, 2], R[0, 2] - R[2, 0]],
            [R[2, 0] + R[0, 2], R[2, 1] + R[1, 2], R[2, 2] - R[0, 0] - R[1, 1], R[1, 0] - R[0, 1]],
            [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], np.trace(R)],
        ])
    )  # fmt: skip
    return vectors[:, np.argmax(values)]


def judge(folder: Path, case: Case) -> tuple[str, str, float]:
    """Return the verdicts on unit and up, and the error of up in degrees."""
    source: Any = open_source(folder)
    found = survey(source)
    right = abs(source.unit.scale / case.unit - 1) < 1e-3
    unit = "right" if right and source.unit.sure else "right, unsure" if right else "unsure"
    if not right and (source.unit.sure or not source.notes):
        unit = "wrong"
    up = found.up
    if up is None:
        return unit, "unsure", float("nan")
    off = float(np.degrees(np.arccos(np.clip(up.direction @ case.R_world_scene[:, 2], -1, 1))))
    return unit, ("right" if off <= MAX_OFF else "wrong") if up.sure else "unsure", off


def main() -> None:
    """Print a line for each recording that was not judged right, and a table."""
    count, seed = (int(word) for word in (*sys.argv[1:], *("50", "0")[len(sys.argv) - 1 :]))
    rng, units, ups = np.random.default_rng(seed), Counter[str](), Counter[str]()
    with tempfile.TemporaryDirectory() as place:
        for n in range(count):
            folder = Path(place) / f"{n}"
            case = make(folder, rng)
            unit, up, off = judge(folder, case)
            units[unit] += 1
            ups[up] += 1
            if unit != "right" or up != "right":
                made = f"{case.scene} {case.width} px, {case.frames} frames, {case.layout}, unit {case.unit:.6g}"
                print(f"{n}: {made}: unit {unit}; up {up}, {off:.0f} degrees off")
    print(f"unit: {dict(units.most_common())}")
    print(f"up: {dict(ups.most_common())}")


if __name__ == "__main__":
    main()
