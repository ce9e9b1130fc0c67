# SPDX-License-Identifier: Apache-2.0
"""Camera rotation from a gyroscope, and the up direction from an accelerometer.

Angular rates are integrated between images with the derivative with respect to their bias, as Forster et al. 2017 do
("On-Manifold Preintegration"); positions are not, because an error of 0.1 m/s^2 of gravity is 0.2 m after 2 s.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import SourceError
from stereovox.geometry.se3 import rotation_matrix, rotation_vector
from stereovox.sources.base import Stream
from stereovox.sources.imu import Imu, ImuReadings, up_of_force

DENSITY = 5e-4
"""Noise of the angular rate in rad/s per root hertz: three times that of a small gyroscope."""
SHARE = 0.02
"""Relative error of a turn: scale, axes that are not orthogonal, mount."""
CLOCK_S = 0.003
"""Seconds between the clock of the IMU and the middle of the exposure."""
BENDS = 0.25
"""Largest deviation of the rate from linear interpolation, as a share of the change between two readings."""
BIAS, SETTLED, WANDERS, NO_BIAS = 0.02, 0.002, 1e-3, 0.1
"""Bias of the angular rate in rad/s: initial and least standard deviation, its random walk in a second, and the value
above which it is no bias but a wrong clock or unit."""
HOLDS_S, BRIDGES_S = 0.02, 0.5
"""How long the first and last readings are valid, and the longest gap that is bridged."""
WINDOW_S, TURNED, WINDOWS = 2.0, 0.05, 3
"""Turns of images and gyroscope are compared after this many seconds or radians; agreement needs this many turns."""
AGREES, DIFFERS, FADES = 0.25, 0.5, 0.9
"""Relative difference below which the gyroscope is trusted and above which it is left out; decay of older windows."""
WORST = 100.0
"""Cap on one window's squared error, relative to the expected one."""
AROUND_S, AT_REST_S, LEAST_S = 3.0, 0.5, 2.0
"""Seconds around an image whose readings give up; length of a rest; least length while moving."""
REST_FORCE, REST_RATE, FEWEST = 0.15, 0.05, 5
"""Standard deviation in m/s^2 and mean rate in rad/s up to which a camera is at rest, and fewest readings."""
RESTING, MOVING = np.radians(1), np.radians(5)
"""Largest error of up from an accelerometer at rest, and from the average of a moving one."""
HALVES = np.radians(5)
"""Largest angle between up from the first half of the readings and from the second."""


class Turn(NamedTuple):
    """Rotation of a camera between two times.

    R: (3, 3) R_before_now. by_bias: (3, 3), the derivative of its rotation vector, along the axes of the camera now,
    with respect to the bias along the camera's axes. seconds: duration. noise: variance in square radians about each
    axis of errors that average out; drift: standard deviation in radians of those that do not, except the bias.
    """

    R: NDArray[np.float64]
    by_bias: NDArray[np.float64]
    seconds: float
    noise: float
    drift: float

    def then(self, other: Turn) -> Turn:
        """Return this turn followed by another."""
        return Turn(
            self.R @ other.R,
            other.R.T @ self.by_bias + other.by_bias,
            self.seconds + other.seconds,
            self.noise + other.noise,
            self.drift + other.drift,
        )


STILL = Turn(np.eye(3), np.zeros((3, 3)), 0.0, 0.0, 0.0)


def integrate(imu: Imu, begin_ns: int, end_ns: int, bias: NDArray[np.float64]) -> Turn | None:
    """Return the camera's rotation by the gyroscope; None if its readings do not cover the time.

    bias: (3,) rad/s along the camera's axes, subtracted from the readings.
    """
    readings = imu.between(begin_ns, end_ns)
    stamps = readings.stamps_ns
    if end_ns <= begin_ns or not _covers(stamps, begin_ns, end_ns):
        return None
    inside = stamps[(stamps > begin_ns) & (stamps < end_ns)]
    seconds = (np.concatenate([[begin_ns], inside, [end_ns]]) - begin_ns) / 1e9
    rates = _rates(readings, begin_ns, seconds) - bias
    R, by_bias, steps = np.eye(3), np.zeros((3, 3)), np.diff(seconds)
    for rate, dt in zip((rates[1:] + rates[:-1]) / 2, steps, strict=True):
        step = rotation_matrix(rate * dt)
        R, by_bias = R @ step, step.T @ by_bias - np.eye(3) * dt
    turned = np.linalg.norm(rates[1:] + rates[:-1], axis=1) / 2 @ steps
    bent = np.linalg.norm(np.diff(rates, axis=0), axis=1) @ steps
    change = float(np.linalg.norm(rates[-1] - rates[0]))
    drift = SHARE * turned + BENDS * bent + CLOCK_S * change
    return Turn(R, by_bias, float(seconds[-1]), DENSITY**2 * float(seconds[-1]), float(drift))


