# SPDX-License-Identifier: Apache-2.0
"""Corrections from outside for a saved map: a file of better poses, as from pose graphs and bundle adjustment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.config import Config
from stereovox.correct.corrected_poses import load_with_frames, poses_by_path
from stereovox.errors import FrameRefused, StereovoxError
from stereovox.mapper import Mapper
from stereovox.mapping.rebuild import CorrectionReport
from stereovox.maps import VoxelMap, load_map
from stereovox.maps.files.store import check_target
from stereovox.maps.record.kept_frames import KeptFrame
from stereovox.products.moved import level_transform
from stereovox.sources.poses.poses import MAX_GAP_NS, Poses
from stereovox.sources.poses.tracker import angles
from stereovox.sources.poses.trajectory import Trajectory


@dataclass(frozen=True)
class Remapped:
    """Result of `remap`.

    Attributes:
        map: The corrected map, as saved.
        out: Where it was saved.
        report: Report of the correction.
        posed: Number of frames whose pose is in the file.
        between: Number of frames between them, which moved like their neighbours.
        outside: Number of frames before the first or after the last of them, which were not moved.
        repeated: Number of unused poses, whose stamp an earlier line already has.
        beyond: Number of unused poses from before the first frame or after the last.
        moved_m: Metres by which frames moved: median and maximum.
        turned_deg: Degrees by which they turned: median and maximum.
        way_m: Largest extent in metres of the original frame positions along an axis.
    """

    map: VoxelMap
    out: Path
    report: CorrectionReport
    posed: int
    between: int
    outside: int
    repeated: int
    beyond: int
    moved_m: tuple[float, float]
    turned_deg: tuple[float, float]
    way_m: float

    def summary(self) -> dict[str, Any]:
        """Return the numbers of `stereovox remap --json`, except the map's."""
        counts = {name: getattr(self, name) for name in ("posed", "between", "outside", "repeated", "beyond")}
        moves = {
            name: dict(zip(("median", "max"), getattr(self, name), strict=True)) for name in ("moved_m", "turned_deg")
        }
        return {**asdict(self.report), **counts, **moves}


def remap(path: str | Path, poses: str | Path, out: str | Path, *, sensor: str | None = None) -> Remapped:
    """Give the frames of a saved map corrected poses, and save the resulting map.

    A frame takes the pose whose stamp is within half a millisecond of its own. Other frames between the poses, and
    frames of other sensors, move like these, see `poses_by_path`. Frames before the first pose and after the last are
    not moved.


    Args:
        path: Folder of a map that kept its frames (`map.keep_frames`).
        poses: File of lines `stamp tx ty tz qx qy qz qw` (TUM): T_world_sensor of the optical frame, in the world of
            the recording. A levelled map turns them as it turned the recording's own.
        out: Folder of the corrected map.
        sensor: Sensor of the poses, if the map has several.

    Returns:
        The corrected map and the report.

    Raises:
        StereovoxError: One line: a file cannot be read, the map did not keep its frames, no pose belongs to one of
            them, or the sensor is ambiguous.
    """
    check_target(Path(out))
    saved, frames = load_with_frames(path)
    trajectory = Trajectory(Path(poses))
    mounts = {_posed_sensor(frames, sensor, path): np.eye(4)}
    new = poses_by_path(frames, _in_map(trajectory, saved.config), mounts)
    if not new.poses:
        span = f"{frames[0].stamp_ns / 1e9:.3f} to {frames[-1].stamp_ns / 1e9:.3f} s"
        raise StereovoxError(f"{poses}: no pose has the stamp of a frame of the map, which are from {span}")
    mapper = Mapper(saved.config, resume=saved, tiles=Path(out).parent / f".{Path(out).name}-tiles")
    try:
        report = mapper.correct(new.poses)
        mapper.save(out)
    except FrameRefused as refused:
        raise StereovoxError(f"{poses}: a pose cannot be used ({refused})") from None
    finally:
        mapper.close()
    before = np.array([frame.T_world_sensor for frame in frames])
    after = np.array([new.poses.get((one.sensor, one.stamp_ns), one.T_world_sensor) for one in frames])
    moved = np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1)
    turned = np.degrees(angles(np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3]))
    return Remapped(
        load_map(out), Path(out), report, new.posed, new.between, new.outside, trajectory.repeated,
        _beyond(trajectory, frames), _median_and_most(moved), _median_and_most(turned),
        float(np.ptp(before[:, :3, 3], axis=0).max()),
    )  # fmt: skip


def _beyond(poses: Poses, frames: Sequence[KeptFrame]) -> int:
    """Return how many poses are too early or too late to affect a frame."""
    stamps_ns = [frame.stamp_ns for frame in frames]
    first, last = min(stamps_ns) - MAX_GAP_NS, max(stamps_ns) + MAX_GAP_NS
    return int(np.count_nonzero((poses.stamps_ns < first) | (poses.stamps_ns > last)))


def _median_and_most(numbers: NDArray[np.float64]) -> tuple[float, float]:
    return float(np.median(numbers)), float(numbers.max())


def _posed_sensor(frames: Sequence[KeptFrame], sensor: str | None, path: str | Path) -> str:
    """Return the sensor of the poses. Raises StereovoxError if that is ambiguous."""
    names = sorted({frame.sensor for frame in frames})
    if (sensor is None and len(names) > 1) or (sensor is not None and sensor not in names):
        given = "which one the poses are of" if sensor is None else f"another name than '{sensor}'"
        raise StereovoxError(f"{path}: has frames of {', '.join(map(repr, names))}; say {given} (--sensor NAME)")
    return names[0] if sensor is None else sensor


def _in_map(poses: Poses, config: Config) -> Poses:
    """Return poses in the world of a map that may have been levelled."""
    if config.levelled_from is None:
        return poses
    T = level_transform(config.levelled_from) @ poses.T_world_body
    return Poses(poses.stamps_ns, T, where=poses.where, faults=poses.faults)
