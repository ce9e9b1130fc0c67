# SPDX-License-Identifier: Apache-2.0
"""Errors of a robot's track on a floor: ATE, RPE, and known relations; and pose pairs of trajectories by their times.

Errors in space: see `trajectory_score`. Our own implementation, because evo is GPL-3 and this is Apache-2.0.
"""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.errors import FrameRefused, SourceError, StereovoxError
from stereovox.files.safe_io import MAX_LIST, read_text
from stereovox.geometry import se2
from stereovox.geometry.se3 import rigidity_error
from stereovox.maps.record.camera_path import FARTHEST
from stereovox.sources.poses.poses import Poses
from stereovox.sources.poses.trajectory import ns_from_seconds
from stereovox.sources.rgbd.pose_files import ImagePoses, read_poses

if TYPE_CHECKING:
    from stereovox.localize.track import Track


TOLERANCE_S = 0.05
"""A relation is not scored if its times have no pose within this tolerance."""
LEVER_M, MIN_LEVER_M = 0.3, 0.001
"""Largest and smallest weight of headings in an alignment: like a point this far ahead of the robot."""


@dataclass(frozen=True, eq=False)
class Relations:
    """Known motions of a robot, mostly between consecutive times, some between visits of one place.

    stamps_ns: (N, 2) int64, the two times. motion: (N, 3) float64, pose_first_second (x, y, yaw).
    """

    stamps_ns: NDArray[np.int64]
    motion: se2.Pose

    def __len__(self) -> int:
        return len(self.motion)


@dataclass(frozen=True, eq=False)
class RelationErrors:
    """Differences between a trajectory's motions and the known ones.

    metres, radians: (N,) absolute errors of the relations with poses. missed: number of relations without.
    """

    metres: NDArray[np.float64]
    radians: NDArray[np.float64]
    missed: int

    def rows(self) -> dict[str, tuple[float, float]]:
        """Return mean and standard deviation in the paper's units: m, degrees, m^2, degrees^2."""
        degrees = np.degrees(self.radians)
        table = {
            "absolute_m": self.metres,
            "absolute_deg": degrees,
            "squared_m2": self.metres**2,
            "squared_deg2": degrees**2,
        }
        return {name: (float(values.mean()), float(values.std())) for name, values in table.items()}

    def as_dict(self) -> dict[str, Any]:
        """Return the figures by name, for JSON."""
        table = {name: {"mean": mean, "std": std} for name, (mean, std) in self.rows().items()}
        return {"relations": len(self.metres), "without_pose": self.missed, **table}

    def line(self) -> str:
        """Format the figures in one line."""
        rows = self.rows()
        metres, degrees = ("{:.4f} +- {:.4f}".format(*rows[name]) for name in ("absolute_m", "absolute_deg"))
        missed = f", {self.missed} more have no pose" if self.missed else ""
        return f"{len(self.metres)} relations: off by {metres} m and {degrees} degrees{missed}"


def read_relations(path: str | os.PathLike[str]) -> Relations:
    """Read the relations of a file with lines `time1 time2 x y z roll pitch yaw` (seconds, metres, radians).

    Raises SourceError, one line, for an unreadable file, an invalid line, or a file without relations.
    """
    path = Path(path)
    try:
        lines = read_text(path, MAX_LIST, "replace").splitlines()
    except OSError as error:
        raise SourceError(f"{path}: {os.strerror(error.errno or 0).lower()}; give a .relations file") from None
    rows = [_row(path, number, line) for number, line in enumerate(lines, 1) if line.strip() and line[0] != "#"]
    if not rows:
        raise SourceError(f"{path}: holds no relation (time1 time2 x y z roll pitch yaw)")
    return Relations(np.array([row[:2] for row in rows], np.int64), np.array([row[2:] for row in rows], float))


def _row(path: Path, number: int, line: str) -> tuple[int, int, float, float, float]:
    fields = line.split()
    try:
        first, second = (ns_from_seconds(field) for field in fields[:2])
        x, y, _, _, _, yaw = (float(field) for field in fields[2:])
        if not np.isfinite([x, y, yaw]).all():
            raise ValueError
    except ValueError:
        raise SourceError(f"{path}: line {number} is not a relation (time1 time2 x y z roll pitch yaw)") from None
    return first, second, x, y, yaw


