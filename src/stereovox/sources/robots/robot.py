# SPDX-License-Identifier: Apache-2.0
"""Recordings of ground robots: lidar scans, depth images and odometry, in order of time."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from heapq import merge
from typing import Protocol

from stereovox.frame import Frame, Scan
from stereovox.sources.poses import Poses


class Robot(Protocol):
    """What a ground robot recorded. Poses are those of its odometry (`T_world_sensor` = T_odom_sensor).

    name: what the recording is called; notes: what had to be assumed, one line each.
    scans: the lidar's scans in order of time, read when they are asked for; empty where there is no lidar.
    frames: the depth images in order of time, likewise.
    truth: T_world_base where it is known (simulation), else None.
    """

    name: str
    notes: tuple[str, ...]
    scans: Sequence[Scan]
    frames: Sequence[Frame]
    truth: Poses | None

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Tell whether `where` is, or by its name should be, such a recording. Never raises."""
        ...


def in_time_order(*streams: Iterable[Scan | Frame]) -> Iterator[Scan | Frame]:
    """Yield what several streams hold, each in order of time, as it came."""
    yield from merge(*streams, key=lambda seen: seen.stamp_ns)
