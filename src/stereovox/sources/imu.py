# SPDX-License-Identifier: Apache-2.0
"""The readings of an inertial measurement unit (IMU) next to a camera: angular rate and specific force."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace
from threading import Lock
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.errors import SourceError, StereovoxError
from stereovox.geometry.se3 import Transform, rigidity_error

RIGID = 1e-3
"""Largest rigidity error of a mount."""
KEPT = 20_000
"""Readings of a live IMU that are kept: 50 s at 400 Hz."""
ACROSS_S = 0.1
"""Longest time between two accelerations that is interpolated."""
GRAVITY = 9.0, 10.6
"""Range in m/s^2 for the length of a mean specific force that is used as the up direction."""


class Imu(Protocol):
    """An IMU mounted on a camera: `ImuReadings` of a recording, `LiveImu` of a connected camera."""

    @property
    def name(self) -> str:
        """Origin of the readings, for messages."""
        ...

    def between(self, begin_ns: int, end_ns: int) -> ImuReadings:
        """Return the readings that cover a span of time, as far as available.

        Args:
            begin_ns: Its start in nanoseconds, by the clock of the images.
            end_ns: Its end.

        Returns:
            Readings inside, the last one before and the first one after; perhaps none.
        """
        ...


@dataclass(frozen=True, eq=False, repr=False)
class ImuReadings:
    """Readings of an IMU over time, by the clock of the images.

    Attributes:
        stamps_ns: (N,) int64 nanoseconds, ascending.
        angular_rate: (N, 3) float64 rad/s about the IMU's axes, finite.
            specific_force: (N, 3) float64 m/s^2 along the IMU's axes: an accelerometer's reading, at rest 9.8 upwards;
                NaN if missing.
            T_sensor_imu: (4, 4) float64, maps the IMU's frame into the optical frame of the images; only its rotation
                is used.
            name: Origin of the readings, for messages.

        Raises:
            StereovoxError: An attribute is invalid.
    """

    stamps_ns: NDArray[np.int64]
    angular_rate: NDArray[np.float64]
    specific_force: NDArray[np.float64]
    T_sensor_imu: Transform = field(default_factory=lambda: np.eye(4))
    name: str = "IMU"

    def __post_init__(self) -> None:
        for key, dtype in {"stamps_ns": np.int64, "angular_rate": np.float64, "specific_force": np.float64}.items():
            object.__setattr__(self, key, np.asarray(getattr(self, key), dtype))
        count = len(self.stamps_ns)
        if self.stamps_ns.ndim != 1 or np.any(np.diff(self.stamps_ns) <= 0):
            raise StereovoxError(f"{self.name}: stamps_ns must be (N,) nanoseconds, ascending; sort them")
        for key in ("angular_rate", "specific_force"):
            if getattr(self, key).shape != (count, 3):
                raise StereovoxError(f"{self.name}: {key} has shape {getattr(self, key).shape}; give ({count}, 3)")
        if not np.isfinite(self.angular_rate).all():
            raise StereovoxError(f"{self.name}: angular_rate must be finite rad/s; leave other readings out")
        if not rigidity_error(self.T_sensor_imu) < RIGID:
            raise StereovoxError(
                f"{self.name}: T_sensor_imu is not a rigid motion; give a (4, 4) rotation and translation"
            )

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def __repr__(self) -> str:
        return f"<ImuReadings: {len(self):,} of {self.name}, {self.rate_hz:.0f} a second>"

    @property
    def rate_hz(self) -> float:
        """Median number of readings per second; 0 with fewer than two."""
        return 1e9 / float(np.median(np.diff(self.stamps_ns))) if len(self) > 1 else 0.0

    def between(self, begin_ns: int, end_ns: int) -> ImuReadings:
        """Return the readings that cover a span of time; see `Imu`."""
        first = max(int(np.searchsorted(self.stamps_ns, begin_ns, "right")) - 1, 0)
        last = int(np.searchsorted(self.stamps_ns, end_ns, "left")) + 1
        part = slice(first, last)
        return replace(
            self,
            stamps_ns=self.stamps_ns[part],
            angular_rate=self.angular_rate[part],
            specific_force=self.specific_force[part],
        )


def checked_imu(where: str, option: str) -> str:
    """Return the option `imu` of a recording with one IMU: `off` or nothing; raises SourceError for anything else."""
    if option not in ("", "off"):
        raise SourceError(f"{where}: imu={option} must be off, or left out")
    return option


def in_order(
    stamps_ns: ArrayLike, angular_rate: ArrayLike, specific_force: ArrayLike, T_sensor_imu: Transform, name: str
) -> ImuReadings:
    """Return readings of a file, sorted, without repeated times and without non-finite angular rates.

    Args as the attributes of `ImuReadings`. Raises SourceError if fewer than two are left.
    """
    stamps = np.asarray(stamps_ns, np.int64)
    rate, force = (np.asarray(rows, float).reshape(-1, 3) for rows in (angular_rate, specific_force))
    known = np.flatnonzero(np.isfinite(rate).all(axis=1))
    _, first = np.unique(stamps[known], return_index=True)
    kept = known[first]
    if len(kept) < 2:
        raise SourceError(f"{name}: holds {len(kept)} usable readings; leave the IMU out with imu=off")
    return ImuReadings(stamps[kept], rate[kept], force[kept], T_sensor_imu, name)


def at_times(stamps_ns: NDArray[np.int64], values: NDArray[np.float64], wanted_ns: ArrayLike) -> NDArray[np.float64]:
    """Return values (N, 3) of ascending times, linearly interpolated at other times (M,).

    NaN before the first, after the last and if neighbours are more than ACROSS_S apart.
    """
    wanted = np.asarray(wanted_ns, np.int64)
    if not len(stamps_ns):
        return np.full((len(wanted), 3), np.nan)
    x, at = (stamps_ns - stamps_ns[0]) / 1e9, (wanted - stamps_ns[0]) / 1e9
    found = np.column_stack([np.interp(at, x, column, np.nan, np.nan) for column in values.T])
    if len(stamps_ns) > 1:
        after = np.clip(np.searchsorted(stamps_ns, wanted), 1, len(stamps_ns) - 1)
        apart = stamps_ns[after] - stamps_ns[after - 1] > ACROSS_S * 1e9
        found[apart & ~np.isin(wanted, stamps_ns)] = np.nan
    return found


def up_of_force(force: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return the unit vector (3,) along a mean force, in m/s^2; None if its length is not that of gravity."""
    length = float(np.linalg.norm(force))
    return force / length if GRAVITY[0] <= length <= GRAVITY[1] else None


