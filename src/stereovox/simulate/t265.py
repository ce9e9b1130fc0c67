# SPDX-License-Identifier: Apache-2.0
"""Sensor model of a RealSense T265: jitter, drift, re-localisation, confidence, and its own clock.

The tracker's file and body have OpenGL axes: x right, y up, z backward. Its world starts at its first pose, with y
against gravity and z against its first heading (Chien 2020, 4.1 and Fig 4.1).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import StereovoxError
from stereovox.geometry.se3 import Transform, inverse
from stereovox.sources.poses.poses import seconds_from_ns

STEP_S = 0.05
"""Seconds between steps of the drift, which is slow and interpolated."""
WALK_M = 5.0
"""Metres over which the drift keeps its direction: over shorter distances it grows linearly, then with the square root.
"""
ALIKE = 0.5
"""Largest difference of headings, as a cosine (60 degrees), at which a place is recognised."""
SPACING_M = 0.3
"""Metres between remembered places."""
RATE_HZ = 200
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""T_opengl_optical: turns optical axes (x right, y down, z forward) into OpenGL ones; its own inverse."""
FAILED, LOW, MEDIUM, HIGH = range(4)
"""Confidence of a pose."""


@dataclass(frozen=True)
class Drift:
    """Drift and re-localisation of a tracker.

    share: error per metre travelled, in all directions (0.01 is a good tracker's); yaw_deg: drift of the heading over
    one metre, in degrees; it grows with the square root of the distance. Gravity keeps roll and pitch right.
    find_again_m: distance within which a visited place is recognised (0: never), if the path since is longer than
    `loop_m`; pull_s: time in which two thirds of the error since then are removed. Chien 2020, 2.2.3: the pose "will
    become more precise upon further visits to the same area".
    """

    share: float = 0.01
    yaw_deg: float = 0.05
    find_again_m: float = 0.8
    loop_m: float = 5.0
    pull_s: float = 0.7


