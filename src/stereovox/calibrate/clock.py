# SPDX-License-Identifier: Apache-2.0
"""The offset between two clocks, from how fast two devices on one body turn: that needs no extrinsics."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereovox.calibrate.odometry import CameraMotion
from stereovox.calibrate.pose_track import PoseTrack
from stereovox.errors import StereovoxError
from stereovox.sources.tracker import angles

STEP = 0.01
"""Seconds between the samples that are compared."""
OVERLAP = 0.5
"""Share of the shorter recording that must lie within the other."""
CLEAR = 0.6
"""Least correlation of a match."""
APART, ALMOST, MOST = 0.3, 0.85, 5
"""Other matches that are looked at: so far beside better ones (seconds), so well correlated (share of the best)."""
LONGEST = 86_400.0
"""Seconds; what seems to last longer holds a wrong time, and its samples would fill the memory."""


@dataclass(frozen=True)
class Offset:
    """Seconds to add to times of the track to get times of the camera (both since their starts); its correlation."""

    seconds: float
    correlation: float


def find_offsets(motion: CameraMotion, track: PoseTrack, between: tuple[float, float] | None = None) -> list[Offset]:
    """Return the offsets at which the two angular speeds fit, the best first; one, unless the motion repeats itself.

    Times of the camera count from its first image, those of the track from its first pose. `between`: only offsets in
    this range, in seconds. Raises StereovoxError, one line, where no offset fits.
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
    if best < CLEAR:
        found = f"the best correlation of the angular speeds is {best:.2f}, below {CLEAR:g}"
        cure = "the recordings do not overlap, or turn too little; record both together and turn irregularly"
        raise StereovoxError(f"clocks: {found}; {cure}")
    chosen: list[int] = []
    left = correlation.copy()
    while len(chosen) < MOST and left.max() >= max(CLEAR, ALMOST * best):
        chosen.append(int(np.argmax(left)))
        left[np.abs(offsets - offsets[chosen[-1]]) < APART] = -1.0
    return [Offset(float(offsets[k] + STEP * _peak(correlation, k)), float(correlation[k])) for k in chosen]


def _check_span(what: str, seconds: float) -> None:
    if not STEP < seconds < LONGEST:
        cure = "record for some seconds, and remove what has a wrong time (longest: a day)"
        raise StereovoxError(f"clocks: the {what} span {seconds:.9g} s from first to last; {cure}")


def _frame_time(motion: CameraMotion) -> float:
    return float(np.median(np.diff(motion.stamps_ns))) / 1e9


def _camera_speed(motion: CameraMotion) -> NDArray[np.float64]:
    """Return the angular speed in rad/s each STEP from the first image on, NaN where it is not known."""
    times = (motion.stamps_ns - motion.stamps_ns[0]) / 1e9
    spans = np.diff(times)
    usual = (spans > 0) & (spans <= max(0.25, 3 * np.median(spans)))
    speeds = np.where(usual, angles(motion.steps[:, :3, :3]) / np.where(usual, spans, 1), np.nan)
    samples = np.arange(0, times[-1], STEP)
    return speeds[np.clip(np.searchsorted(times, samples, side="right") - 1, 0, len(speeds) - 1)]


def _track_speed(track: PoseTrack, window: float) -> NDArray[np.float64]:
    """Return the angular speed in rad/s each STEP from the first pose on, as a camera of this frame time sees it."""
    samples = np.arange(0, track.times[-1], STEP)
    before, after = samples - window / 2, samples + window / 2
    turned = np.swapaxes(track.at(before)[:, :3, :3], 1, 2) @ track.at(after)[:, :3, :3]
    parts = track.parts(before)
    known = (parts >= 0) & (parts == track.parts(after))
    return np.where(known, angles(turned) / window, np.nan)


def _correlate(a: NDArray[np.float64], b: NDArray[np.float64]) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Return lags and Pearson's correlation between a[i + lag] and b[i] over the samples both know.

    NaN where fewer samples than OVERLAP of the shorter one are common, or where one of them does not change.
    """
    from scipy.signal import correlate, correlation_lags

    known_a, known_b = np.isfinite(a).astype(float), np.isfinite(b).astype(float)
    a, b = (np.nan_to_num(x - np.nanmean(x)) if np.isfinite(x).any() else np.zeros(len(x)) for x in (a, b))

    def cross(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        return correlate(x, y, "full", "fft")

    count = np.rint(cross(known_a, known_b))
    fewest = max(OVERLAP * min(known_a.sum(), known_b.sum()), 50)
    n = np.where(count >= fewest, count, np.nan)
    sum_a, sum_b = cross(a, known_b), cross(known_a, b)
    spread_a = cross(a * a, known_b) - sum_a**2 / n
    spread_b = cross(known_a, b * b) - sum_b**2 / n
    least = 1e-6 * n
    spread = np.where((spread_a > least) & (spread_b > least), spread_a * spread_b, np.nan)
    return correlation_lags(len(a), len(b), "full"), (cross(a, b) - sum_a * sum_b / n) / np.sqrt(spread)


def _peak(values: NDArray[np.float64], k: int) -> float:
    """Return how far beside sample `k` the top of the parabola through it and its neighbours lies, in samples."""
    if not 0 < k < len(values) - 1:
        return 0.0
    left, middle, right = values[k - 1 : k + 2]
    bend = left - 2 * middle + right
    return float(np.clip((left - right) / (2 * bend), -0.5, 0.5)) if bend < 0 else 0.0
