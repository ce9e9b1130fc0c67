# SPDX-License-Identifier: Apache-2.0
"""Record a simulated D435 and a simulated T265 on one mount, as a folder that `open_source` reads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.errors import SourceError
from stereovox.frame import Frame
from stereovox.geometry.se3 import Transform, inverse, rotation_matrix
from stereovox.simulate.simulation import Simulation
from stereovox.simulate.t265 import OPENGL, RATE_HZ, T265, Track, start_frame, write_track
from stereovox.sources.calibration.camera_file import MATRIX
from stereovox.sources.poses.poses import seconds_from_ns
from stereovox.sources.rgbd.layouts.tum import IMAGES, LIST
from stereovox.sources.rigs.pair_file import FILE, PairSettings, pair_text

TRACKER = "tracker.txt"
START_NS = 1_000_000_000_000
"""Time of the first image on the camera's clock."""
LEAD_NS = 500_000_000
"""The tracker starts this much before the first image and ends this much after the last one."""
MOUNT = np.eye(4)
"""T_tracker_camera of a usual mount, both in optical axes: the D435 3 cm below the T265, about a degree misaligned."""
MOUNT[:3, :3] = rotation_matrix([0.022, -0.015, 0.009])
MOUNT[:3, 3] = 0.0125, 0.0318, -0.0041
MOUNT.setflags(write=False)


@dataclass(frozen=True, eq=False)
class Recording:
    """A recording and its ground truth.

    track: the tracker's reported and true poses.
    T_map_world: (4, 4) maps the simulation's z-up world into the map of a pair with `world = "optical"`: x right, y
        down, z forward, origin at the tracker's first pose. `simulation.stage.moved(T_map_world)` is the truth there
        (with `axes=world`).
    """

    folder: Path
    track: Track
    T_map_world: Transform


def record(
    simulation: Simulation,
    folder: Path,
    tracker: T265 | None = None,
    T_tracker_camera: Transform = MOUNT,
    *,
    calibrated: bool = True,
    world: str = "optical",
) -> Recording:
    """Write depth images, intrinsics, poses and `pair.toml` into the new or empty `folder`.

    T_tracker_camera: the true mount, both bodies in optical axes. calibrated: whether `pair.toml` contains mount and
    clock; `world`: its key of that name. Depth is written in whole millimetres, 0 for none; reasons are
    lost, as in any file of a D435. Raises SourceError if the folder is not empty.
    """
    tracker = tracker or T265()
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise SourceError(f"{folder}: is not empty; give a new folder")
    (folder / IMAGES).mkdir(parents=True, exist_ok=True)
    stamps = [_write_image(folder, frame) for frame in simulation]
    _write_list(folder / LIST, stamps)
    (folder / MATRIX).write_text(_matrix(simulation.camera), "utf-8")
    track, T_start_world = follow(simulation, tracker, T_tracker_camera)
    write_track(folder / TRACKER, track)
    settings = _settings(simulation, tracker, T_tracker_camera, calibrated, world)
    (folder / FILE).write_text(pair_text(settings, (f"{simulation.name} with a simulated tracker",)), "utf-8")
    return Recording(folder, track, OPENGL @ T_start_world)


def follow(simulation: Simulation, tracker: T265, T_tracker_camera: Transform = MOUNT) -> tuple[Track, Transform]:
    """Return the track of a tracker on the simulated camera, and T_start_world of its world (see `start_frame`).

    Stamps are as in a recording: the first image is taken at `START_NS` on the camera's clock.
    """
    last = (len(simulation) - 1) * simulation.period_ns
    times = np.arange(-LEAD_NS, last + LEAD_NS + 1, 1_000_000_000 // RATE_HZ)
    cameras = np.array([simulation.upright_pose_at(time) for time in times.tolist()])
    poses: NDArray[np.float64] = cameras @ inverse(T_tracker_camera)
    return tracker.track(times + START_NS, poses), start_frame(poses[0])


def _write_image(folder: Path, frame: Frame) -> int:
    import cv2

    stamp_ns = START_NS + frame.stamp_ns
    millimetres = np.rint(frame.depth.astype(np.float64) * (frame.depth_scale * 1000)).astype(np.uint16)
    path = folder / IMAGES / f"{seconds_from_ns(stamp_ns)}.png"
    if not cv2.imwrite(str(path), millimetres):
        raise SourceError(f"{path}: cannot be written; is the disk full?")
    return stamp_ns


def _write_list(path: Path, stamps: Sequence[int]) -> None:
    seconds = [seconds_from_ns(stamp) for stamp in stamps]
    lines = "".join(f"{text} {IMAGES}/{text}.png\n" for text in seconds)
    path.write_text(f"# stamp file\n{lines}", "utf-8")


def _matrix(camera: PinholeCamera) -> str:
    return f"{camera.fx!r} 0 {camera.cx!r}\n0 {camera.fy!r} {camera.cy!r}\n0 0 1\n"


def _settings(
    simulation: Simulation, tracker: T265, T_tracker_camera: Transform, calibrated: bool, world: str
) -> PairSettings:
    units = {"depth_scale": 0.001, "baseline": simulation.camera.baseline}
    settings = PairSettings(poses=TRACKER, axes="opengl", world=world, **units)
    if not calibrated:
        return settings
    return replace(
        settings,
        T_tracker_camera=np.array(T_tracker_camera),
        clock_offset_s=tracker.clock_offset_s,
        clock_rate=1 / (1 + tracker.clock_drift_ppm * 1e-6),
    )
