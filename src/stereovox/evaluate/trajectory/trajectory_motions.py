# SPDX-License-Identifier: Apache-2.0
"""Errors of the motions between poses of a trajectory: by frame, by second, and over segments (KITTI's rule).

Poses are (N, 4, 4) float64 rigid motions in metres, `found` paired with `true` ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereovox.evaluate.trajectory.trajectory import nearest
from stereovox.geometry.se3 import orthonormalise

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
