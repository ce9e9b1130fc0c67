# SPDX-License-Identifier: Apache-2.0
"""How far an estimated way of a ground robot is from the true one: ATE and RPE on a floor (Sturm et al. 2012).

By hand, because evo is GPL-3 and this is Apache-2.0.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox import planar
from stereovox.errors import FrameRefused, StereovoxError
from stereovox.localize.track import Track
from stereovox.sources.poses import Poses

LEVER_M, LEAST_LEVER_M = 0.3, 0.001
"""What headings weigh in an alignment at most and at least: that of a point so far ahead of the robot."""


@dataclass(frozen=True, eq=False)
class TrajectoryError:
    """Differences between N estimated poses and the true ones of the same times.

    position_rms_m to position_max_m: metres; yaw_rms_deg, yaw_max_deg: degrees (ATE).
    step_rms_m, step_yaw_rms_deg: of the motion over `step_m` metres of the true way (RPE); None where it is shorter.
    poses: N; without_truth: estimated poses of whose time the truth says nothing.
    motion: (3,) pose_truth_map by which the estimate was moved first; zero where it was not aligned.
    """

    position_rms_m: float
    position_median_m: float
    position_p95_m: float
    position_max_m: float
    yaw_rms_deg: float
    yaw_max_deg: float
    step_rms_m: float | None
    step_yaw_rms_deg: float | None
    step_m: float
    poses: int
    without_truth: int
    motion: planar.Pose

    def as_dict(self) -> dict[str, Any]:
        """Return all numbers: JSON without NaN."""
        x, y, yaw = map(float, self.motion)
        return {**asdict(self), "motion": {"x": x, "y": y, "yaw_deg": float(np.degrees(yaw))}}


def trajectory_error(track: Track, truth: Poses, align: bool = True, step_m: float = 1.0) -> TrajectoryError:
    """Compare a track with true poses of the robot's base.

    align: move the whole track first, rigidly and without a scale, to where it lies best on the true poses
    (`best_motion`); for SLAM, whose map stands in a frame of its own.
    step_m: metres of the true way over which motions are compared.
    Raises StereovoxError where the truth knows no time of the track.
    """
    true, known = true_poses(track.stamps_ns, truth)
    if not known.any():
        raise StereovoxError(f"{truth.where}: knows no time of the track; give the truth of the same recording")
    true, found = true[known], np.asarray(track.pose_map_base, float)[known]
    motion = best_motion(found, true) if align else np.zeros(3)
    moved = planar.compose(motion, found)
    metres, turns = _gaps(true, moved)
    step, step_turns = _gaps(*(_steps(poses, true, step_m) for poses in (true, moved)))
    return TrajectoryError(
        position_rms_m=_rms(metres),
        position_median_m=float(np.median(metres)),
        position_p95_m=float(np.percentile(metres, 95)),
        position_max_m=float(metres.max()),
        yaw_rms_deg=_rms(turns),
        yaw_max_deg=float(turns.max()),
        step_rms_m=_rms(step) if len(step) else None,
        step_yaw_rms_deg=_rms(step_turns) if len(step) else None,
        step_m=step_m,
        poses=len(true),
        without_truth=int((~known).sum()),
        motion=motion,
    )


def true_poses(stamps_ns: NDArray[np.int64], truth: Poses) -> tuple[planar.Pose, NDArray[np.bool_]]:
    """Return (N, 3) true poses at these times, NaN where there is none near enough, and (N,) whether there is one."""
    poses = np.full((len(stamps_ns), 3), np.nan)
    for i, stamp_ns in enumerate(stamps_ns.tolist()):
        try:
            poses[i] = planar.flattened(truth.at(stamp_ns))
        except FrameRefused:
            continue  # counted by the caller
    return poses, np.isfinite(poses[:, 0])


def best_motion(poses_here: ArrayLike, poses_there: ArrayLike) -> planar.Pose:
    """Return (3,) pose_there_here that lays (N, 3) poses best on (N, 3) others, by least squares (Horn 1987).

    Nearly by positions alone, as is usual; but where the robot hardly went anywhere they do not tell the turn, and its
    headings do. So a heading counts like a point ahead of the robot, as far as positions and headings are off from each
    other (metres per radian), and LEVER_M at most.
    """
    here, there = np.asarray(poses_here, float), np.asarray(poses_there, float)
    a, b = (poses[:, :2] - poses[:, :2].mean(axis=0) for poses in (here, there))
    fit = complex((a * b).sum(), (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum())
    turns = there[:, 2] - here[:, 2]
    turn = complex(np.cos(turns).sum(), np.sin(turns).sum())
    off = np.sqrt(max((a**2).sum() + (b**2).sum() - 2 * abs(fit), 0.0))
    off_turn = np.sqrt((planar.wrapped(turns - np.angle(turn)) ** 2).sum())
    lever = np.clip(off / max(off_turn, 1e-12), LEAST_LEVER_M, LEVER_M)
    yaw = float(np.angle(fit + lever**2 * turn))
    shift = there[:, :2].mean(axis=0) - planar.transform((0, 0, yaw), here[:, :2].mean(axis=0)[None])[0]
    return np.array([*shift, yaw])


def _gaps(true: planar.Pose, found: planar.Pose) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return metres and degrees between poses (N, 3)."""
    between = planar.relative(true, found)
    return np.hypot(between[:, 0], between[:, 1]), np.degrees(np.abs(between[:, 2]))


def _steps(poses: planar.Pose, true: planar.Pose, step_m: float) -> planar.Pose:
    """Return the motions (M, 3) from each pose to the first that lies `step_m` further along the true way."""
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(true[:, :2], axis=0).T))])
    end = np.searchsorted(way, way + step_m - 1e-9)
    start = np.flatnonzero(end < len(way))
    return planar.relative(poses[start], poses[end[start]])


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values**2)))
