# SPDX-License-Identifier: Apache-2.0
"""Close the loops of a map that kept its frames: the Python side of `stereovox loops`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.config import Config, load_config
from stereovox.correct.corrected_poses import load_with_frames
from stereovox.correct.loops.closer import Loop, LoopCloser, check_one_way, ends_of
from stereovox.correct.loops.drift import Odometry, Positions
from stereovox.correct.loops.submaps import Submap
from stereovox.errors import StereovoxError
from stereovox.files.safe_io import check_file
from stereovox.frame import Progress, no_progress
from stereovox.geometry.se3 import rotation_between
from stereovox.mapper import Mapper
from stereovox.mapping.rebuild import CorrectionReport, need_frames
from stereovox.maps import VoxelMap, load_map
from stereovox.maps.files.store import check_target
from stereovox.maps.record.camera_path import LoopLines
from stereovox.products.floor_axes import up_of
from stereovox.sources.bags import suffix_of
from stereovox.sources.bags.fixes import read_fixes
from stereovox.sources.bags.recording import file_part
from stereovox.sources.poses.trajectory import TRAJECTORY_ENDINGS, Trajectory, write_trajectory


@dataclass(frozen=True, eq=False)
class LoopClosure:
    """The result of loop closure.

    Attributes:
        stamps_ns: (N,) int64, times of the map's frames in order.
        T_world_before: (N, 4, 4) float64, their original poses.
        T_world_sensor: (N, 4, 4) float64, their poses with all loops closed.
        loops: The loops that were closed; `first` and `second` are indices of `places`.
        refused: Places that look the same but were rejected, and why.
        anchors: (S,) int64, indices of the frames in the middle of all places.
        report: Report of the map's correction.
        odometry: The second odometry, and the number of steps it helped; None if missing.
        positions: The drift-free positions, and the number of places that agree with them, or None.
        sensors: Sensor of each of the N frames; empty if there is only one.
    """

    stamps_ns: NDArray[np.int64]
    T_world_before: NDArray[np.float64]
    T_world_sensor: NDArray[np.float64]
    loops: Sequence[Loop]
    refused: Sequence[Loop]
    anchors: NDArray[np.int64]
    report: CorrectionReport
    odometry: Odometry | None = None
    positions: Positions | None = None
    sensors: Sequence[str] = ()

    @property
    def moved_m(self) -> NDArray[np.float64]:
        """Return the distance (N,) in metres that each frame moved."""
        return np.linalg.norm(self.T_world_sensor[:, :3, 3] - self.T_world_before[:, :3, 3], axis=1)

    @property
    def places(self) -> NDArray[np.float64]:
        """Return the positions (S, 3) in metres of the middles of all places, as corrected."""
        return self.T_world_sensor[self.anchors, :3, 3]

    @property
    def lines(self) -> LoopLines:
        """Return the closed and the refused loops as lines between their places, as stored in the map."""
        return LoopLines.between(*(self.ends(found, self.T_world_sensor) for found in (self.loops, self.refused)))

    def ends(self, loops: Sequence[Loop], poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where the two places of each loop are.

        Args:
            loops: N loops.
            poses: (F, 4, 4) of all frames: `T_world_before` or `T_world_sensor`.

        Returns:
            (N, 2, 3) metres, world frame, the earlier place first.
        """
        return ends_of(loops, poses[self.anchors, :3, 3])

    def save(self, path: str | Path) -> None:
        """Write the corrected poses as lines `stamp tx ty tz qx qy qz qw` (TUM), all or nothing.

        With several sensors, only the poses of the first frame's sensor: a file is one trajectory.

        Args:
            path: The file, `.tum` or `.txt`.

        Raises:
            StereovoxError: Another ending.
            MapFileError: It cannot be written; an older file is then kept.
        """
        file = check_file(str(path), TRAJECTORY_ENDINGS)
        own = np.array([sensor == self.sensors[0] for sensor in self.sensors] or [True] * len(self.stamps_ns))
        camera = "camera (x right, y down, z forward)"
        write_trajectory(file, self.stamps_ns[own].tolist(), self.T_world_sensor[own], camera)

    def summary(self) -> dict[str, Any]:
        """Return the numbers of `stereovox loops --json`, except the map's."""
        offs = [loop.off_m for loop in self.loops]
        return {
            "loops": len(self.loops),
            "loops_refused": [self._described(loop) for loop in self.refused],
            "off_m": {"median": float(np.median(offs)), "max": max(offs)} if offs else None,
            "moved_m": {"median": float(np.median(self.moved_m)), "max": float(self.moved_m.max())},
            "odometry": None if self.odometry is None else self.odometry.summary(),
            "positions": None if self.positions is None else self.positions.summary(),
            **asdict(self.report),
        }

    def _described(self, loop: Loop) -> dict[str, Any]:
        places = {"at": self.places[loop.second].round(2).tolist(), "like": self.places[loop.first].round(2).tolist()}
        return {**places, "off_m": round(loop.off_m, 3), "why": loop.why}


@dataclass(frozen=True, eq=False)
class ClosedMap:
    """Result of `close_loops`.

    Attributes:
        map: The map with its loops closed, as saved.
        out: Where it was saved.
        closure: The loops found and the correction.
    """

    map: VoxelMap
    out: Path
    closure: LoopClosure


