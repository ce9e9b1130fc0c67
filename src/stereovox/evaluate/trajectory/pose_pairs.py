# SPDX-License-Identifier: Apache-2.0
"""Poses of an estimated trajectory paired with the true ones of the same times."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import StereovoxError
from stereovox.evaluate.trajectory.trajectory import nearest
from stereovox.geometry.se3 import rigidity_error
from stereovox.maps.record.camera_path import FARTHEST
from stereovox.sources.poses.poses import Poses
from stereovox.sources.rgbd.pose_files import ImagePoses, read_poses

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
