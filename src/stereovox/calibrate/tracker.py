# SPDX-License-Identifier: Apache-2.0
"""A tracker's poses, vectorised and smoothed, and the offset between its clock and a camera's."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereovox.calibrate.odometry import CameraMotion
from stereovox.errors import StereovoxError
from stereovox.sources.poses.poses import MAX_GAP_NS, Poses
from stereovox.sources.poses.tracker import angles, jumps

SMOOTH = 0.03
"""Smoothing in seconds; a hand that swings twice a second loses 0.6 % of its turns."""
STEP = 0.01
"""Seconds between compared samples."""
OVERLAP = 0.5
"""Least share of the shorter recording within the other."""
MIN_CORRELATION = 0.6
"""Least correlation of a match."""
RIVAL_GAP_S, RIVAL_SHARE, MAX_RIVALS = 0.3, 0.85, 5
"""Rival matches that are also tried: at least this many seconds from better ones, with this share of the best
correlation, at most this many."""
MAX_SPAN_S = 86_400.0
"""Seconds; a longer recording has a wrong stamp, and its samples would fill memory."""


class PoseTrack:
    """Poses interpolated as `Poses.at` does, vectorised; times in seconds since `start_ns`.

    Poses below `min_confidence` and unusable ones are left out; a jump divides the track. A tracker's poses jitter,
    which would limit the offset to their spacing, so each is the mean of those within `SMOOTH` around it.

    """

    def __init__(self, poses: Poses, min_confidence: float, max_speed_mps: float, max_turn_dps: float):
        from scipy.spatial.transform import Rotation, Slerp

        usable = np.isfinite(poses.T_world_body).all((1, 2))
        if poses.confidence is not None:
            usable &= poses.confidence >= min_confidence
        if usable.sum() < 2:
            raise StereovoxError(f"{poses.where}: fewer than two poses of confidence {min_confidence:g} or more")
        kept = Poses(poses.stamps_ns[usable], poses.T_world_body[usable], where=poses.where)
        self.start_ns = int(kept.stamps_ns[0])
        times = (kept.stamps_ns - self.start_ns) / 1e9
        breaks = np.zeros(len(times), np.intp)
        breaks[jumps(kept, max_speed_mps, max_turn_dps)[:, 1]] = 1
        count = _poses_to_average(times)
        middle = slice(count // 2, len(times) - count // 2)
        self._breaks = np.cumsum(breaks)[middle]
        self.times = _averages(times[:, None], count)[:, 0]
        self._positions = _averages(kept.T_world_body[:, :3, 3], count)
        self._rotations = Slerp(self.times, Rotation.from_quat(_averages(_quaternions(kept), count)))

    def at(self, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (N, 4, 4) T_world_body at (N,) times; times beyond either end get the pose at that end."""
        times = np.clip(times, self.times[0], self.times[-1])
        T = np.zeros((len(times), 4, 4))
        T[:, 3, 3] = 1
        T[:, :3, :3] = self._rotations(times).as_matrix()
        T[:, :3, 3] = np.stack([np.interp(times, self.times, axis) for axis in self._positions.T], axis=1)
        return T

    def parts(self, times: NDArray[np.float64]) -> NDArray[np.intp]:
        """Return, for (N,) times, the part of the track between two jumps; -1 if no pose is near."""
        after = np.clip(np.searchsorted(self.times, times), 1, len(self.times) - 1)
        before = after - 1
        gap = np.maximum(times - self.times[before], self.times[after] - times)
        within = (times >= self.times[0]) & (times <= self.times[-1]) & (gap < MAX_GAP_NS / 1e9)
        return np.where(within & (self._breaks[before] == self._breaks[after]), self._breaks[after], -1)


@dataclass(frozen=True)
class Offset:
    """Seconds to add to times of the track to get times of the camera (both since their starts); its correlation."""

    seconds: float
    correlation: float


def find_offsets(motion: CameraMotion, track: PoseTrack, between: tuple[float, float] | None = None) -> list[Offset]:
    """Return the offsets at which the two angular speeds match, best first; one, unless the motion repeats.

    Times of the camera count from its first image, those of the track from its first pose. `between`: only offsets in
    this range, in seconds. Raises StereovoxError if no offset fits.
    """
    _check_span("images", (motion.stamps_ns[-1] - motion.stamps_ns[0]) / 1e9)
    _check_span("poses", track.times[-1])
    lags, correlation = _correlate(_camera_speed(motion), _track_speed(track, _frame_time(motion)))
    offsets = lags * STEP
    allowed = np.isfinite(correlation)
    if between is not None:
        allowed &= (offsets >= between[0]) & (offsets <= between[1])
    if not allowed.any():
        raise StereovoxError("clocks: at no allowed offset do images and poses overlap enough; record both together")
    correlation = np.where(allowed, correlation, -1.0)
    best = float(correlation.max())
    if best < MIN_CORRELATION:
        found = f"the best correlation of the angular speeds is {best:.2f}, below {MIN_CORRELATION:g}"
        cure = "the recordings do not overlap, or turn too little; record both together and turn irregularly"
        raise StereovoxError(f"clocks: {found}; {cure}")
    chosen: list[int] = []
    left = correlation.copy()
    while len(chosen) < MAX_RIVALS and left.max() >= max(MIN_CORRELATION, RIVAL_SHARE * best):
        chosen.append(int(np.argmax(left)))
        left[np.abs(offsets - offsets[chosen[-1]]) < RIVAL_GAP_S] = -1.0
    return [Offset(float(offsets[k] + STEP * _peak(correlation, k)), float(correlation[k])) for k in chosen]


