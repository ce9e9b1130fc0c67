# SPDX-License-Identifier: Apache-2.0
"""Errors of the motions between poses of a trajectory: by frame, by second, and over segments (KITTI's rule).

Poses are (N, 4, 4) float64 rigid motions in metres, `found` paired with `true` ones.

Scores of an estimated trajectory in space: ATE, RPE by frame, second and distance, drift.

Our own implementation, because evo is GPL-3 and this is Apache-2.0; the tests compare its figures with evo's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import StereovoxError
from stereovox.evaluate.trajectory import PosePairs, TrajectoryLike, nearest, pair_poses
from stereovox.geometry.se3 import Transform, orthonormalise

Transforms = NDArray[np.float64]
"""(N, 4, 4) float64 rigid motions."""
START_EVERY = 10
"""A segment starts at every tenth pose (KITTI's development kit, evaluate_odometry.cpp)."""
SECOND_NS, TOLERANCE_NS = 1_000_000_000, 100_000_000


@dataclass(frozen=True)
class ErrorFigures:
    """Root mean square, mean, median and maximum of absolute errors."""

    rmse: float
    mean: float
    median: float
    max: float

    @classmethod
    def of(cls, errors: NDArray[np.float64]) -> ErrorFigures:
        """Return the figures of (N,) errors, at least one."""
        values = np.sqrt(np.mean(errors**2)), errors.mean(), np.median(errors), errors.max()
        return cls(*map(float, values))


@dataclass(frozen=True)
class StepErrors:
    """Errors of the motions between poses one step apart (RPE), of all poses that have a partner there."""

    pairs: int
    translation_m: ErrorFigures
    rotation_deg: ErrorFigures


@dataclass(frozen=True)
class SegmentErrors:
    """Mean errors of the motions over segments of one length, divided by it (KITTI)."""

    length_m: float
    segments: int
    translation_percent: float
    rotation_deg_per_m: float


def motion_errors(
    found: Transforms, true: Transforms, start: NDArray[np.int64], end: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the errors in metres and degrees (M,) of the motions from poses `start` to poses `end` (Sturm 2012)."""
    moved, truly = (np.linalg.inv(T[start]) @ T[end] for T in (found, true))
    error = np.linalg.inv(truly) @ moved
    return np.linalg.norm(error[:, :3, 3], axis=1), angles_deg(error)


def steps(found: Transforms, true: Transforms, start: NDArray[np.int64], end: NDArray[np.int64]) -> StepErrors:
    """Return the figures of `motion_errors`."""
    metres, degrees = motion_errors(found, true, start, end)
    return StepErrors(len(metres), ErrorFigures.of(metres), ErrorFigures.of(degrees))


def per_second(found: Transforms, true: Transforms, stamps_ns: NDArray[np.int64] | None) -> StepErrors | None:
    """Return the errors of the motions from each pose to the one nearest to a second later; None if missing.

    stamps_ns: (N,) int64, ascending; None if unknown.
    """
    if stamps_ns is None:
        return None
    later = stamps_ns + SECOND_NS
    end = nearest(stamps_ns, later)
    start = np.flatnonzero((np.abs(stamps_ns[end] - later) <= TOLERANCE_NS) & (later <= stamps_ns[-1]))
    return steps(found, true, start, end[start]) if len(start) else None


def segment_errors(
    found: Transforms, true: Transforms, travelled: NDArray[np.float64], lengths_m: Sequence[float]
) -> tuple[tuple[SegmentErrors, ...], tuple[float | None, float | None]]:
    """Return the errors by length, and the means over all segments (percent, degrees per metre; None without one).

    KITTI's rule: from each START_EVERY-th pose to the first one farther along the truth than the length; the
    errors are divided by the length. travelled: (N,) metres, see `travelled_m`.
    """
    rows, shares, rates = [], [], []
    starts = np.arange(0, len(true), START_EVERY)
    for length in lengths_m:
        end = np.searchsorted(travelled, travelled[starts] + length, side="right")  # the first one farther on
        fits = end < len(true)
        if not fits.any():
            continue
        metres, degrees = motion_errors(found, true, starts[fits], end[fits])
        rows.append(SegmentErrors(length, len(metres), float(100 * metres.mean() / length),
                                  float(degrees.mean() / length)))  # fmt: skip
        shares.append(100 * metres / length)
        rates.append(degrees / length)
    if not rows:
        return (), (None, None)
    return tuple(rows), (float(np.concatenate(shares).mean()), float(np.concatenate(rates).mean()))


def mean_angle_deg(T: Transforms) -> float:
    """Return the angle in degrees of the mean rotation, nearest to the mean matrix, of (N, 4, 4) motions."""
    return float(angles_deg(orthonormalise(T.mean(axis=0))[None])[0])


def travelled_m(T: Transforms) -> NDArray[np.float64]:
    """Return (N,) metres along the trajectory from the first pose to each."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1))])


def angles_deg(T: Transforms) -> NDArray[np.float64]:
    """Return the angles (N,) in degrees of (N, 4, 4) motions."""
    R = T[:, :3, :3]
    axis = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], 1)
    return np.degrees(np.arctan2(np.linalg.norm(axis, axis=1), np.trace(R, axis1=1, axis2=2) - 1))


