# SPDX-License-Identifier: Apache-2.0
"""A glance: how far away a sensor saw something in each direction; and what a later frame says of it.

Two glances from different poses tell a world from a fault: what is in the world stays where it is, what is in the
camera (dirt, a dead half, a frozen image) moves with it, and noise does neither.
"""

from __future__ import annotations

import zlib
from base64 import b64decode, b64encode
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.geometry.se3 import Transform

SIDE = 128
"""Directions are binned in an octahedron laid flat (Meyer et al. 2010), SIDE by SIDE bins of about 1.6 degrees."""
AROUND = range(-1, 2)
"""Neighbours of a bin in which a point may have been seen, along each axis."""


class Glance(NamedTuple):
    """What a sensor saw once.

    pose: first three rows of T_world_sensor, 12 numbers. ranges: SIDE x SIDE float16 in metres as bytes, 0: nothing.
    """

    pose: tuple[float, ...]
    ranges: bytes

    @classmethod
    def at(cls, points: NDArray[np.float64], T_world_sensor: Transform) -> Glance:
        """Return the glance at points (N, 3) in the sensor's frame."""
        ranges = np.zeros((SIDE, SIDE), np.float16)
        v, u = _bins(points)
        ranges[v, u] = np.minimum(np.linalg.norm(points, axis=1), 6e4)
        return cls(tuple(T_world_sensor[:3].ravel().tolist()), ranges.tobytes())

    def packed(self) -> str:
        """Return its ranges as text, which `unpacked` reads."""
        return b64encode(zlib.compress(self.ranges, 1)).decode()

    @classmethod
    def unpacked(cls, pose: tuple[float, ...], text: str) -> Glance:
        """Return a glance that was saved. Raises ValueError for what cannot have been."""
        try:
            ranges = zlib.decompressobj().decompress(b64decode(text, validate=True), 2 * SIDE * SIDE + 1)
        except (TypeError, zlib.error) as error:
            raise ValueError(f"history: a glance cannot be read: {error}") from None
        metres = np.frombuffer(ranges, np.float16) if len(ranges) == 2 * SIDE * SIDE else np.full(1, np.nan)
        if not (np.isfinite(metres) & (metres >= 0)).all():
            raise ValueError("history: the ranges of a glance are no distances")
        return cls(pose, ranges)

    def votes(self, points: NDArray[np.float64], T_world_sensor: Transform, tolerance: NDArray[np.float64]) -> Votes:
        """Return what this glance says of points (N, 3) in the sensor's frame that a later frame saw.

        tolerance: (N,) metres by which ranges may differ.
        """
        ranges = np.frombuffer(self.ranges, np.float16).reshape(SIDE, SIDE).astype(float)
        T = np.reshape(self.pose, (3, 4))
        there = (points @ T_world_sensor[:3, :3].T + T_world_sensor[:3, 3] - T[:, 3]) @ T[:, :3]
        in_view, in_world = _matches(ranges, there, tolerance)
        _, in_sensor = _matches(ranges, points, tolerance)
        return Votes(
            int((in_view & in_world & ~in_sensor).sum()),
            int((in_view & in_sensor & ~in_world).sum()),
            int((in_view & ~in_sensor & ~in_world).sum()),
            int((in_view & in_sensor & in_world).sum()),
        )


class Votes(NamedTuple):
    """How many points were seen before at the same place of the world, or in the same direction from the sensor.

    world, sensor: only there. neither: at neither. both: at both, which says nothing.
    """

    world: int = 0
    sensor: int = 0
    neither: int = 0
    both: int = 0


def _matches(
    ranges: NDArray[np.float64], points: NDArray[np.float64], tolerance: NDArray[np.float64]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which points (N, 3) lie where something was seen, and which of them as far away."""
    v, u = _bins(points)
    far = np.linalg.norm(points, axis=1)
    seen, same = np.zeros(len(points), bool), np.zeros(len(points), bool)
    for dv in AROUND:
        for du in AROUND:
            found = ranges[np.clip(v + dv, 0, SIDE - 1), np.clip(u + du, 0, SIDE - 1)]
            seen |= found > 0
            same |= (found > 0) & (np.abs(found - far) <= tolerance)
    return seen, same


def _bins(points: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return row and column (N,) of the bins of directions (N, 3); z is in the middle of the square."""
    x, y, z = (points / np.maximum(np.abs(points).sum(axis=1, keepdims=True), 1e-9)).T
    behind = z < 0
    a = np.where(behind, (1 - np.abs(y)) * np.where(x < 0, -1, 1), x)
    b = np.where(behind, (1 - np.abs(x)) * np.where(y < 0, -1, 1), y)
    row, column = (np.clip(((side + 1) / 2 * SIDE).astype(np.int64), 0, SIDE - 1) for side in (b, a))
    return row, column