def score_relations(track: Track, path: str | os.PathLike[str]) -> RelationErrors:
    """Compare a track's motions with those in a `.relations` file."""
    return relation_errors(read_relations(path), track.stamps_ns, track.pose_map_base)


def relation_errors(
    relations: Relations, stamps_ns: ArrayLike, poses: ArrayLike, tolerance_s: float = TOLERANCE_S
) -> RelationErrors:
    """Compare a trajectory's motions with known ones.

    stamps_ns: (M,) int64, rising. poses: (M, 3) pose_map_base. Each time of a relation takes the pose nearest in time.
    The error is delta (-) delta*, length and angle apart: independent of the map's frame (Kuemmerle 2009, Eq 7).
    Raises SourceError if no relation has poses.
    """
    stamps, poses = np.asarray(stamps_ns, np.int64), np.asarray(poses, float)
    closest = nearest(stamps, relations.stamps_ns)
    near = np.abs(stamps[closest] - relations.stamps_ns).max(axis=1) <= tolerance_s * 1e9
    if not near.any():
        raise SourceError("no relation has a time that the trajectory has; are they of one recording?")
    found = se2.relative(poses[closest[near, 0]], poses[closest[near, 1]])
    left = se2.relative(relations.motion[near], found)
    return RelationErrors(np.hypot(left[:, 0], left[:, 1]), np.abs(left[:, 2]), int((~near).sum()))