class LiveImu:
    """An IMU whose readings arrive one by one; one thread may add some while another reads.

    Args:
        T_sensor_imu: (4, 4), as in `ImuReadings`.
        name: Origin of the readings, for messages.
    """

    def __init__(self, T_sensor_imu: Transform | None = None, name: str = "IMU"):
        self.name = name
        self._mount = np.eye(4) if T_sensor_imu is None else np.asarray(T_sensor_imu, float)
        self._turns: deque[tuple[int, ArrayLike]] = deque(maxlen=KEPT)
        self._forces: deque[tuple[int, ArrayLike]] = deque(maxlen=KEPT)
        self._lock = Lock()
        _arrays([], [], self._mount, name)  # refuses an invalid mount

    def add_angular_rate(self, stamp_ns: int, rate: ArrayLike) -> None:
        """Add a reading of the gyroscope: (3,) rad/s; ignored if it is not later than the last, or not finite.

        Args:
            stamp_ns: Its time in nanoseconds, by the clock of the images.
            rate: About the IMU's axes.
        """
        self._add(self._turns, stamp_ns, rate)

    def add_specific_force(self, stamp_ns: int, force: ArrayLike) -> None:
        """Add a reading of the accelerometer: (3,) m/s^2, as `add_angular_rate`.

        Args:
            stamp_ns: Its time in nanoseconds, by the clock of the images.
            force: Along the IMU's axes, at rest 9.8 upwards.
        """
        self._add(self._forces, stamp_ns, force)

    def _add(self, kept: deque[tuple[int, ArrayLike]], stamp_ns: int, numbers: ArrayLike) -> None:
        row = np.asarray(numbers, float)
        if row.shape != (3,):
            raise StereovoxError(f"{self.name}: a reading of shape {row.shape}; give 3 numbers")
        with self._lock:
            if np.isfinite(row).all() and (not kept or stamp_ns > kept[-1][0]):
                kept.append((int(stamp_ns), row))

    @property
    def seconds(self) -> float:
        """Time span of the gyroscope's readings."""
        with self._lock:
            return (self._turns[-1][0] - self._turns[0][0]) / 1e9 if self._turns else 0.0

    def between(self, begin_ns: int, end_ns: int) -> ImuReadings:
        """Return the readings that cover a span of time; see `Imu`."""
        with self._lock:
            turns, forces = _around(self._turns, begin_ns, end_ns), _around(self._forces, begin_ns, end_ns)
        return _arrays(turns, forces, self._mount, self.name).between(begin_ns, end_ns)


def _around(kept: deque[tuple[int, ArrayLike]], begin_ns: int, end_ns: int) -> list[tuple[int, ArrayLike]]:
    """Return readings that cover a span, in order; searched from the newest, since the span is usually the latest."""
    found = []
    for one in reversed(kept):
        if one[0] > end_ns + ACROSS_S * 1e9:
            continue
        found.append(one)
        if one[0] < begin_ns - ACROSS_S * 1e9:
            break
    return found[::-1]


def _arrays(
    turns: list[tuple[int, ArrayLike]], forces: list[tuple[int, ArrayLike]], mount: Transform, name: str
) -> ImuReadings:
    stamps, at = (np.array([stamp for stamp, _ in rows], np.int64) for rows in (turns, forces))
    rate, force = (np.array([row for _, row in rows], float).reshape(-1, 3) for rows in (turns, forces))
    return ImuReadings(stamps, rate, at_times(at, force, stamps), mount, name)
