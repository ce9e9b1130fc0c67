# SPDX-License-Identifier: Apache-2.0
"""The path of the cameras that made a map, thinned for drawing.

The closed loops of a map as lines between places, for drawing; saved with the map.
"""

from __future__ import annotations

import base64
from array import array
from dataclasses import dataclass, field
from math import inf
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.geometry.se3 import Transform, apart, transform_points

SPACING_M = 0.05
"""A pose is kept when the camera has moved this far, or turned by twice as many radians, since the last one."""
MAX_STOPS = 2048
"""Most poses kept of all sensors together; when there are more, the spacing doubles."""
FARTHEST = 1e7
"""Bound of all numbers of a pose; frames farther away than a tenth of it are refused."""
POSE = 12
"""Numbers of a pose."""


class StampedPose(NamedTuple):
    """Pose of a sensor at a time: the 12 numbers of the upper three rows of T_world_sensor, row by row."""

    stamp_ns: int
    pose: tuple[float, ...]


@dataclass
class CameraPath:
    """Poses along the path of each sensor, in the order in which their frames entered the map.

    spacing: least distance of two poses in metres, and half their least angle in radians. stops: poses by sensor,
    rounded to float32, as they are saved.
    """

    spacing: float = SPACING_M
    stops: dict[str, list[StampedPose]] = field(default_factory=dict)

    def walk(self, sensor: str, seen: StampedPose) -> None:
        """Add a pose if it is far enough from the last one of its sensor."""
        stops = self.stops.setdefault(sensor, [])
        if stops and not self._is_far(stops[-1], seen):
            return
        stops.append(StampedPose(seen.stamp_ns, tuple(array("f", seen.pose))))
        while sum(map(len, self.stops.values())) > MAX_STOPS:
            self.spacing *= 2
            self.stops = {name: self._thinned(kept) for name, kept in self.stops.items()}

    def poses(self, sensor: str) -> NDArray[np.float64]:
        """Return T_world_sensor (N, 4, 4) of the kept poses of a sensor."""
        matrices = np.tile(np.eye(4), (len(self.stops[sensor]), 1, 1))
        matrices[:, :3] = np.reshape([seen.pose for seen in self.stops[sensor]], (-1, 3, 4))
        return matrices

    def lines(self) -> list[NDArray[np.float64]]:
        """Return the positions (N, 3) in metres, world frame, of each sensor that has any, in frame order."""
        return [self.poses(sensor)[:, :3, 3] for sensor, stops in self.stops.items() if stops]

    def until(self, stamp_ns: float = inf) -> list[tuple[str, Transform]]:
        """Return sensor and T_world_sensor (4, 4) of each pose up to a time in nanoseconds, sensor by sensor."""
        return [
            (sensor, pose)
            for sensor, stops in self.stops.items()
            for seen, pose in zip(stops, self.poses(sensor), strict=True)
            if seen.stamp_ns <= stamp_ns
        ]

    def saved(self) -> dict[str, Any]:
        """Return plain values for JSON, which `loaded` reads; numbers are packed, little-endian, in base64."""
        return {
            "spacing": self.spacing,
            "stops": {
                sensor: {
                    "stamps_ns": _packed([seen.stamp_ns for seen in stops], "<i8"),
                    "poses": _packed([seen.pose for seen in stops], "<f4"),
                }
                for sensor, stops in self.stops.items()
            },
        }

    @classmethod
    def loaded(cls, saved: Any) -> CameraPath:
        """Return a saved path. Raises KeyError, TypeError or ValueError if the values cannot be one."""
        spacing = float(saved["spacing"])
        if not SPACING_M <= spacing < FARTHEST:
            raise ValueError(f"camera_path: invalid spacing {spacing:g}")
        stops = {sensor: _stops_from(one) for sensor, one in saved["stops"].items()}
        if sum(map(len, stops.values())) > MAX_STOPS:
            raise ValueError(f"camera_path: more than {MAX_STOPS} poses")
        return cls(spacing, stops)

    def _is_far(self, before: StampedPose, now: StampedPose) -> bool:
        metres, radians = apart(before.pose, now.pose)
        return metres >= self.spacing or radians >= 2 * self.spacing

    def _thinned(self, stops: list[StampedPose]) -> list[StampedPose]:
        kept = stops[:1]
        for seen in stops[1:]:
            if self._is_far(kept[-1], seen):
                kept.append(seen)
        return kept

    def __deepcopy__(self, memo: Any) -> CameraPath:
        """Return an independent copy; the poses themselves never change."""
        return CameraPath(self.spacing, {sensor: stops.copy() for sensor, stops in self.stops.items()})


