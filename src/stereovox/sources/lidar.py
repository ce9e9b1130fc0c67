# SPDX-License-Identifier: Apache-2.0
"""The protocol of recordings with a lidar: scans, annotated boxes, and masks of moving pixels."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import FrameRefused
from stereovox.files.safe_io import MAX_LIST, read_bounded
from stereovox.frame import Viewpoint
from stereovox.geometry.se3 import Transform

POINT_BYTES = 16
"""A point in a KITTI `.bin`: x, y, z in metres and the reflectance, float32 each."""


@dataclass(frozen=True, eq=False)
class LidarScan:
    """One turn of a lidar.

    points: (N, 3) float32 metres in the lidar's frame (x forward, y left, z up); all finite.
    T_world_lidar: (4, 4) float64 maps them into the world. stamp_ns: int64 nanoseconds.
    """

    points: NDArray[np.float32]
    T_world_lidar: Transform
    stamp_ns: int = 0


@dataclass(frozen=True, eq=False)
class Box:
    """An annotated object as a box.

    T_world_box: (4, 4) float64, maps the box's frame into the world: origin in its centre, x along its length, y along
        its width, z along its height (up). size: length, width and height in metres.
    kind: the annotation's class name; track: its number in the whole recording, -1 unknown.
    """

    T_world_box: Transform
    size: tuple[float, float, float]
    kind: str = ""
    track: int = -1


@runtime_checkable
class LidarSource(Protocol):
    """A source that may have a lidar scan next to each frame; `i` as in `Source.frame`."""

    name: str
    notes: tuple[str, ...]

    @property
    def has_lidar(self) -> bool:
        """Whether there are scans, and the lidar's mount is known."""
        ...

    def __len__(self) -> int: ...

    def viewpoint(self, i: int) -> Viewpoint:
        """Return the rectified left camera of frame `i`, its pose and time; FrameRefused if there is no pose."""
        ...

    def scan(self, i: int) -> LidarScan | None:
        """Return the scan of frame `i`, None if the recording has none at all.

        Raises FrameRefused: `missing_file`, `unreadable` (cut off), and as `viewpoint`.
        """
        ...

    def boxes(self, i: int) -> tuple[Box, ...]:
        """Return the annotated objects of frame `i`; none if nothing is annotated."""
        ...

    def moving(self, i: int) -> NDArray[np.bool_] | None:
        """Return the mask (height, width) of moving pixels in the left image; None if not recorded."""
        ...


def read_velodyne(path: Path) -> NDArray[np.float32]:
    """Return the finite points (N, 3) float32 of a KITTI `.bin`.

    Raises FrameRefused: `missing_file`; `unreadable` if the file holds no points or is cut off.
    """
    if not os.path.isfile(path):
        raise FrameRefused("missing_file", f"{path}: no such file; put the scan back or leave its frame out")
    try:
        data = read_bounded(path, MAX_LIST)
    except OSError as error:
        raise FrameRefused("unreadable", f"{path}: {error.strerror}; make it readable") from None
    if not data or len(data) % POINT_BYTES:
        what = f"{len(data)} bytes are not a whole number of points (4 float32 each)" if data else "holds no point"
        raise FrameRefused("unreadable", f"{path}: {what}; copy it again or leave its frame out")
    points = np.frombuffer(data, "<f4").reshape(-1, 4)[:, :3].astype(np.float32)
    return points[np.isfinite(points).all(axis=1)]
