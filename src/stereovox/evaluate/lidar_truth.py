# SPDX-License-Identifier: Apache-2.0
"""What is really there, from a recording's lidar (Valenti 2018, 8.2)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.config import Config, load_config
from stereovox.errors import FrameRefused, SourceError, StereovoxError
from stereovox.evaluate.box_points import in_any_box
from stereovox.evaluate.cells import indices, keys
from stereovox.evaluate.crossed import crossed_cells
from stereovox.evaluate.in_view import blocks_in, project, view_volume
from stereovox.frame import Viewpoint
from stereovox.geometry import inverse, transform_points
from stereovox.history import History
from stereovox.maps import VoxelMap
from stereovox.maps.blocks import SIDE, BlockPool
from stereovox.sources import parse_slice
from stereovox.sources.lidar import LidarScan, LidarSource

FREE = ("view", "rays")
IN_VIEW, CROSSED, HIT = 1, 2, 4
"""What is marked in a cell: some frame had it in view and range; a lidar ray crossed it; a point fell into it."""


@dataclass
class TruthCounts:
    """What became of the lidar points, and the cells they made.

    frames: scans used; refused: how many were not, by reason; first_refusal: one line about the first of them.
    points: of all scans used; of these `used` were taken, `out_of_range` of them from beyond the range of their own
    frame; the others were dropped: outside the left image, in an annotated box, on pixels flagged moving.
    """

    frames: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    first_refusal: str = ""
    points: int = 0
    used: int = 0
    outside_view: int = 0
    out_of_range: int = 0
    in_boxes: int = 0
    moving: int = 0
    occupied: int = 0
    free: int = 0

    def as_dict(self) -> dict[str, Any]:
        """Return all of it as plain numbers for a JSON object."""
        plain = {name: value for name, value in vars(self).items() if name not in ("refused", "first_refusal")}
        return {**plain, "frames_refused": self.refused.total(), "refused": dict(self.refused.most_common())}


def lidar_truth(
    source: LidarSource,
    voxel_size: float,
    max_range: float,
    free: str = "view",
    frames: str | Iterable[int] | None = None,
    *,
    box_margin: float = 0.0,
    watch: Callable[[Iterable[int], int], Iterable[int]] | None = None,
) -> tuple[VoxelMap, TruthCounts]:
    """Return the true map of a recording, and how it came about.

    The cells that count have their centre in view of at least one frame, at most `max_range` metres away along the
    optical axis. Of these, one is occupied where one lidar point of any frame falls into it that is in the left image,
    outside every annotated box (grown by `box_margin` metres) and not on something moving; the lidar is as exact far
    away, so what one frame sees beyond the range counts for a frame that has it within. Free are all others (`view`),
    or only those that a lidar ray crosses (`rays`). The rest is unknown. The points of a cell are not weighed against
    rays through it: one point is enough.
    frames: which frames, as `A:B:S` or numbers; None: all. Their images are not read. watch(numbers, count) yields the
    numbers again, for a progress bar.
    Raises SourceError where the source has no lidar or not one scan can be used, StereovoxError for bad values.
    """
    if free not in FREE:
        raise StereovoxError(f"free '{free}' is not known; say {' or '.join(FREE)}")
    if not 0 <= box_margin < 100:
        raise StereovoxError(f"box margin {box_margin:g} must be 0 or more metres, and less than 100")
    config = load_config(voxel_size=voxel_size, max_range=max_range)
    picked = _picked(source, frames)
    truth = _Truth(source, config, free == "rays", box_margin)
    for i in watch(picked, len(picked)) if watch else picked:
        truth.add(i)
    return truth.map(), truth.counts


class _Truth:
    """The marks of all cells so far."""

    def __init__(self, source: LidarSource, config: Config, rays: bool, box_margin: float):
        self.source, self.config, self.rays, self.box_margin = source, config, rays, box_margin
        self.counts = TruthCounts()
        self._marks = BlockPool(np.uint8)
        self._last: Viewpoint | None = None

    def add(self, i: int) -> None:
        """Mark what frame `i` says; a frame whose scan or pose cannot be used is counted and left out."""
        try:
            scan, viewpoint, moving = self.source.scan(i), self.source.viewpoint(i), self.source.moving(i)
            boxes = self.source.boxes(i)
        except FrameRefused as refused:
            self.counts.refused[refused.reason] += 1
            self.counts.first_refusal = self.counts.first_refusal or str(refused)
            return
        if scan is None:
            raise _no_lidar(self.source)
        seen = transform_points(inverse(viewpoint.T_world_camera) @ scan.T_world_lidar, scan.points)
        pixels, shown = project(viewpoint.camera, seen)
        seen, pixels = seen[shown], pixels[shown]
        world = transform_points(viewpoint.T_world_camera, seen)
        boxed = in_any_box(world, boxes, self.box_margin)
        moved = _on(moving, pixels) & ~boxed
        used = ~boxed & ~moved
        self._count(len(shown), used & (seen[:, 2] > self.config.max_range), boxed, moved)
        self._mark(world[used], scan, viewpoint)
        self._last = viewpoint

    def map(self) -> VoxelMap:
        """Return the map; raises SourceError where not one scan could be used."""
        counts = self.counts
        if not counts.frames:
            raise SourceError(f"{self.source.name}: not one lidar scan can be used ({counts.first_refusal})")
        voxel_map = VoxelMap(self.config)
        voxel_map.history = History(counts.frames, Counter(counts.refused), recording=self.source.name)
        if self._last is not None:
            voxel_map.look_from(self._last)
        coords, cells = self._cells()
        voxel_map.insert(coords, cells)
        states = voxel_map.counts()
        counts.occupied, counts.free = states["occupied"], states["free"]
        return voxel_map

    def _count(self, points: int, far: NDArray[np.bool_], boxed: NDArray[np.bool_], moved: NDArray[np.bool_]) -> None:
        counts = self.counts
        counts.frames += 1
        counts.points += points
        counts.outside_view += points - len(boxed)
        counts.out_of_range += int(far.sum())
        counts.in_boxes += int(boxed.sum())
        counts.moving += int(moved.sum())
        counts.used += int((~boxed & ~moved).sum())

    def _mark(self, points: NDArray[np.float64], scan: LidarScan, viewpoint: Viewpoint) -> None:
        size = self.config.voxel_size
        for blocks, cells in blocks_in(view_volume(viewpoint, self.config.max_range, size)):
            places = self._marks.insert(blocks)
            self._marks.values[places] |= np.where(cells, np.uint8(IN_VIEW), np.uint8(0))
        self._mark_cells(np.floor(points / size).astype(np.int64), HIT)
        if self.rays:
            crossed = crossed_cells(scan.T_world_lidar[:3, 3], points, size)
            self._mark_cells(indices(crossed).astype(np.int64), CROSSED)

    def _mark_cells(self, cells: NDArray[np.int64], mark: int) -> None:
        blocks, of_cell = np.unique(keys(cells >> 3), return_inverse=True)
        places = self._marks.insert(indices(blocks))[of_cell]
        low = cells & (SIDE - 1)
        self._marks.values[places, (low[:, 0] << 6) | (low[:, 1] << 3) | low[:, 2]] |= np.uint8(mark)

    def _cells(self) -> tuple[NDArray[np.int32], NDArray[np.integer]]:
        """Return all blocks (n, 3) with their cells (n, 512) as a map stores them."""
        n, form, limits = len(self._marks), VoxelMap(self.config).cell_format, self.config.map
        free = IN_VIEW | CROSSED if self.rays else IN_VIEW
        log_odds = np.array([limits.log_odds_min if marks & free == free else 0.0 for marks in range(2 * HIT)])
        log_odds[[HIT | IN_VIEW, HIT | IN_VIEW | CROSSED]] = limits.log_odds_max
        return self._marks.coords[:n], form.stored(log_odds).astype(form.dtype)[self._marks.values[:n]]


def _picked(source: LidarSource, frames: str | Iterable[int] | None) -> list[int]:
    if not isinstance(source, LidarSource) or not source.has_lidar:
        raise _no_lidar(source)
    if frames is None:
        return list(range(len(source)))
    if not isinstance(frames, str):
        return [range(len(source))[i] for i in frames]
    picked = list(range(len(source))[parse_slice(frames)])
    if not picked:
        raise SourceError(f"frames '{frames}' picks none of the {len(source)} frames of {source.name}; widen it")
    return picked


def _no_lidar(source: Any) -> SourceError:
    return SourceError(f"{source.name}: has no lidar scans, or no calibration of the lidar; give a KITTI recording")


def _on(moving: NDArray[np.bool_] | None, pixels: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Tell which of `pixels` (N, 2), all inside the image, are flagged in `moving` (height, width)."""
    if moving is None:
        return np.zeros(len(pixels), bool)
    u, v = np.floor(pixels + 0.5).astype(int).T
    return moving[v, u]
