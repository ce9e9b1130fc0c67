# SPDX-License-Identifier: Apache-2.0
"""The protocol of recordings with a lidar: scans, annotated boxes, and masks of moving pixels."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import FrameRefused
from stereovox.files.safe_io import MAX_LIST, read_bounded
from stereovox.frame import Viewpoint
from stereovox.geometry.se3 import Transform

COLUMNS, MIN_SURE = (4, 3, 5, 6, 7, 8), 600
"""Numbers a point that are tried, and least points whose columns can identify them."""
ALIKE, APART = 0.35, 0.1
"""Largest difference (Kolmogorov and Smirnov's) between every n-th number of a column, and by how much any other layout
must be worse. Consecutive numbers of one axis differ by less than `STEP` of their spread."""
STEP = 0.02
NEAR, LARGEST_M, SAMPLED = 2e6, 1e9, 60_000
"""Number below which all coordinates of a lidar are, even in millimetres, which `bad_units` reports; metres below which
floats can compute with them; points inspected."""


class BinLayout(NamedTuple):
    """The numbers of a raw cloud, of which the first three are x, y and z in metres: how many a point, and their type.

    KITTI's, the default: x, y, z and the reflectance, float32 each.
    """

    columns: int = 4
    dtype: str = "<f4"

    @property
    def words(self) -> str:
        """The layout in words."""
        return f"{self.columns} {'float32' if self.dtype == '<f4' else 'float64'} a point"

    @property
    def size(self) -> int:
        """Bytes of a point."""
        return self.columns * np.dtype(self.dtype).itemsize


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


def read_velodyne(path: Path, layout: BinLayout | None = None) -> NDArray[np.float32]:
    """Return the finite points (N, 3) float32 of a `.bin`; `layout`: KITTI's by default.

    Raises FrameRefused: `missing_file`; `unreadable` if the file holds no points or is cut off.
    """
    layout, data = layout or BinLayout(), _raw(path)
    if not data or len(data) % layout.size:
        what = f"{len(data)} bytes are not a whole number of points ({layout.words})" if data else "holds no point"
        raise FrameRefused("unreadable", f"{path}: {what}; copy it again or leave its frame out")
    points = np.frombuffer(data, layout.dtype).reshape(-1, layout.columns)[:, :3]
    points = points[np.isfinite(points).all(axis=1) & (np.abs(points) < LARGEST_M).all(axis=1)]
    return points.astype(np.float32)


def find_layout(path: Path) -> BinLayout:
    """Return the layout of a raw cloud, by how alike the numbers of each of its columns are.

    In a wrong layout a column holds x, y, z and other things in turn. Smaller files than `MIN_SURE` points are KITTI's.
    Raises FrameRefused as `read_velodyne`, and `unreadable` if no layout, or none better than the others, fits.
    """
    data = _raw(path)
    if len(data) < MIN_SURE * BinLayout().size:
        return BinLayout()
    fit = list[tuple[float, BinLayout]]()
    for dtype in ("<f4", "<f8"):  # halves of float64 are no coordinates, but two float32 may look like one float64
        tried = [BinLayout(columns, dtype) for columns in COLUMNS]
        found = [(_unlike(data, one), one) for one in tried if len(data) % one.size == 0]
        fit = fit or sorted(pair for pair in found if pair[0] <= ALIKE)
    fit = [(unlike, one) for unlike, one in fit if not any(_repeats(one, other) for _, other in fit)]
    if not fit or (len(fit) > 1 and fit[1][0] < fit[0][0] + APART):
        if len(data) % BinLayout().size and not fit:
            return BinLayout()  # which refuses it as cut off
        said = "not known how many numbers a point has, and of which type"
        raise FrameRefused("unreadable", f"{path}: {said}; convert it to .pcd, or give ?columns= (a folder)")
    return fit[0][1]


def _repeats(one: BinLayout, other: BinLayout) -> bool:
    """Return whether a layout is several points of another at once."""
    return one.columns > other.columns and one.columns % other.columns == 0


def _unlike(data: bytes, layout: BinLayout) -> float:
    """Return how much the numbers of x and y differ from one another, from one row in turn to the next; 1 if these are
    no coordinates.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        rows = np.frombuffer(data, layout.dtype).reshape(-1, layout.columns)[:SAMPLED].astype(np.float64)
        near = (np.abs(rows[:, :3]) < NEAR) & ((np.abs(rows[:, :3]) > 1e-6) | (rows[:, :3] == 0))
    if np.mean(near) < 0.99:
        return 1.0
    rows = rows[near.all(axis=1)]
    spread = np.std(rows[:, :2], axis=0)
    if np.median(np.abs(rows[:, 0] - rows[:, 1])) < STEP * spread.max() or not spread.any():
        return 1.0  # all of one axis, then all of the next
    return max(_most_apart([rows[k::turn, axis] for k in range(turn)]) for axis in (0, 1) for turn in range(2, 9))


def _most_apart(samples: list[NDArray[np.float64]]) -> float:
    """Return the largest difference between the distributions of the first sample and the others."""
    steps = np.quantile(np.concatenate(samples), np.linspace(0, 1, 65))
    shares = np.stack([np.searchsorted(np.sort(one), steps, "right") / len(one) for one in samples])
    return float(np.ptp(shares, axis=0).max())


def _raw(path: Path) -> bytes:
    if not os.path.isfile(path):
        raise FrameRefused("missing_file", f"{path}: no such file; put the scan back or leave its frame out")
    try:
        return read_bounded(path, MAX_LIST)
    except OSError as error:
        raise FrameRefused("unreadable", f"{path}: {error.strerror}; make it readable") from None
