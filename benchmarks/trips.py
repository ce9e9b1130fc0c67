# SPDX-License-Identifier: Apache-2.0
"""The path of one input through the source into the map: a depth image, a stereo pair, a lidar scan.

    python benchmarks/trips.py [--depth FOLDER] [--stereo DRIVE] [--scan LOG] [--files] [--house] [--json]

Without recordings, small generated ones: a 7-Scenes folder, a KITTI odometry sequence, a CARMEN log. Counted by
running, with `sys.setprofile`, in a process that has made the trip before: modules are imported and kernels compiled.
The two trips:

    first   a new mapper is made and takes its first frame, which an open recording reads
    next    a mapper with WARM frames takes one more

files: source files with an entered function, including kernels called from Python. lines: length of these files.
moves: number of calls into another file than the previous call's. --house adds the figures of
`benchmarks/house.py`. A later checkout is measured with `PYTHONPATH=OTHER/src`.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import cv2
import numpy as np
from house import house

import stereovox as sv
from stereovox.opening import open_robot

SOURCE = Path(sv.__file__).parent
WARM = 8
Reader = Callable[[int], Any]
Maker = Callable[[], Any]


@dataclass(frozen=True)
class Trip:
    """Entered files, in order, their lines, and the moves between them."""

    files: list[str]
    lines: int
    moves: int


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("depth", "stereo", "scan"):
        parser.add_argument(f"--{name}")
    parser.add_argument("--files", action="store_true", help="name the files")
    parser.add_argument("--house", action="store_true", help="modules, lines, folders and circles too")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        trips = {name: pair_of_trips(*inputs) for name, inputs in inputs_of(arguments, Path(folder)).items()}
    figures = house(SOURCE.parents[1]) if arguments.house else {}
    if arguments.json:
        rows = {name: {kind: asdict(trip) for kind, trip in kinds.items()} for name, kinds in trips.items()}
        print(json.dumps({"trips": rows, "house": figures}))
        return
    print(f"{'trip':20} {'':6} {'files':>6} {'lines':>6} {'moves':>6}")
    for name, kinds in trips.items():
        for kind, trip in kinds.items():
            print(f"{name:20} {kind:6} {len(trip.files):6} {trip.lines:6} {trip.moves:6}")
            if arguments.files:
                print("\n".join(f"    {file}" for file in trip.files))
    for name, value in figures.items():
        print(f"{name:34} {len(value) if isinstance(value, list) else value}")


def inputs_of(arguments: argparse.Namespace, folder: Path) -> dict[str, tuple[Reader, Maker]]:
    """Return a reader by number and a mapper factory for each input."""
    images = sv.open_source(arguments.depth or made_depth(folder / "depth"))
    pairs = sv.open_source(arguments.stereo or made_stereo(folder / "drive"))
    scans = open_robot(arguments.scan or made_log(folder / "made.clf")).scans
    return {
        "depth PNG to voxel": (images.frame, lambda: sv.Mapper(voxel_size=0.1)),
        "stereo pair to voxel": (pairs.frame, lambda: sv.Mapper(voxel_size=0.5, max_range=30.0)),
        "scan to grid cell": (scans.__getitem__, lambda: sv.GridMapper(voxel_size=0.05)),
    }


def pair_of_trips(read: Reader, make: Maker) -> dict[str, Trip]:
    """Return the `first` and the `next` trip."""
    mapper = make()
    for i in range(WARM):
        taken(mapper, read(i))
    return {
        "first": traced(lambda: taken(make(), read(0))),
        "next": traced(lambda: taken(mapper, read(WARM))),
    }


def taken(mapper: Any, seen: Any) -> None:
    """Map one input that must not be refused: a refusal ends the trip early."""
    report = mapper.add(seen)
    assert report.refused is None, report.detail


def traced(trip: Callable[[], None]) -> Trip:
    """Return the files and functions entered by `trip`."""
    files, moves, before = dict[str, None](), 0, ""

    def entered(frame: FrameType, event: str, _: Any) -> None:
        nonlocal moves, before
        path = Path(frame.f_code.co_filename)
        if event != "call" or SOURCE not in path.parents or frame.f_code.co_name == "<module>":
            return
        file = path.relative_to(SOURCE).as_posix()
        files[file] = None
        moves += file != before
        before = file

    sys.setprofile(entered)
    try:
        trip()
    finally:
        sys.setprofile(None)
    return Trip([*files], sum((SOURCE / file).read_text().count("\n") for file in files), moves)


def made_depth(folder: Path) -> Path:
    """Write WARM + 1 frames of the simulated room in the layout of 7-Scenes."""
    folder.mkdir()
    frames = [*sv.open_source("sim:room", f":{WARM + 1}")]
    camera = frames[0].camera
    matrix = [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
    np.savetxt(folder / "camera-intrinsics.txt", matrix)
    for i, frame in enumerate(frames):
        cv2.imwrite(str(folder / f"frame-{i:06d}.depth.png"), frame.depth)
        np.savetxt(folder / f"frame-{i:06d}.pose.txt", frame.T_world_sensor)
    return folder


def made_stereo(folder: Path) -> Path:
    """Write WARM + 1 pairs of a textured wall at 12 m in the layout of KITTI odometry."""
    sequence, focal, baseline, width, height = folder / "sequences/00", 360.0, 0.5, 620, 188
    for image in ("image_0", "image_1"):
        (sequence / image).mkdir(parents=True)
    (folder / "poses").mkdir()
    random, shift = np.random.default_rng(0), round(focal * baseline / 12)
    for i in range(WARM + 1):
        wall = cv2.GaussianBlur(random.integers(0, 256, (height, width + shift), np.uint8), (3, 3), 0)
        cv2.imwrite(str(sequence / f"image_0/{i:06d}.png"), wall[:, :width])
        cv2.imwrite(str(sequence / f"image_1/{i:06d}.png"), wall[:, shift:])
    left = f"{focal} 0 {width / 2} 0 0 {focal} {height / 2} 0 0 0 1 0"
    right = f"{focal} 0 {width / 2} {-focal * baseline} 0 {focal} {height / 2} 0 0 0 1 0"
    (sequence / "calib.txt").write_text(f"P0: {left}\nP1: {right}\n")
    (sequence / "times.txt").write_text("".join(f"{i / 10:e}\n" for i in range(WARM + 1)))
    (folder / "poses/00.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * (WARM + 1))
    return sequence


def made_log(path: Path) -> Path:
    """Write WARM + 1 scans of a round room as a CARMEN log."""
    ranges = " ".join(["4.00"] * 180)
    poses = [f"{0.01 * i:.2f} 0 0" for i in range(WARM + 1)]
    lines = [f"FLASER 180 {ranges} {pose} {pose} {i / 10:.1f} made {i / 10:.1f}\n" for i, pose in enumerate(poses)]
    path.write_text("".join(lines))
    return path


if __name__ == "__main__":
    main()