def _poses_to_average(times: NDArray[np.float64]) -> int:
    """Return the odd number of poses within SMOOTH; one if they are too sparse or too few."""
    count = int(SMOOTH / np.median(np.diff(times))) // 2 * 2 + 1
    return count if len(times) > 2 * count else 1


def _quaternions(poses: Poses) -> NDArray[np.float64]:
    """Return (N, 4) unit quaternions, neighbours on the same side of the sphere."""
    from scipy.spatial.transform import Rotation

    quaternions = Rotation.from_matrix(poses.T_world_body[:, :3, :3]).as_quat()
    sides = np.where(np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0, -1.0, 1.0)
    return quaternions * np.cumprod(np.concatenate([[1.0], sides]))[:, None]


def _averages(values: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Return the running means (N - count + 1, K) over `count` rows of (N, K)."""
    return np.lib.stride_tricks.sliding_window_view(values, count, axis=0).mean(axis=-1)


def _check_span(what: str, seconds: float) -> None:
    if not STEP < seconds < MAX_SPAN_S:
        cure = "record for some seconds, and remove what has a wrong time (longest: a day)"
        raise StereovoxError(f"clocks: the {what} span {seconds:.9g} s from first to last; {cure}")


def _frame_time(motion: CameraMotion) -> float:
    return float(np.median(np.diff(motion.stamps_ns))) / 1e9


def _camera_speed(motion: CameraMotion) -> NDArray[np.float64]:
    """Return the angular speed in rad/s each STEP from the first image on, NaN if unknown."""
    times = (motion.stamps_ns - motion.stamps_ns[0]) / 1e9
    spans = np.diff(times)
    usual = (spans > 0) & (spans <= max(0.25, 3 * np.median(spans)))
    speeds = np.where(usual, angles(motion.steps[:, :3, :3]) / np.where(usual, spans, 1), np.nan)
    samples = np.arange(0, times[-1], STEP)
    return speeds[np.clip(np.searchsorted(times, samples, side="right") - 1, 0, len(speeds) - 1)]


def _track_speed(track: PoseTrack, window: float) -> NDArray[np.float64]:
    """Return the angular speed in rad/s each STEP from the first pose on, as seen by a camera with this frame time."""
    samples = np.arange(0, track.times[-1], STEP)
    before, after = samples - window / 2, samples + window / 2
    turned = np.swapaxes(track.at(before)[:, :3, :3], 1, 2) @ track.at(after)[:, :3, :3]
    parts = track.parts(before)
    known = (parts >= 0) & (parts == track.parts(after))
    return np.where(known, angles(turned) / window, np.nan)


def _correlate(a: NDArray[np.float64], b: NDArray[np.float64]) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Return lags and Pearson's correlation between a[i + lag] and b[i] over the samples both know.

    NaN if fewer samples than OVERLAP of the shorter one are common, or one of them is constant.
    """
    from scipy.signal import correlate, correlation_lags

    valid_a, valid_b = np.isfinite(a).astype(float), np.isfinite(b).astype(float)
    a, b = (np.nan_to_num(x - np.nanmean(x)) if np.isfinite(x).any() else np.zeros(len(x)) for x in (a, b))

    def cross(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        return correlate(x, y, "full", "fft")

    count = np.rint(cross(valid_a, valid_b))
    fewest = max(OVERLAP * min(valid_a.sum(), valid_b.sum()), 50)
    n = np.where(count >= fewest, count, np.nan)
    sum_a, sum_b = cross(a, valid_b), cross(valid_a, b)
    spread_a = cross(a * a, valid_b) - sum_a**2 / n
    spread_b = cross(valid_a, b * b) - sum_b**2 / n
    least = 1e-6 * n
    spread = np.where((spread_a > least) & (spread_b > least), spread_a * spread_b, np.nan)
    return correlation_lags(len(a), len(b), "full"), (cross(a, b) - sum_a * sum_b / n) / np.sqrt(spread)


def _peak(values: NDArray[np.float64], k: int) -> float:
    """Return the offset, in samples, from sample `k` to the peak of the parabola through it and its neighbours."""
    if not 0 < k < len(values) - 1:
        return 0.0
    left, middle, right = values[k - 1 : k + 2]
    bend = left - 2 * middle + right
    return float(np.clip((left - right) / (2 * bend), -0.5, 0.5)) if bend < 0 else 0.0
