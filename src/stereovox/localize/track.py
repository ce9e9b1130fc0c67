# SPDX-License-Identifier: Apache-2.0
"""The result of localisation: a robot's track and its odometry's drift over time.

A validated scan as beams in the robot's frame, seen from above.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import FrameRefused, StereovoxError
from stereovox.frame import Frame, Scan, name_of
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


@dataclass(frozen=True, eq=False)
class Beams:
    """The usable beams of a scan: hits, and beams without a return up to `range_max`.

    origin: (2,) float64 x, y of the sensor in the robot's frame.
    directions: (K, 2) float64, direction of a beam per metre of its length, seen from above in the robot's frame.
        Shorter than one if the sensor is tilted.
    ranges: (K,) float64 metres; `range_max` if there is no return.
    at_max: (K,) bool, which have no return.
    range_max: metres.
    """

    origin: NDArray[np.float64]
    directions: NDArray[np.float64]
    ranges: NDArray[np.float64]
    at_max: NDArray[np.bool_]
    range_max: float

    @property
    def ends(self) -> NDArray[np.float64]:
        """Where the beams end in the robot's frame, (K, 2) metres."""
        return self.origin + self.directions * self.ranges[:, None]

    def some(self, most: int, hits_only: bool = False) -> Beams:
        """Return at most `most` beams, evenly chosen from all or from the hits."""
        chosen = np.flatnonzero(~self.at_max) if hits_only else np.arange(len(self.ranges))
        if len(chosen) > most:
            chosen = chosen[np.linspace(0, len(chosen) - 1, most).round().astype(int)]
        return self.only(chosen)

    def only(self, chosen: NDArray[np.integer] | NDArray[np.bool_]) -> Beams:
        """Return the chosen beams."""
        return replace(self, directions=self.directions[chosen], ranges=self.ranges[chosen], at_max=self.at_max[chosen])


def beams_of(scan: Scan, max_range: float | None = None) -> Beams:
    """Return the beams of a scan: NaN, -inf and ranges below `range_min` are ignored, +inf means no return.

    max_range: metres beyond which returns do not count; None: the scan's own. The scan must be validated
    (`validate_scan`). Raises FrameRefused with the reason: `bad_scan`, `no_valid_range`.
    """
    ranges, farthest = np.asarray(scan.ranges, float), _farthest(scan, max_range)
    known = (ranges >= scan.range_min) & (ranges > 0)
    if not known.any():
        raise FrameRefused("no_valid_range", f"{name_of(scan)}: not one beam has a range; is the lidar covered?")
    angles = scan.angles[known]
    across = np.column_stack([np.cos(angles), np.sin(angles)]) @ scan.T_base_sensor[:2, :2].T
    at_max = ranges[known] >= farthest
    return Beams(scan.T_base_sensor[:2, 3], across, np.minimum(ranges[known], farthest), at_max, farthest)


def _farthest(scan: Scan, max_range: float | None) -> float:
    farthest = scan.range_max if max_range is None else min(max_range, scan.range_max)
    if not 0 < farthest < np.inf:
        said = f"{name_of(scan)}: the lidar measures up to {scan.range_max:g} m; amcl.max_range must bound that"
        raise FrameRefused("bad_scan", said)
    return float(farthest)