def _covers(stamps: NDArray[np.int64], begin_ns: int, end_ns: int) -> bool:
    if len(stamps) < 2 or stamps[0] > begin_ns + HOLDS_S * 1e9 or stamps[-1] < end_ns - HOLDS_S * 1e9:
        return False
    return bool(np.diff(stamps).max() <= BRIDGES_S * 1e9)


def _rates(readings: ImuReadings, begin_ns: int, seconds: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return angular rates (M, 3) along the camera's axes at times after the beginning."""
    at = (readings.stamps_ns - begin_ns) / 1e9
    found = np.column_stack([np.interp(seconds, at, column) for column in readings.angular_rate.T])
    return found @ readings.T_sensor_imu[:3, :3].T


class Gyroscope:
    """Turns of a camera by its gyroscope; bias, uncertainty and trust are estimated from the images' turns.

    Args:
        imu: Its readings.

    Attributes:
        left_out: Why it is no longer used, in words (its turns contradict the images); "" while it is used.
        used: Number of images whose turn it predicted.
    """

    def __init__(self, imu: Imu):
        self.left_out, self.used = "", 0
        self._imu = imu
        self._bias, self._unsure = np.zeros(3), np.eye(3) * BIAS**2
        self._excess = 1.0  # squared errors relative to the expected ones
        self._off, self._turned, self._windows = 0.0, 0.0, 0
        self._window: tuple[NDArray[np.float64], NDArray[np.float64], Turn] | None = None
        self._latest: tuple[int, int, Turn] | None = None

    @property
    def trusted(self) -> bool:
        """Whether its turns agreed with the images so far."""
        return not self.left_out and self._windows >= WINDOWS and self._off < AGREES * self._turned

    @property
    def use(self) -> str:
        """How it was used so far, in words."""
        if self.left_out:
            return f"left out: {self.left_out}; correct its clock and mount, or add imu=off"
        if not self.used:
            return "not relied on: no turn to compare with that of the images"
        return f"turns of {self.used} images were expected by its gyroscope"

    def turn(self, begin_ns: int, end_ns: int) -> Turn | None:
        """Return the camera's rotation between two times; None if unknown.

        While `begin_ns` stays the same, only new readings are integrated.
        """
        if self.left_out:
            return None
        begun, ended, known = self._latest or (0, 0, STILL)
        if (begun, ended) == (begin_ns, end_ns) and ended > begun:
            return known
        if begun != begin_ns or ended > end_ns or ended == begun:
            ended, known = begin_ns, STILL
        more = integrate(self._imu, ended, end_ns, self._bias)
        if more is None:
            return None
        found = known.then(more)
        self._latest = begin_ns, end_ns, found
        return found

    def doubt(self, turn: Turn) -> NDArray[np.float64]:
        """Return the covariance (3, 3) of a turn in square radians, along the axes of the camera after it."""
        own = np.eye(3) * (turn.noise + turn.drift**2)
        return self._excess * (turn.by_bias @ self._unsure @ turn.by_bias.T + own)

    def interrupt(self) -> None:
        """Compare no turn that spans this time: the images were lost, or begin a new world."""
        self._window = None

    def learn(
        self, turn: Turn | None, before: NDArray[np.float64], now: NDArray[np.float64], covariance: NDArray[np.float64]
    ) -> None:
        """Compare a turn with the images' turn.

        before, now: (3, 3) R_map_camera at its beginning and end by the images. covariance: (3, 3) of `now` in square
        radians, along the map's axes.
        """
        if turn is None:
            self.interrupt()
            return
        begin, first, whole = self._window or (before, covariance, STILL)
        whole = whole.then(turn)
        shown = begin.T @ now
        most = max(np.linalg.norm(rotation_vector(R)) for R in (shown, whole.R))
        if most < TURNED and whole.seconds < WINDOW_S:
            self._window = begin, first, whole
            return
        self._window = None
        self._compare(whole, rotation_vector(whole.R.T @ shown), now.T @ (first + covariance) @ now, float(most))

    def _compare(self, turn: Turn, error: NDArray[np.float64], shown: NDArray[np.float64], most: float) -> None:
        """Update with the excess turn of the images, (3,) with covariance (3, 3); most: radians of the turn."""
        if most >= TURNED:
            self._off = FADES * self._off + float(np.linalg.norm(error))
            self._turned = FADES * self._turned + most
            self._windows += 1
        if self._windows >= WINDOWS and self._off > DIFFERS * self._turned:
            self.left_out = f"its turns differ from those of the images by {self._off / self._turned:.0%}"
            return
        spread = self.doubt(turn) + shown
        worse = min(float(error @ np.linalg.solve(spread, error)) / 3 * self._excess, WORST)
        self._excess = max(FADES * self._excess + (1 - FADES) * worse, 1.0)
        gain = np.linalg.solve(spread, turn.by_bias @ self._unsure).T
        self._bias = self._bias + gain @ error
        self._unsure = self._unsure - gain @ turn.by_bias @ self._unsure
        if np.linalg.norm(self._bias) > NO_BIAS:
            steady = float(np.degrees(np.linalg.norm(self._bias)))
            self.left_out = f"its turns differ from those of the images by {steady:.0f} degrees a second"
        self._unsure += np.eye(3) * (WANDERS**2 * turn.seconds + max(SETTLED**2 - np.trace(self._unsure) / 3, 0.0))


def imu_and_note(stream: Stream) -> tuple[Imu | None, str]:
    """Return the IMU of a tracked recording or camera, and a line about it; None and "" if it has none."""
    try:
        imu = stream.imu()
    except SourceError as error:
        return None, f"the IMU is not used: {error}"
    if imu is None:
        return None, ""
    rate = f", {imu.rate_hz:.0f} readings a second" if isinstance(imu, ImuReadings) else ""
    return imu, f"the IMU helps: turns and which way is up ({imu.name}{rate}); to disable it, add imu=off after a ?"


class UpEstimate(NamedTuple):
    """The up direction. direction: (3,) unit vector in the camera's frame. off: radians by which it may be wrong."""

    direction: NDArray[np.float64]
    off: float


def up_by_force(imu: Imu, stamp_ns: int) -> UpEstimate | None:
    """Return the up direction at a time by the accelerometer.

    Uses the readings around it, rotated by the gyroscope: at rest they measure the force that holds the camera up, and
    so does their average in motion, because no camera accelerates forever. None if there are too few, their mean is not
    as long as gravity, or their halves disagree.
    """
    readings = imu.between(stamp_ns - round(AROUND_S * 1e9), stamp_ns + round(AROUND_S * 1e9))
    felt = np.isfinite(readings.specific_force).all(axis=1)
    if not felt.any() or not _covers(readings.stamps_ns, stamp_ns, stamp_ns):
        return None
    seconds = (readings.stamps_ns - stamp_ns) / 1e9
    R = _attitudes(readings, seconds)
    force = np.einsum("nij,nj->ni", R, readings.specific_force @ readings.T_sensor_imu[:3, :3].T)
    rest = _rest(seconds[felt], force[felt], readings.angular_rate[felt])
    if rest is not None:
        up = up_of_force(rest)
        return None if up is None else UpEstimate(up, RESTING)
    if np.ptp(seconds[felt]) < LEAST_S:
        return None
    half = len(force[felt]) // 2
    parts = force[felt][:half], force[felt][half:], force[felt]
    one, other, both = (up_of_force(part.mean(axis=0)) for part in parts)
    if one is None or other is None or one @ other < np.cos(HALVES):
        return None
    return None if both is None else UpEstimate(both, MOVING)


def _rest(
    seconds: NDArray[np.float64], force: NDArray[np.float64], rate: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Return the mean force (3,) while the camera was at rest, nearest to second 0; None if it never rested."""
    begins = np.arange(seconds[0], seconds[-1] - AT_REST_S + 1e-9, AT_REST_S / 4)
    for begin in sorted(begins, key=lambda begin: abs(begin + AT_REST_S / 2)):
        part = (seconds >= begin) & (seconds <= begin + AT_REST_S)
        still = part.sum() >= FEWEST and np.linalg.norm(rate[part].mean(axis=0)) <= REST_RATE
        if still and force[part].std(axis=0).max() <= REST_FORCE:
            return force[part].mean(axis=0)
    return None


def _attitudes(readings: ImuReadings, seconds: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return rotations (N, 3, 3) from the camera at each reading to the camera at second 0."""
    rates = readings.angular_rate @ readings.T_sensor_imu[:3, :3].T
    steps = np.diff(seconds)[:, None] * (rates[1:] + rates[:-1]) / 2
    R = np.empty((len(seconds), 3, 3))
    R[0] = np.eye(3)
    for k, step in enumerate(steps):
        R[k + 1] = R[k] @ rotation_matrix(step)
    here = int(np.searchsorted(seconds, 0.0).clip(0, len(seconds) - 1))
    R_0_here = rotation_matrix(rates[here] * seconds[here])
    return R_0_here @ R[here].T @ R