def nearest(stamps: NDArray[np.int64], queries: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return for each query the index of the nearest of the rising stamps, the earlier one if two are equally near."""
    after = np.clip(np.searchsorted(stamps, queries), 1, max(len(stamps) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(stamps) - 1)
    return np.where(queries - stamps[before] <= stamps[after] - queries, before, after)


@dataclass(frozen=True, eq=False)
class TrajectoryError:
    """Differences between N estimated poses and the true ones at the same times.

    position_rms_m to position_max_m: metres; yaw_rms_deg, yaw_max_deg: degrees (ATE).
    step_rms_m, step_yaw_rms_deg: of motions over `step_m` metres of the true path (RPE); None if it is shorter.
    poses: N; without_truth: estimated poses without a true one at their time.
    motion: (3,) pose_truth_map by which the estimate was aligned first; zero if it was not.
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
    motion: se2.Pose

    def as_dict(self) -> dict[str, Any]:
        """Return all numbers for JSON, without NaN."""
        x, y, yaw = map(float, self.motion)
        return {**asdict(self), "motion": {"x": x, "y": y, "yaw_deg": float(np.degrees(yaw))}}


def trajectory_error(track: Track, truth: Poses, align: bool = True, step_m: float = 1.0) -> TrajectoryError:
    """Compare a track with true poses of the robot's base.

    align: first align the whole track with the true poses, rigidly and without scale (`best_motion`); for SLAM, whose
    map has its own frame.
    step_m: metres along the true path over which motions are compared.
    Raises StereovoxError if no time of the track has a true pose.
    """
    true, known = true_poses(track.stamps_ns, truth)
    if not known.any():
        raise StereovoxError(f"{truth.where}: no time in common with the track; give the truth of the same recording")
    true, found = true[known], np.asarray(track.pose_map_base, float)[known]
    motion = best_motion(found, true) if align else np.zeros(3)
    moved = se2.compose(motion, found)
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


def true_poses(stamps_ns: NDArray[np.int64], truth: Poses) -> tuple[se2.Pose, NDArray[np.bool_]]:
    """Return (N, 3) true poses at these times, NaN if none is near enough, and a mask (N,) of those found."""
    poses = np.full((len(stamps_ns), 3), np.nan)
    for i, stamp_ns in enumerate(stamps_ns.tolist()):
        try:
            poses[i] = se2.flattened(truth.at(stamp_ns))
        except FrameRefused:
            continue  # counted by the caller
    return poses, np.isfinite(poses[:, 0])


def best_motion(poses_source: ArrayLike, poses_target: ArrayLike) -> se2.Pose:
    """Return (3,) pose_target_source that best aligns (N, 3) poses with (N, 3) others, by least squares (Horn 1987).

    Positions dominate, as usual; but if the robot hardly moved, they do not determine the rotation, and
    headings do. So a heading counts like a point ahead of the robot, at a distance of the ratio of position to heading
    errors (metres per radian), at most LEVER_M.
    """
    source, target = np.asarray(poses_source, float), np.asarray(poses_target, float)
    a, b = (poses[:, :2] - poses[:, :2].mean(axis=0) for poses in (source, target))
    fit = complex((a * b).sum(), (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum())
    turns = target[:, 2] - source[:, 2]
    turn = complex(np.cos(turns).sum(), np.sin(turns).sum())
    off = np.sqrt(max((a**2).sum() + (b**2).sum() - 2 * abs(fit), 0.0))
    off_turn = np.sqrt((se2.wrapped(turns - np.angle(turn)) ** 2).sum())
    lever = np.clip(off / max(off_turn, 1e-12), MIN_LEVER_M, LEVER_M)
    yaw = float(np.angle(fit + lever**2 * turn))
    shift = target[:, :2].mean(axis=0) - se2.transform((0, 0, yaw), source[:, :2].mean(axis=0)[None])[0]
    return np.array([*shift, yaw])


def _gaps(true: se2.Pose, found: se2.Pose) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the distances in metres and degrees between poses (N, 3)."""
    between = se2.relative(true, found)
    return np.hypot(between[:, 0], between[:, 1]), np.degrees(np.abs(between[:, 2]))


def _steps(poses: se2.Pose, true: se2.Pose, step_m: float) -> se2.Pose:
    """Return the motions (M, 3) from each pose to the first one `step_m` farther along the true path."""
    travelled = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(true[:, :2], axis=0).T))])
    end = np.searchsorted(travelled, travelled + step_m - 1e-9)
    start = np.flatnonzero(end < len(travelled))
    return se2.relative(poses[start], poses[end[start]])


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values**2)))


TrajectoryLike = str | os.PathLike[str] | Poses | ImagePoses
"""A file of poses (TUM, KITTI, or another form of docs/recordings.md), or what was read from one."""
MAX_DIFFERENCE_S = 0.02
"""Poses farther apart in time are not paired (TUM's associate.py)."""
MAX_GAP_S, MAX_GAP_INTERVALS = 1.0, 3.0
"""The time between two estimated poses is a gap if it is longer than these seconds and than this many median intervals:
keyframes are seconds apart."""
MIN_PAIRS = 3
MAX_DEFORMATION = 5e-3
"""Largest entry of abs(R^T R - I) that counts as rounding of a pose; the default of `pose_rigidity_tolerance`."""


@dataclass(frozen=True, eq=False)
class PosePairs:
    """N pairs of an estimated and a true pose, in order.

    stamps_ns: (N,) int64 nanoseconds of the estimate; None if the files have no times; then lines pair by number.
    T_world_body, T_truth_body: (N, 4, 4) float64, estimated and true. estimate_poses, truth_poses: number of all poses
    of each. coverage: share of the truth's time span covered by estimated poses without a gap (see MAX_GAP_S); without
    times, share of the truth's poses with a partner. estimate, truth: their origin, for messages. truth_positions: (K,
    3) float64 metres of all true poses; truth_index: (N,) int64, indices of the paired ones. truth_missed: (K,) bool,
    those in a gap of the estimate longer than MAX_GAP_INTERVALS of its usual intervals; without times, those without a
    partner.
    """

    stamps_ns: NDArray[np.int64] | None
    T_world_body: NDArray[np.float64]
    T_truth_body: NDArray[np.float64]
    estimate_poses: int
    truth_poses: int
    coverage: float
    estimate: str
    truth: str
    truth_positions: NDArray[np.float64]
    truth_index: NDArray[np.int64]
    truth_missed: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.T_world_body)


def pair_poses(estimate: TrajectoryLike, truth: TrajectoryLike, max_difference_s: float | None = None) -> PosePairs:
    """Pair each pose of the sparser trajectory with the one of the other that is nearest in time (evo's rule).

    Poses without times pair by the number of their image, else by line.
    max_difference_s: poses farther apart in time are not paired; None: MAX_DIFFERENCE_S.
    Raises StereovoxError, one line, for a file that cannot be read, a pose that is not rigid or has NaN, fewer than
    MIN_PAIRS pairs, times in only one of the two, and `max_difference_s` without times.
    """
    limit_s = MAX_DIFFERENCE_S if max_difference_s is None else max_difference_s
    if not 0 < limit_s < np.inf:
        raise StereovoxError(f"max_difference_s={limit_s}: give seconds above 0")
    ours, true = (one if isinstance(one, Poses | ImagePoses) else read_poses(Path(one)) for one in (estimate, truth))
    T, T_true = _checked(ours), _checked(true)
    if isinstance(ours, Poses) and isinstance(true, Poses):
        i, j = _by_time(ours.stamps_ns, true.stamps_ns, round(limit_s * 1e9))
        stamps_ns = ours.stamps_ns[i]
        coverage = _covered(ours.stamps_ns, true.stamps_ns)
        missed = _missed(ours.stamps_ns, true.stamps_ns)
        missed[j] = False
        cure = f"no more than {limit_s:g} s apart; are they of one recording and one clock?"
    elif isinstance(ours, ImagePoses) and isinstance(true, ImagePoses):
        if max_difference_s is not None:
            cure = "leave max_difference_s (--max-difference) out"
            raise StereovoxError(f"{ours.where}: has no times, poses pair by number or line; {cure}")
        i, j = _by_number(ours, true)
        stamps_ns, coverage, cure = None, len(j) / len(true), "with the same number; are they of one recording?"
        missed = ~np.isin(np.arange(len(true)), j)
    else:
        timeless = ours if isinstance(ours, ImagePoses) else true
        raise StereovoxError(f"{timeless.where}: has no times, the other trajectory has; give both as TUM lines")
    if len(i) < MIN_PAIRS:
        raise StereovoxError(f"{ours.where}: {len(i)} poses have one of {true.where} {cure} ({MIN_PAIRS} are needed)")
    return PosePairs(
        stamps_ns, T[i], T_true[j], len(ours), len(true), coverage, ours.where, true.where, T_true[:, :3, 3], j, missed
    )


def _checked(poses: Poses | ImagePoses) -> NDArray[np.float64]:
    """Return all poses (N, 4, 4); raises StereovoxError for the first unusable one."""
    keys = poses.stamps_ns.tolist() if isinstance(poses, Poses) else range(len(poses))
    T = np.array([poses.at(key) for key in keys])
    for number, one in enumerate(T, 1):
        if not (rigidity_error(one) <= MAX_DEFORMATION and np.abs(one[:3, 3]).max() <= FARTHEST):
            cure = f"holds NaN, or lies beyond {FARTHEST:g} m; correct or delete it"
            raise StereovoxError(f"{poses.where}: pose {number} is not rigid, {cure}")
    return T


def _by_time(
    ours: NDArray[np.int64], true: NDArray[np.int64], limit_ns: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the (N,) indices of pairs in both."""
    if len(ours) > len(true):
        j, i = _by_time(true, ours, limit_ns)
        return i, j
    found = nearest(true, ours)
    near = np.flatnonzero(np.abs(true[found] - ours) <= limit_ns)
    return near, found[near]


def _by_number(ours: ImagePoses, true: ImagePoses) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    if ours.numbers is not None and true.numbers is not None:
        _, i, j = np.intersect1d(ours.numbers, true.numbers, return_indices=True)
        return i, j
    if len(ours) != len(true):
        counts = f"{len(ours)} poses, {true.where} {len(true)}"
        raise StereovoxError(f"{ours.where}: {counts}; without times each needs its partner in the same line")
    return np.arange(len(ours)), np.arange(len(true))


def _covered(ours_ns: NDArray[np.int64], truth_ns: NDArray[np.int64]) -> float:
    """Return the share of the truth's time span covered by estimated poses without gaps."""
    gaps = np.diff(ours_ns)
    if not len(gaps):
        return 0.0
    inside = np.diff(np.clip(ours_ns, truth_ns[0], truth_ns[-1]))
    limit_ns = max(MAX_GAP_S * 1e9, MAX_GAP_INTERVALS * float(np.median(gaps)))
    return float(inside[gaps <= limit_ns].sum() / max(truth_ns[-1] - truth_ns[0], 1))


def _missed(ours_ns: NDArray[np.int64], truth_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which true poses (K,) are in too long a gap within, before or after the estimate."""
    limit_ns = MAX_GAP_INTERVALS * float(np.median(np.diff(ours_ns))) if len(ours_ns) > 1 else 0.0
    ends = np.concatenate([truth_ns[:1], ours_ns, truth_ns[-1:]])
    after = np.searchsorted(ours_ns, truth_ns) + 1
    return ends[after] - ends[after - 1] > limit_ns