KITTI_SEGMENTS_M = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
SHORT_SEGMENTS_M = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0)
"""Segments of trajectories shorter than the first of KITTI's."""
MIN_EXTENT_M = 1e-3
"""A trajectory within this distance of its middle cannot be aligned."""
STRAIGHT = 1e-9
"""Ratio of covariance across to along a trajectory below which positions do not determine the roll about it."""


@dataclass(frozen=True, eq=False)
class TrajectoryScore:
    """Differences between an estimated trajectory and the true one.

    pairs: the N pairs of poses, with the estimate unaligned. T_truth_world: (4, 4) float64, the alignment, and scale,
    the factor on positions before it; identity and 1 without alignment. position_errors_m, rotation_errors_deg: (N,)
    float64 of the aligned poses; position_m (ATE) and rotation_deg are their figures. rotation_offset_deg: the angle of
    the mean rotation error: large if the two follow different body axes, or if positions nearly on a line leave the
    roll about it open.
    length_m: of the truth, through its paired poses. duration_s: None without times.
    per_frame: RPE from each pair to the next. per_second: to the pair nearest to one second later (0.9 to 1.1 s); None
    if there is none.
    segments: by length, for lengths that fit into the trajectory. translation_percent, rotation_deg_per_m: means over
    all of them; None without segments. drift_percent: position error at the end after aligning the start, relative to
    length_m; None if the truth stands still.
    """

    pairs: PosePairs
    T_truth_world: Transform
    scale: float
    aligned: bool
    position_errors_m: NDArray[np.float64]
    rotation_errors_deg: NDArray[np.float64]
    position_m: ErrorFigures
    rotation_deg: ErrorFigures
    rotation_offset_deg: float
    length_m: float
    duration_s: float | None
    per_frame: StepErrors
    per_second: StepErrors | None
    segments: tuple[SegmentErrors, ...]
    translation_percent: float | None
    rotation_deg_per_m: float | None
    drift_percent: float | None

    def aligned_positions(self) -> NDArray[np.float64]:
        """Return (N, 3) positions in metres of the estimate, aligned, in the truth's frame."""
        return _moved(self.pairs.T_world_body, self.T_truth_world, self.scale)[:, :3, 3]

    def as_dict(self) -> dict[str, Any]:
        """Return all numbers for JSON, without NaN."""
        pairs = self.pairs
        return {
            "poses": len(pairs),
            "estimate_poses": pairs.estimate_poses,
            "truth_poses": pairs.truth_poses,
            "without_truth": pairs.estimate_poses - len(pairs),
            "coverage": pairs.coverage,
            "length_m": self.length_m,
            "duration_s": self.duration_s,
            "aligned": self.aligned,
            "scale": self.scale,
            "T_truth_world": self.T_truth_world.tolist(),
            "position_m": asdict(self.position_m),
            "rotation_deg": asdict(self.rotation_deg),
            "rotation_offset_deg": self.rotation_offset_deg,
            "per_frame": asdict(self.per_frame),
            "per_second": None if self.per_second is None else asdict(self.per_second),
            "segments": [asdict(one) for one in self.segments],
            "translation_percent": self.translation_percent,
            "rotation_deg_per_m": self.rotation_deg_per_m,
            "drift_percent": self.drift_percent,
        }


