# SPDX-License-Identifier: Apache-2.0
"""The protocol of ground robots' recordings: lidar scans, depth images and odometry in time order."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from heapq import merge
from typing import Protocol

from stereovox.frame import Frame, Scan
from stereovox.sources.poses.poses import Poses


class Robot(Protocol):
    """The recording of a ground robot. Poses come from its odometry (`T_world_sensor` = T_odom_sensor).

    Attributes:
        name: Name of the recording.
        notes: Assumptions, one line each.
        scans: Lidar scans in time order, read on access; empty without a lidar.
        frames: Depth images in time order, read on access; empty without a depth camera.
        truth: T_world_base if known (simulation), else None.
    """

    name: str
    notes: tuple[str, ...]
    scans: Sequence[Scan]
    frames: Sequence[Frame]
    truth: Poses | None

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Check cheaply whether this class can open a recording; never raises.

        Args:
            where: Path or name, perhaps with options behind a `?`.

        Returns:
            Whether `where` is, or by its name should be, such a recording.
        """
        ...


def in_time_order(*streams: Iterable[Scan | Frame]) -> Iterator[Scan | Frame]:
    """Merge streams that are each in time order."""
    yield from merge(*streams, key=lambda seen: seen.stamp_ns)