def close_loops(
    path: str | Path,
    out: str | Path,
    *,
    positions: str | Path | None = None,
    positions_sigma: float = 1.0,
    odometry: str | Path | None = None,
    progress: Progress = no_progress,
    **overrides: Any,
) -> ClosedMap:
    """Find the loops of a saved map, correct its camera's trajectory so that they close, and save the resulting map.

    Places are compared by their surfaces. A loop is accepted if these fit at only one place within what the poses'
    drift allows, and another finding agrees.

    Args:
        path: Folder of a map that kept its frames (`map.keep_frames`).
        out: Folder of the new map.
        positions: Drift-free positions of the camera, as of a GNSS receiver: a file of lines `stamp tx ty tz qx
            qy qz qw` (TUM; rotations are not used) in metres, in any world with the same up direction, or a bag with
            `sensor_msgs/NavSatFix` (if there are several topics: `drive.bag?topic=/gps/fix`).
        positions_sigma: Their standard deviation in metres, along each axis.
        odometry: A second odometry next to the map's poses, such as wheel odometry: a file of such lines (TUM) with
            poses of the camera in any world; `loops.odometry_drift` gives its drift.
        progress: Called with the number done, the total, and the current activity.
        **overrides: Settings of `loops`, such as `**{"loops.drift": 0.05}` for poses that drift more than usual.

    Returns:
        The new map and the closure. If no loop was found the map is a copy.

    Raises:
        StereovoxError: One line: the map cannot be read, or did not keep its frames; `positions` cannot be read, are
            too few or too close to each other, or contradict the trajectory; `odometry` cannot be read, has no poses at
            the map's times, or contradicts it.
        MissingExtra: gtsam is not installed.
    """
    refuse_without_frames(overrides)
    check_target(Path(out))
    saved, _ = load_with_frames(path)
    config = load_config(saved.config, **overrides)
    known = None if positions is None else _positions(str(positions), positions_sigma, config)
    wheels = None if odometry is None else Odometry(Trajectory(Path(odometry)), config.loops)
    mapper = Mapper(config, resume=saved, tiles=Path(out).parent / f".{Path(out).name}-tiles")
    try:
        closure = close(mapper, progress, known, wheels)
        mapper.save(out)
    finally:
        mapper.close()
    return ClosedMap(load_map(out), Path(out), closure)


def refuse_without_frames(overrides: Mapping[str, Any]) -> None:
    """Raise StereovoxError if the settings keep no frames."""
    if overrides.get("map.keep_frames") is False:
        raise StereovoxError("map.keep_frames=false: loops are closed by the frames of the map; leave it out")


def _positions(location: str, sigma_m: float, config: Config) -> Positions:
    if not 0 < sigma_m < inf:
        raise StereovoxError(f"positions_sigma {sigma_m:g} must be more than 0 metres")
    if suffix_of(file_part(location)):
        stamps_ns, places = read_fixes(location)
        return Positions(stamps_ns, places @ rotation_between([0, 0, 1], up_of(config)).T, sigma_m, location)
    poses = Trajectory(Path(location))
    places = poses.T_world_body[:, :3, 3]
    usable = np.isfinite(places).all(axis=1)
    return Positions(poses.stamps_ns[usable], places[usable], sigma_m, location)


def close(
    mapper: Mapper,
    progress: Progress = no_progress,
    positions: Positions | None = None,
    odometry: Odometry | None = None,
) -> LoopClosure:
    """Find the loops of a mapper's map, and correct it. Frames that other threads add during the search move like the
    last one; frames that they add during the correction stay unchanged.

    Args:
        mapper: Its map must keep its frames (`map.keep_frames`).
        progress: Called with the number done, the total, and the current activity.
        positions: Drift-free positions of the camera.
        odometry: A second odometry next to the frames' poses.

    Returns:
        The loops found and the correction.

    Raises:
        StereovoxError: The map did not keep its frames, or was merged from several recordings; `positions` are too few
            or too close to each other, or contradict the trajectory; `odometry` has no poses at the times of the
            frames, or contradicts it.
        MissingExtra: gtsam is not installed.
    """
    kept = need_frames(mapper.map.kept_frames, "the map")
    frames, closer = kept.frames, LoopCloser(mapper.config, odometry)
    check_one_way(mapper.map.history, frames)
    if positions is not None:
        positions.check(np.array([frame.stamp_ns for frame in frames], np.int64))
    for done, frame in enumerate(frames, 1):
        closer.add(frame)
        progress(done, len(frames), "looking for loops")
    closer.finish(lambda done, total: progress(done, total, "registering places"), positions)
    if positions is not None:
        positions.check_used()
    if odometry is not None:
        odometry.check()
    corrected, known = closer.corrected(), (positions, odometry) != (None, None)
    later = {
        (one.sensor, one.stamp_ns): closer.submaps[-1].bend @ one.T_world_sensor
        for one in kept.frames
        if one.number > frames[-1].number  # a budget may have dropped some of `frames` since
    }
    report = mapper.correct(corrected | later) if closer.loops or known else CorrectionReport()
    closure = LoopClosure(
        np.array([frame.stamp_ns for frame in frames], np.int64),
        np.array([frame.T_world_sensor for frame in frames]),
        np.array([corrected[frame.sensor, frame.stamp_ns] for frame in frames]),
        closer.loops,
        closer.refused,
        _anchors(closer.submaps),
        report,
        odometry,
        positions,
        [frame.sensor for frame in frames],
    )
    with mapper.map.lock:
        mapper.map.history.loops = closure.lines
    return closure


def _anchors(submaps: Sequence[Submap]) -> NDArray[np.int64]:
    """Return the indices (S,) of the submaps' anchors among all frames."""
    before = np.cumsum([0, *(len(submap.frames) for submap in submaps)])[:-1]
    return before + np.array([submap.anchor for submap in submaps], np.int64)