@dataclass(frozen=True)
class T265:
    """A model of the tracker. `seed` determines all its noise.

    jitter_m, jitter_deg: standard deviation of the noise of each axis; jitter_s: its correlation time. drift: drift
    and recognition of places; see `Drift`. settle_s: for this long the confidence is low and the jitter five times
    larger, unless the camera has moved 0.3 m before; Chien 2020, 2.2.3: "low at the beginning and improves as the
    camera starts moving".
    clock_offset_s, clock_drift_ppm: camera time = tracker time + clock_offset_s, at the first pose; from then on the
    tracker's clock gains this many millionths.
    jump_s, jump_m: at this time (None: never) the position jumps sideways by this many metres, until it recognises a
    place. lost_s: start and end (None: never) of low confidence and twenty times larger jitter. Times
    count from the first pose.
    """

    seed: int = 0
    jitter_m: float = 0.001
    jitter_deg: float = 0.05
    jitter_s: float = 0.03
    drift: Drift = Drift()
    settle_s: float = 2.0
    clock_offset_s: float = 0.0
    clock_drift_ppm: float = 5.0
    jump_s: float | None = None
    jump_m: float = 0.3
    lost_s: tuple[float, float] | None = None

    def track(self, stamps_ns: NDArray[np.int64], T_world_tracker: NDArray[np.float64]) -> Track:
        """Return the tracker's report for its true poses.

        stamps_ns: (N,) ascending, on the camera's clock, usually 5 ms apart. T_world_tracker: (N, 4, 4) of the body in
        optical axes, world z up. Raises StereovoxError for fewer than two poses and stamps that do not ascend.
        """
        if len(stamps_ns) < 2 or np.any(np.diff(stamps_ns) <= 0):
            raise StereovoxError("a track needs two poses or more, and stamps that ascend")
        truth = start_frame(T_world_tracker[0]) @ T_world_tracker @ OPENGL
        seconds = (stamps_ns - stamps_ns[0]) / 1e9
        random = np.random.default_rng(self.seed)
        shift, yaw = drifted(self.drift, seconds, truth, self._jumps(seconds), random)
        confidence = self._confidence(seconds, truth)
        positions, quaternions = self._report(truth, shift, yaw, self._unrest(seconds, confidence), random)
        return Track(self._clock(stamps_ns), positions, quaternions, confidence, truth)

    def _clock(self, stamps_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        gained = np.rint((stamps_ns - stamps_ns[0]) * self.clock_drift_ppm * 1e-6).astype(np.int64)
        return stamps_ns - round(self.clock_offset_s * 1e9) + gained

    def _jumps(self, seconds: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the jump (N,) of the position in metres at each pose."""
        jumps = np.zeros(len(seconds))
        if self.jump_s is not None and self.jump_s <= seconds[-1]:
            jumps[np.searchsorted(seconds, self.jump_s)] = self.jump_m
        return jumps

    def _confidence(self, seconds: NDArray[np.float64], truth: NDArray[np.float64]) -> NDArray[np.uint8]:
        moved = np.linalg.norm(truth[:, :3, 3] - truth[0, :3, 3], axis=1)
        progress = np.maximum.accumulate(np.maximum(moved / 0.3, seconds / max(self.settle_s, 1e-9)))
        confidence = np.select([progress < 0.5, progress < 1], [LOW, MEDIUM], HIGH).astype(np.uint8)
        if self.lost_s is not None:
            confidence[(seconds >= self.lost_s[0]) & (seconds < self.lost_s[1])] = LOW
        return confidence

    def _unrest(self, seconds: NDArray[np.float64], confidence: NDArray[np.uint8]) -> NDArray[np.float64]:
        """Return the factor (N,) on the jitter."""
        unrest = np.where(confidence < HIGH, 5.0, 1.0)
        if self.lost_s is not None:
            unrest[(seconds >= self.lost_s[0]) & (seconds < self.lost_s[1])] = 20.0
        return unrest

    def _report(
        self,
        truth: NDArray[np.float64],
        shift: NDArray[np.float64],
        yaw: NDArray[np.float64],
        unrest: NDArray[np.float64],
        random: np.random.Generator,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return positions (N, 3) and quaternions (N, 4) with all errors."""
        from scipy.spatial.transform import Rotation

        trembles = unrest[:, None] * _alike(random.standard_normal((len(truth), 6)), self.jitter_s * RATE_HZ)
        about_y = Rotation.from_rotvec(yaw[:, None] * [0.0, 1.0, 0.0])
        tremble = Rotation.from_rotvec(np.radians(self.jitter_deg) * trembles[:, 3:])
        turned = about_y * Rotation.from_matrix(truth[:, :3, :3]) * tremble
        return truth[:, :3, 3] + shift + self.jitter_m * trembles[:, :3], turned.as_quat()


@dataclass(frozen=True, eq=False)
class Track:
    """The reported and the true poses of a tracker.

    stamps_ns: (N,) int64, the tracker's own clock. positions: (N, 3) metres. quaternions: (N, 4) x, y, z, w.
    confidence: (N,) uint8, 0 (failed) to 3 (high). All in OpenGL axes, tracker to the tracker's world.
    truth: (N, 4, 4) the exact poses, in the same axes and the same world.
    """

    stamps_ns: NDArray[np.int64]
    positions: NDArray[np.float64]
    quaternions: NDArray[np.float64]
    confidence: NDArray[np.uint8]
    truth: NDArray[np.float64]

    @cached_property
    def errors_m(self) -> NDArray[np.float64]:
        """Distance (N,) of each position from the true one, in metres."""
        return np.linalg.norm(self.positions - self.truth[:, :3, 3], axis=1)


def drifted(
    drift: Drift,
    seconds: NDArray[np.float64],
    poses: NDArray[np.float64],
    jumps_m: NDArray[np.float64],
    random: np.random.Generator,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the errors of position (N, 3) in metres and of heading (N,) in radians about y.

    seconds: (N,). poses: (N, 4, 4) in OpenGL axes, y up. jumps_m: (N,) sudden sideways errors.
    """
    steps = np.unique(np.append(np.arange(0, len(seconds), _stride(seconds)), len(seconds) - 1))
    coarse = _walk(drift, seconds[steps], poses[steps], _sudden(jumps_m, steps), random)
    fine = np.stack([np.interp(seconds, seconds[steps], column) for column in coarse.T], axis=1)
    for k in np.flatnonzero(jumps_m):  # interpolation would turn it into a ramp
        after = int(np.searchsorted(steps, k))
        between = np.arange(steps[max(after - 1, 0)], steps[after])
        fine[between] = np.where((between < k)[:, None], coarse[max(after - 1, 0)], coarse[after])
    return fine[:, :3], fine[:, 3]


def start_frame(T_world_first: Transform) -> Transform:
    """Return T_start_world (4, 4): the tracker's world, derived from its first pose, in OpenGL axes.

    T_world_first: body in optical axes, world z up. Raises StereovoxError if it has no heading.
    """
    ahead = T_world_first[:3, 2] * [1, 1, 0]
    if np.linalg.norm(ahead) < 1e-6:
        raise StereovoxError("a tracker that starts pointing straight up or down has no heading; start it level")
    back, up = -ahead / np.linalg.norm(ahead), np.array([0.0, 0, 1])
    T_world_start = np.eye(4)
    T_world_start[:3, :3] = np.column_stack([np.cross(up, back), up, back])
    T_world_start[:3, 3] = T_world_first[:3, 3]
    return inverse(T_world_start)


def write_track(path: Path, track: Track) -> None:
    """Write lines `stamp tx ty tz qx qy qz qw confidence`: seconds, metres, the quaternion, 0 to 3."""
    rows = zip(track.stamps_ns, track.positions, track.quaternions, track.confidence, strict=True)
    lines = (
        f"{seconds_from_ns(int(stamp))} {' '.join(f'{n:.9f}' for n in (*position, *quaternion))} {confidence}"
        for stamp, position, quaternion, confidence in rows
    )
    path.write_text("# stamp tx ty tz qx qy qz qw confidence\n" + "\n".join(lines) + "\n", "utf-8")


@dataclass
class _Places:
    """The tracker's memory: places, headings, distance travelled, and its errors there."""

    where: list[NDArray[np.float64]] = field(default_factory=list)
    ahead: list[NDArray[np.float64]] = field(default_factory=list)
    way: list[float] = field(default_factory=list)
    error: list[NDArray[np.float64]] = field(default_factory=list)

    def remember(self, T: NDArray[np.float64], way: float, error: NDArray[np.float64]) -> None:
        if not self.way or way - self.way[-1] >= SPACING_M:
            self.where.append(T[:3, 3])
            self.ahead.append(-T[:3, 2])
            self.way.append(way)
            self.error.append(error)

    def find(self, T: NDArray[np.float64], way: float, drift: Drift) -> NDArray[np.float64] | None:
        """Return the errors at the earliest recognised place, else None."""
        old = int(np.searchsorted(self.way, way - drift.loop_m)) if drift.find_again_m else 0
        if not old:
            return None
        near = np.linalg.norm(np.array(self.where[:old]) - T[:3, 3], axis=1) < drift.find_again_m
        known = near & (np.array(self.ahead[:old]) @ -T[:3, 2] > ALIKE)
        return self.error[int(np.argmax(known))] if known.any() else None


def _stride(seconds: NDArray[np.float64]) -> int:
    return max(1, round(STEP_S / float(np.median(np.diff(seconds)))))


def _sudden(jumps_m: NDArray[np.float64], steps: NDArray[np.intp]) -> NDArray[np.float64]:
    """Return the jumps (S,) between each step and the one before."""
    total = np.cumsum(jumps_m)[steps]
    return np.diff(total, prepend=0.0)


def _walk(
    drift: Drift,
    seconds: NDArray[np.float64],
    poses: NDArray[np.float64],
    jumps_m: NDArray[np.float64],
    random: np.random.Generator,
) -> NDArray[np.float64]:
    """Return the errors (S, 4): x, y, z and heading, step by step."""
    places, error, way = _Places(), np.zeros(4), 0.0
    course = random.standard_normal(3) / np.sqrt(3)
    errors = [error]
    places.remember(poses[0], way, error)
    for k in range(1, len(poses)):
        move = poses[k, :3, 3] - poses[k - 1, :3, 3]
        length = float(np.linalg.norm(move))
        way += length
        keep = np.exp(-length / WALK_M)
        course = keep * course + np.sqrt((1 - keep**2) / 3) * random.standard_normal(3)
        error = error + _step(drift, error[3], move, length, course, random)
        error[0] += jumps_m[k]
        found = places.find(poses[k], way, drift)
        if found is not None:
            error = error + (found - error) * (1 - np.exp((seconds[k - 1] - seconds[k]) / drift.pull_s))
        else:
            places.remember(poses[k], way, error)
        errors.append(error)
    return np.array(errors)


def _step(
    drift: Drift,
    yaw: float,
    move: NDArray[np.float64],
    length: float,
    course: NDArray[np.float64],
    random: np.random.Generator,
) -> NDArray[np.float64]:
    """Return the errors (4,) added by one step: a wrong heading also displaces the position."""
    cosine, sine = np.cos(yaw), np.sin(yaw)
    astray = [(cosine - 1) * move[0] + sine * move[2], 0.0, (cosine - 1) * move[2] - sine * move[0]]
    turn = np.radians(drift.yaw_deg) * np.sqrt(length) * random.standard_normal()
    return np.append(drift.share * length * course + astray, turn)


def _alike(white: NDArray[np.float64], steps: float) -> NDArray[np.float64]:
    """Return noise (N, K) of the same variance, correlated over this many steps (first-order low pass)."""
    from scipy.signal import lfilter

    keep = np.exp(-1 / steps) if steps > 0 else 0.0
    start = white[0] * keep
    smooth, _ = lfilter([np.sqrt(1 - keep**2)], [1, -keep], white[1:], axis=0, zi=start[None, :])
    return np.concatenate([white[:1], smooth])
