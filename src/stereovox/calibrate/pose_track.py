# SPDX-License-Identifier: Apache-2.0
"""Poses of a tracker at many times at once, and where they may be trusted."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import StereovoxError
from stereovox.sources.poses import MAX_GAP_NS, Poses
from stereovox.sources.tracker import jumps

SMOOTH = 0.03
"""Seconds; a hand that swings twice a second loses 0.6 % of its turns by that."""


class PoseTrack:
    """Poses interpolated as `Poses.at` does, vectorised; times in seconds since `start_ns`.

    Poses below `min_confidence` and those that cannot be used are left out; a jump divides the track. A tracker's poses
    tremble from one to the next, by which no offset finer than their distance could be found, so each is the mean of
    those within `SMOOTH` around it.
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
        """Return (N, 4, 4) T_world_body at (N,) times; those beyond either end get the pose at that end."""
        times = np.clip(times, self.times[0], self.times[-1])
        T = np.zeros((len(times), 4, 4))
        T[:, 3, 3] = 1
        T[:, :3, :3] = self._rotations(times).as_matrix()
        T[:, :3, 3] = np.stack([np.interp(times, self.times, axis) for axis in self._positions.T], axis=1)
        return T

    def parts(self, times: NDArray[np.float64]) -> NDArray[np.intp]:
        """Return for (N,) times which part of the track between two jumps they lie in; -1 where no pose is near."""
        after = np.clip(np.searchsorted(self.times, times), 1, len(self.times) - 1)
        before = after - 1
        gap = np.maximum(times - self.times[before], self.times[after] - times)
        within = (times >= self.times[0]) & (times <= self.times[-1]) & (gap < MAX_GAP_NS / 1e9)
        return np.where(within & (self._breaks[before] == self._breaks[after]), self._breaks[after], -1)


def _poses_to_average(times: NDArray[np.float64]) -> int:
    """Return the odd number of poses that SMOOTH holds; one where they come too slowly or there are too few."""
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