def score_trajectory(
    estimate: TrajectoryLike,
    truth: TrajectoryLike,
    *,
    align: bool = True,
    scale: bool = False,
    max_difference_s: float | None = None,
    segments_m: Sequence[float] | None = None,
) -> TrajectoryScore:
    """Compare an estimated trajectory with the true one, pose by pose and motion by motion.

    Args:
        estimate: File of poses (TUM lines, KITTI's 12 numbers, ...), or `Poses` or `ImagePoses` read from one: poses of
            a body in its own world, metres.
        truth: The same for the true poses of the same body.
        align: Align the estimate first, rigidly, by least squares of positions. False: both are in one frame.
        scale: Also fit the scale (one camera without metres).
        max_difference_s: Poses farther apart in time are not paired; by default 0.02 s.
        segments_m: Lengths in metres of KITTI's segments. By default 100 to 800 m if the truth is longer than
            100 m, else 1, 2, 5, 10, 20, 50 m.

    Returns:
        The errors; position and rotation errors (ATE) after alignment, motions (RPE) independent of it except for
        scale.

    Raises:
        StereovoxError: One line: too few pairs, an unusable pose, too little motion to align, a
            `max_difference_s` for poses without times.
    """
    if scale and not align:
        raise StereovoxError("scale=True: is fitted together with the alignment; leave align=True")
    if segments_m is not None and not all(0 < length < np.inf for length in segments_m):
        raise StereovoxError(f"segments_m={list(segments_m)}: give lengths in metres above 0")
    pairs = pair_poses(estimate, truth, max_difference_s)
    T_truth_world, factor = np.eye(4), 1.0
    if align:
        T_truth_world, factor = best_alignment(pairs, scale)
    found, true = _moved(pairs.T_world_body, T_truth_world, factor), pairs.T_truth_body
    gaps = np.linalg.norm(found[:, :3, 3] - true[:, :3, 3], axis=1)
    between = np.linalg.inv(true) @ found
    turns = angles_deg(between)
    travelled = travelled_m(true)
    length = float(travelled[-1])
    usual = KITTI_SEGMENTS_M if length > KITTI_SEGMENTS_M[0] else SHORT_SEGMENTS_M
    segments, means = segment_errors(found, true, travelled, usual if segments_m is None else segments_m)
    first, last = np.array([0]), np.array([len(true) - 1])
    drift = float(motion_errors(found, true, first, last)[0][0])
    return TrajectoryScore(
        pairs=pairs,
        T_truth_world=T_truth_world,
        scale=factor,
        aligned=align,
        position_errors_m=gaps,
        rotation_errors_deg=turns,
        position_m=ErrorFigures.of(gaps),
        rotation_deg=ErrorFigures.of(turns),
        rotation_offset_deg=mean_angle_deg(between),
        length_m=length,
        duration_s=None if pairs.stamps_ns is None else float(np.ptp(pairs.stamps_ns)) / 1e9,
        per_frame=steps(found, true, np.arange(len(true) - 1), np.arange(1, len(true))),
        per_second=per_second(found, true, pairs.stamps_ns),
        segments=segments,
        translation_percent=means[0],
        rotation_deg_per_m=means[1],
        drift_percent=100 * drift / length if length > MIN_EXTENT_M else None,
    )


def best_alignment(pairs: PosePairs, scale: bool = False) -> tuple[Transform, float]:
    """Return T_truth_world (4, 4), and the factor of positions before it, that align estimated poses with true ones.

    Least squares of positions (Umeyama 1991, Eq 38 to 43). If they lie on a straight line, which leaves the roll about
    it open, rotations determine it.
    Raises StereovoxError if one of the two stands still.
    """
    ours, true = pairs.T_world_body[:, :3, 3], pairs.T_truth_body[:, :3, 3]
    a, b = ours - ours.mean(axis=0), true - true.mean(axis=0)
    for where, points in ((pairs.estimate, a), (pairs.truth, b)):
        if np.linalg.norm(points, axis=1).max() < MIN_EXTENT_M:
            cure = "score it without alignment (--no-align) or give a recording with motion"
            raise StereovoxError(f"{where}: stands still, within {1000 * MIN_EXTENT_M:g} mm; {cure}")
    covariance = weights = b.T @ a / len(a)
    widths = np.linalg.svd(covariance, compute_uv=False)
    if widths[1] <= STRAIGHT * widths[0]:
        rolls = (pairs.T_truth_body[:, :3, :3] @ pairs.T_world_body[:, :3, :3].transpose(0, 2, 1)).mean(axis=0)
        weights = covariance + STRAIGHT * widths[0] * rolls
    u, _, vt = np.linalg.svd(weights)
    R = (u * [1, 1, np.sign(np.linalg.det(u) * np.linalg.det(vt))]) @ vt
    factor = float(np.trace(R.T @ covariance) / (a**2).sum(axis=1).mean()) if scale else 1.0
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, true.mean(axis=0) - factor * R @ ours.mean(axis=0)
    return T, factor


def _moved(T_world_body: Transforms, T_truth_world: Transform, scale: float) -> NDArray[np.float64]:
    scaled = T_world_body.copy()
    scaled[:, :3, 3] *= scale
    return T_truth_world @ scaled
