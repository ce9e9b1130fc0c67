# SPDX-License-Identifier: Apache-2.0
"""The result of localisation: a robot's track and its odometry's drift over time."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import StereovoxError
from stereovox.frame import Frame, Scan
from stereovox.geometry import se2
from stereovox.sources.poses.trajectory import write_trajectory

Posed = TypeVar("Posed", bound=Frame | Scan)


@dataclass(frozen=True, eq=False)
class Track:
    """A robot's track through a map, and its odometry's drift.

    stamps_ns: (N,) int64 nanoseconds, ascending. pose_map_base: (N, 3) float64, the robot in the map. pose_map_odom:
    (N, 3) float64, from odometry to map (the `map -> odom` of ROS). refused: scans left out, by reason;
    first_refusal: message of the first one. Raises StereovoxError if stamps do not ascend: times between them would
    be looked up wrongly.
    """

    stamps_ns: NDArray[np.int64]
    pose_map_base: se2.Pose
    pose_map_odom: se2.Pose
    refused: dict[str, int] = field(default_factory=dict)
    first_refusal: str = ""

    def __post_init__(self):
        stamps_ns = np.asarray(self.stamps_ns)
        late = np.flatnonzero(stamps_ns[1:] <= stamps_ns[:-1])
        if len(late):
            before, after = stamps_ns[late[0]], stamps_ns[late[0] + 1]
            said = f"pose {late[0] + 1} at {after} ns comes after one at {before} ns"
            raise StereovoxError(f"the times of a track must rise: {said}; leave out scans that are not in order")

    def correction(self, stamp_ns: int) -> se2.Pose:
        """Return pose_map_odom (3,) at a time: interpolated, and constant before the first and after the last."""
        after = int(np.searchsorted(self.stamps_ns, stamp_ns, side="right"))
        if after in (0, len(self.stamps_ns)):
            return np.asarray(self.pose_map_odom[max(after - 1, 0)], float)
        before, start, end = after - 1, self.stamps_ns[after - 1], self.stamps_ns[after]
        share = float(stamp_ns - start) / float(end - start)
        step = self.pose_map_odom[after] - self.pose_map_odom[before]
        step[2] = float(se2.wrapped(step[2]))
        return np.asarray(self.pose_map_odom[before] + share * step, float)

    def corrected(self, seen: Posed) -> Posed:
        """Return a frame or scan in the odometry's world with its pose in the map."""
        T_map_odom = se2.lifted(self.correction(seen.stamp_ns))
        return replace(seen, T_world_sensor=T_map_odom @ seen.T_world_sensor)

    def save(self, path: str | Path) -> None:
        """Write the robot's poses as lines `stamp tx ty tz qx qy qz qw` (TUM): seconds, metres, quaternion.

        Raises MapFileError if the file cannot be written; an older file is then kept.
        """
        poses = np.array([se2.lifted(pose) for pose in self.pose_map_base]).reshape(-1, 4, 4)
        write_trajectory(path, self.stamps_ns.tolist(), poses, "robot in the map, on the floor")