def _packed(numbers: Any, dtype: str) -> str:
    return base64.b64encode(np.asarray(numbers, dtype).tobytes()).decode("ascii")


def _unpacked(text: Any, dtype: str) -> NDArray[Any]:
    if not isinstance(text, str) or len(text) > 8 * POSE * MAX_STOPS:
        raise ValueError("camera_path: not packed numbers")
    return np.frombuffer(base64.b64decode(text, validate=True), dtype)


def _stops_from(saved: Any) -> list[StampedPose]:
    stamps, numbers = _unpacked(saved["stamps_ns"], "<i8"), _unpacked(saved["poses"], "<f4")
    if len(numbers) != POSE * len(stamps) or not (np.abs(numbers) <= FARTHEST).all():  # False for NaN
        raise ValueError("camera_path: invalid poses")
    poses = map(tuple, numbers.reshape(-1, POSE).tolist())
    return [StampedPose(stamp_ns, pose) for stamp_ns, pose in zip(stamps.tolist(), poses, strict=True)]


MAX_LINES = 8192
"""Most lines kept of each kind; if there are more, an even selection is kept."""
ENDS = 6
"""Numbers per line."""
KEPT_AS = "<f4"


@dataclass(frozen=True)
class Lines:
    """Lines between pairs of places.

    Attributes:
        number: How many there are.
        packed: The ends of at most `MAX_LINES` of them, as `ends` returns them; bytes, since maps are copied often.
    """

    number: int = 0
    packed: bytes = b""

    @classmethod
    def between(cls, ends: ArrayLike) -> Lines:
        """Return the lines with these ends (N, 2, 3) in metres, world frame."""
        all_ends = np.asarray(ends, KEPT_AS).reshape(-1, ENDS)
        some = np.unique(np.linspace(0, len(all_ends) - 1, min(len(all_ends), MAX_LINES)).astype(int))
        return cls(len(all_ends), all_ends[some].tobytes())

    @property
    def ends(self) -> NDArray[np.float64]:
        """Return the ends (N, 2, 3) in metres, world frame."""
        return np.frombuffer(self.packed, KEPT_AS).reshape(-1, 2, 3).astype(float)

    def moved(self, T: Transform) -> Lines:
        """Return the lines transformed by T (4, 4)."""
        return Lines(self.number, Lines.between(transform_points(T, self.ends)).packed)

    def saved(self) -> dict[str, Any]:
        """Return plain values for JSON, which `loaded` reads."""
        return {"number": self.number, "ends": base64.b64encode(self.packed).decode("ascii")}

    @classmethod
    def loaded(cls, saved: Any) -> Lines:
        """Return saved lines. Raises KeyError, TypeError or ValueError if the values cannot be lines."""
        number, text = saved["number"], saved["ends"]
        if not isinstance(text, str) or len(text) > 8 * ENDS * MAX_LINES:
            raise ValueError("loops: not packed numbers")
        lines = cls(number, base64.b64decode(text, validate=True))
        ends = np.frombuffer(lines.packed, KEPT_AS)
        if len(ends) % ENDS or not (np.abs(ends) <= FARTHEST).all():  # False for NaN
            raise ValueError("loops: invalid places")
        if type(number) is not int or min(number, MAX_LINES) != len(ends) // ENDS:
            raise ValueError(f"loops: {number} instead of {len(ends) // ENDS} lines")
        return lines


@dataclass(frozen=True)
class LoopLines:
    """The record of loop closure in a map.

    Attributes:
        closed: Lines between the two places of each closed loop.
        refused: Lines between places that look the same but were rejected as loops.
    """

    closed: Lines = Lines()
    refused: Lines = Lines()

    @classmethod
    def between(cls, closed: ArrayLike, refused: ArrayLike) -> LoopLines:
        """Return lines with these ends (N, 2, 3) in metres, world frame."""
        return cls(Lines.between(closed), Lines.between(refused))

    def moved(self, T: Transform) -> LoopLines:
        """Return the lines transformed by T (4, 4)."""
        return LoopLines(self.closed.moved(T), self.refused.moved(T))

    def counts(self) -> dict[str, int]:
        """Return the number of lines of each kind."""
        return {"closed": self.closed.number, "refused": self.refused.number}

    def saved(self) -> dict[str, Any]:
        """Return plain values for JSON, which `loaded` reads."""
        return {"closed": self.closed.saved(), "refused": self.refused.saved()}

    @classmethod
    def loaded(cls, saved: Any) -> LoopLines:
        """Return saved lines. Raises KeyError, TypeError or ValueError if the values cannot be lines."""
        return cls(Lines.loaded(saved["closed"]), Lines.loaded(saved["refused"]))
