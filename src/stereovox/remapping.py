# SPDX-License-Identifier: Apache-2.0
"""Corrections from outside for a saved map: a file of better poses, as pose graphs and bundle adjustment write it."""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from stereovox.config import Config
from stereovox.errors import StereovoxError
from stereovox.mapper import Mapper
from stereovox.maps import VoxelMap, load_map
from stereovox.maps.kept_frames import KeptFrame
from stereovox.maps.store import check_target
from stereovox.products.moved import level_transform
from stereovox.rebuild import CorrectionReport, FrameKey
from stereovox.se3 import Transform, interpolate, inverse, orthonormalise
from stereovox.sources.poses import Poses
from stereovox.sources.trajectory import Trajectory

SAME_NS = 500_000
"""A pose whose stamp is this close to a frame's is its own: some programs write milliseconds."""


@dataclass(frozen=True)
class Remapped:
    """Result of `remap`.

    Attributes:
        map: The corrected map, as saved.
        out: Where it was saved.
        report: What the correction did.
        posed: Number of frames whose pose is in the file.
        between: Number of frames between them, which were moved as their neighbours before and after.
        outside: Number of frames before the first or after the last of them, which stayed where they were.
    """

    map: VoxelMap
    out: Path
    report: CorrectionReport
    posed: int
    between: int
    outside: int

    def summary(self) -> dict[str, Any]:
        """Return the numbers of `stereovox remap --json`, besides those of the map."""
        counts = {"posed": self.posed, "between": self.between, "outside": self.outside}
        return {**asdict(self.report), **counts}


def remap(path: str | Path, poses: str | Path, out: str | Path, *, sensor: str | None = None) -> Remapped:
    """Give the frames of a saved map corrected poses, and save the map that they make.

    A frame has the pose whose stamp is within half a millisecond of its own. Frames between such frames, and those of
    other sensors, are moved as these: the way that both neighbours in time would move them, interpolated. Frames before
    the first and after the last one stay where they are.

    Args:
        path: Folder of a map that kept its frames (`map.keep_frames`).
        poses: File of lines `stamp tx ty tz qx qy qz qw` (TUM): T_world_sensor of the optical frame, in the world of
            the recording. A map that was levelled turns them as it turned the recording's own.
        out: Folder of the corrected map.
        sensor: Which sensor the poses are of, where the map has several.

    Returns:
        The corrected map and what was done.

    Raises:
        StereovoxError: One line: a file cannot be read, the map did not keep its frames, no pose is of one of them, or
            nobody says of which of several sensors they are.
    """
    check_target(Path(out))
    saved = load_map(path)
    if saved.kept_frames is None or not len(saved.kept_frames):
        raise StereovoxError(f"{path}: the map did not keep its frames; map again with map.keep_frames=true")
    frames, trajectory = saved.kept_frames.frames, Trajectory(Path(poses))
    posed = _posed(_of_sensor(frames, sensor, path), trajectory, saved.config)
    new, counts = _with_neighbours(frames, posed)
    mapper = Mapper(saved.config, resume=saved, tiles=Path(out).parent / f".{Path(out).name}-tiles")
    try:
        report = mapper.correct(new)
        mapper.save(out)
    finally:
        mapper.close()
    return Remapped(load_map(out), Path(out), report, len(posed), counts["between"], counts["outside"])


def _of_sensor(frames: Sequence[KeptFrame], sensor: str | None, path: str | Path) -> list[KeptFrame]:
    """Return the frames of the sensor that the poses are of. Raises StereovoxError where that is not clear."""
    names = sorted({frame.sensor for frame in frames})
    if (sensor is None and len(names) > 1) or (sensor is not None and sensor not in names):
        given = "which one the poses are of" if sensor is None else f"another name than '{sensor}'"
        raise StereovoxError(f"{path}: has frames of {', '.join(map(repr, names))}; say {given} (--sensor NAME)")
    return [frame for frame in frames if sensor is None or frame.sensor == sensor]


def _posed(frames: Sequence[KeptFrame], poses: Poses, config: Config) -> list[tuple[KeptFrame, Transform]]:
    """Return the frames that have a pose, in order of time, each with it, in the world of the map.

    Raises StereovoxError where there is none, and for a line of the file that one needs and that cannot be used.
    """
    found, stamps = [], poses.stamps_ns.tolist()
    T_map_world = None if config.levelled_from is None else level_transform(config.levelled_from)
    for frame in sorted(frames, key=lambda frame: frame.stamp_ns):
        stamp_ns = _nearest(stamps, frame.stamp_ns)
        if abs(stamp_ns - frame.stamp_ns) <= SAME_NS:
            pose = poses.at(stamp_ns)
            found.append((frame, pose if T_map_world is None else T_map_world @ pose))
    if not found:
        span = f"{frames[0].stamp_ns / 1e9:.3f} to {frames[-1].stamp_ns / 1e9:.3f} s"
        raise StereovoxError(f"{poses.where}: no pose has the stamp of a frame of the map, which are from {span}")
    return found


def _nearest(stamps_ns: Sequence[int], stamp_ns: int) -> int:
    """Return the nearest of ascending stamps."""
    after = bisect_left(stamps_ns, stamp_ns)
    return min(stamps_ns[max(after - 1, 0) : after + 1], key=lambda one: abs(one - stamp_ns))


def _with_neighbours(
    frames: Sequence[KeptFrame], posed: Sequence[tuple[KeptFrame, Transform]]
) -> tuple[Mapping[FrameKey, Transform], Counter[str]]:
    """Return new poses of all frames that move, by sensor and stamp, and how many are `between` and `outside`."""
    new: dict[FrameKey, Transform] = {(frame.sensor, frame.stamp_ns): T for frame, T in posed}
    stamps, counts = [frame.stamp_ns for frame, _ in posed], Counter[str]()
    for frame in frames:
        if (frame.sensor, frame.stamp_ns) not in new:
            after = bisect_left(stamps, frame.stamp_ns)
            if after == len(stamps) or (after == 0 and stamps[0] != frame.stamp_ns):
                counts["outside"] += 1
                continue
            counts["between"] += 1
            new[frame.sensor, frame.stamp_ns] = _as_both_move(frame, posed[max(after - 1, 0)], posed[after])
    return new, counts


def _as_both_move(
    frame: KeptFrame, before: tuple[KeptFrame, Transform], after: tuple[KeptFrame, Transform]
) -> Transform:
    """Return the pose of a frame between two others that move: where each would take it, interpolated in time."""
    start, end = before[0].stamp_ns, after[0].stamp_ns
    share = (frame.stamp_ns - start) / (end - start) if end > start else 0.0
    first, second = (
        T @ inverse(orthonormalise(old.T_world_sensor)) @ frame.T_world_sensor for old, T in (before, after)
    )
    return interpolate(first, second, share)
