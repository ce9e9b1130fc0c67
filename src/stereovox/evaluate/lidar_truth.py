# SPDX-License-Identifier: Apache-2.0
"""Make ground truth from a recording's lidar (Valenti 2018, 8.2)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.config import Config, load_config
from stereovox.depth.quality import check_unit_of_rays
from stereovox.errors import FrameRefused, SourceError, StereovoxError
from stereovox.evaluate.truth import indices, keys
from stereovox.frame import Cloud, Viewpoint
from stereovox.geometry.se3 import inverse, transform_points
from stereovox.integrate.points import crossed_cells
from stereovox.maps import VoxelMap
from stereovox.maps.record.history import History
from stereovox.maps.storage.blocks import SIDE, BlockPool
from stereovox.opening import parse_slice
from stereovox.sources.lidar import Box, LidarScan, LidarSource

Corners = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]
"""Corner p0 of a box and its three neighbours p1, p3, p4 along the edges; (3,) each."""
COARSE = 16
"""The search starts with boxes this many blocks wide and halves them."""
AT_ONCE = 2048
"""Blocks processed together, so that their intermediate arrays stay in the cache."""
OCTANTS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
CELLS = np.stack(np.meshgrid(*[np.arange(SIDE)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) + 0.5
FREE = ("view", "rays", "box")
MAX_BOX = 1 << 28
"""Most cells of a box that is free as a whole."""
IN_VIEW, CROSSED, HIT = 1, 2, 4
"""Marks of a cell: in view and range of a frame; crossed by a lidar ray; hit by a point."""


def inside(points: NDArray[np.floating], corners: Corners) -> NDArray[np.bool_]:
    """Return which points (N, 3) are in the box with these corners, faces included (Valenti 2018, Eq A.1-A.3).

    The printed test can never hold: u, v and w cannot all point from p0 to the other corners, whatever their order,
    because (p0 - p1) x (p0 - p4) has the wrong sign, and Eq A.2 compares x, y, z instead of p. Here v is negated, and
    all three if the corners are left-handed.
    """
    p0, p1, p3, p4 = corners
    a, b, c = p1 - p0, p3 - p0, p4 - p0
    hand = np.sign(np.dot(np.cross(a, b), c))
    found = np.ones(len(points), bool)
    for normal, far in ((np.cross(b, c), p1), (np.cross(c, a), p3), (np.cross(a, b), p4)):
        along = points @ (hand * normal)
        found &= (along >= hand * normal @ p0) & (along <= hand * normal @ far)
    return found


def corners_of(box: Box, margin: float = 0.0) -> Corners:
    """Return four corners of `box` in the world, enlarged by `margin` metres per side."""
    half = np.array(box.size) / 2 + margin
    signs = [(-1, -1, -1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)]
    p0, p1, p3, p4 = transform_points(box.T_world_box, signs * half)
    return p0, p1, p3, p4


def in_any_box(points: NDArray[np.floating], boxes: Iterable[Box], margin: float = 0.0) -> NDArray[np.bool_]:
    """Return which points (N, 3), metres in the world, are in one of `boxes` enlarged by `margin` metres."""
    found = np.zeros(len(points), bool)
    for box in boxes:
        found |= inside(points, corners_of(box, margin))
    return found


@dataclass(frozen=True, eq=False)
class Volume:
    """A convex volume: points x with normals @ x + offsets >= 0, in all rows; normals (P, 3), offsets (P,).

    low, high: (3,) of a box around it.
    """

    normals: NDArray[np.float64]
    offsets: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]


def project(camera: PinholeCamera, points: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Project points (N, 3) in the optical frame to pixels (N, 2), and return which are in the image.

    The image reaches half a pixel beyond the centres of its outermost pixels. Pixels of points behind the camera are
    NaN.
    """
    x, y, z = np.asarray(points, float).T
    ahead = z > 0
    z = np.where(ahead, z, np.nan)
    pixels = np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], axis=1)
    with np.errstate(invalid="ignore"):
        shown = ((pixels >= -0.5) & (pixels < [camera.width - 0.5, camera.height - 0.5])).all(axis=1)
    return pixels, np.asarray(shown)


def view_volume(viewpoint: Viewpoint, max_range: float, voxel_size: float) -> Volume:
    """Return the view volume up to `max_range` metres along the axis, in cells of `voxel_size`, world frame."""
    camera, T = viewpoint.camera, viewpoint.T_world_camera
    left, right = camera.cx + 0.5, camera.width - 0.5 - camera.cx
    top, bottom = camera.cy + 0.5, camera.height - 0.5 - camera.cy
    sides = [[camera.fx, 0, left], [-camera.fx, 0, right], [0, camera.fy, top], [0, -camera.fy, bottom]]
    normals = np.array([*sides, [0, 0, 1], [0, 0, -1]], float) @ T[:3, :3].T
    offsets = np.array([0, 0, 0, 0, 0, max_range]) / voxel_size - normals @ T[:3, 3] / voxel_size
    far = np.array([[x / camera.fx, y / camera.fy, 1] for x in (-left, right) for y in (-top, bottom)]) * max_range
    corners = transform_points(T, np.vstack([np.zeros(3), far])) / voxel_size
    return Volume(normals, offsets, corners.min(axis=0), corners.max(axis=0))


def blocks_in(volume: Volume) -> Iterator[tuple[NDArray[np.int32], NDArray[np.bool_]]]:
    """Yield blocks (n, 3) of 8x8x8 cells and a mask of their cells (n, 512) with the centre in `volume`."""
    inner, border = _candidates(volume)
    for some in _pieces(inner):
        yield some, np.ones((len(some), SIDE**3), bool)
    for some in _pieces(border):
        cells = _cells_in(volume, some)
        any_cell = cells.any(axis=1)
        yield some[any_cell], cells[any_cell]


def _candidates(volume: Volume) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return the blocks wholly inside the volume, and those that may be partly inside."""
    size = COARSE
    low = np.floor(volume.low / (size * SIDE)).astype(int)
    counts = np.floor(volume.high / (size * SIDE)).astype(int) - low + 1
    blocks = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(-1, 3) + low
    while True:
        wholly, partly = _sides(volume, blocks, size * SIDE)
        if size == 1:
            return blocks[wholly].astype(np.int32), blocks[partly].astype(np.int32)
        blocks = (2 * blocks[wholly | partly][:, None, :] + OCTANTS).reshape(-1, 3)
        size //= 2


def _sides(volume: Volume, boxes: NDArray[np.int_], width: int) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which boxes (n, 3), `width` cells wide, are wholly inside the volume, and which may be partly inside."""
    distance = (boxes + 0.5) * width @ volume.normals.T + volume.offsets
    reach = width / 2 * np.abs(volume.normals).sum(axis=1)
    wholly = (distance >= reach).all(axis=1)
    return wholly, (distance >= -reach).all(axis=1) & ~wholly


def _cells_in(volume: Volume, blocks: NDArray[np.int32]) -> NDArray[np.bool_]:
    found = np.ones((len(blocks), SIDE**3), bool)
    for normal, offset in zip(volume.normals, volume.offsets, strict=True):
        found &= (SIDE * blocks @ normal + offset)[:, None] + CELLS @ normal >= 0
    return found


def _pieces(blocks: NDArray[np.int32]) -> Iterator[NDArray[np.int32]]:
    return (blocks[start : start + AT_ONCE] for start in range(0, len(blocks), AT_ONCE))


@dataclass
class TruthCounts:
    """Counts of lidar points and of the resulting cells.

    frames: scans used; refused: number of others by reason; first_refusal: one line about the first of them.
    points: of all scans used; `used` of them count, including `out_of_range` from beyond the range of their own frame;
    the others were dropped: outside the left image, in an annotated box, on pixels flagged as moving.
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
        """Return all counts for JSON."""
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
    """Make the true map of a recording; return it with the counts behind it.

    Cells count if their centre is in view of at least one frame, at most `max_range` metres away along the optical
    axis. Such a cell is occupied if at least one lidar point of any frame is in it, inside the left image, outside
    every annotated box (enlarged by `box_margin` metres) and not on a moving object; lidar is as accurate far away, so
    a point beyond the range of its own frame counts for another frame within range. All others are free (`view`), or
    only those crossed by a lidar ray (`rays`). The rest is unknown. With `box`, as in Valenti 2018, Table 8.1, all
    cells of the box round those in view count, along the axes, as if they were in view. Points are not weighed
    against rays through the same cell: one point is enough.
    frames: which frames, as `A:B:S` or numbers; None: all. Their images are not read. watch(numbers, count) yields the
    numbers again, for a progress bar.
    Raises SourceError if the source has no lidar or no usable scan, StereovoxError for bad values.
    """
    if free not in FREE:
        raise StereovoxError(f"free '{free}' is not known; say {', '.join(FREE[:-1])} or {FREE[-1]}")
    if not 0 <= box_margin < 100:
        raise StereovoxError(f"box margin {box_margin:g} must be 0 or more metres, and less than 100")
    config = load_config(voxel_size=voxel_size, max_range=max_range)
    picked = _picked(source, frames)
    truth = _Truth(source, config, free, box_margin)
    for i in watch(picked, len(picked)) if watch else picked:
        truth.add(i)
    return truth.map(), truth.counts


class _Truth:
    """Marks of all cells so far."""

    def __init__(self, source: LidarSource, config: Config, free: str, box_margin: float):
        self.source, self.config, self.box_margin = source, config, box_margin
        self.rays, self.box = free == "rays", free == "box"
        self.counts = TruthCounts()
        self._marks = BlockPool(np.uint8)
        self._last: Viewpoint | None = None

    def add(self, i: int) -> None:
        """Mark the cells of frame `i`; a frame without a usable scan or pose is counted and skipped."""
        try:
            scan, viewpoint, moving = self.source.scan(i), self.source.viewpoint(i), self.source.moving(i)
            boxes = self.source.boxes(i)
            if scan is not None:
                cloud = Cloud(scan.points, scan.T_world_lidar, name=f"scan {i}")
                check_unit_of_rays(cloud, np.linalg.norm(scan.points, axis=1), self.config)
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
        """Return the map; raises SourceError if no scan was usable."""
        counts = self.counts
        if not counts.frames:
            raise SourceError(f"{self.source.name}: not one lidar scan can be used ({counts.first_refusal})")
        voxel_map = VoxelMap(self.config)
        voxel_map.history = History(counts.frames, Counter(counts.refused), recording=self.source.name)
        if self._last is not None:
            voxel_map.storage.set_viewpoint(self._last)
        coords, cells = self._cells()
        voxel_map.storage.insert(coords, cells)
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
            self._mark_cells(crossed_cells(scan.T_world_lidar[:3, 3], points, size), CROSSED)

    def _mark_cells(self, cells: NDArray[np.int64], mark: int) -> None:
        blocks, of_cell = np.unique(keys(cells >> 3), return_inverse=True)
        places = self._marks.insert(indices(blocks))[of_cell]
        low = cells & (SIDE - 1)
        self._marks.values[places, (low[:, 0] << 6) | (low[:, 1] << 3) | low[:, 2]] |= np.uint8(mark)

    def _cells(self) -> tuple[NDArray[np.int32], NDArray[np.integer]]:
        """Return all blocks (n, 3) with their cells (n, 512) as a map stores them."""
        if self.box:
            self._mark_box()
        n, form, limits = len(self._marks), VoxelMap(self.config).storage.cell_format, self.config.map
        free = IN_VIEW | CROSSED if self.rays else IN_VIEW
        log_odds = np.array([limits.log_odds_min if marks & free == free else 0.0 for marks in range(2 * HIT)])
        log_odds[[HIT | IN_VIEW, HIT | IN_VIEW | CROSSED]] = limits.log_odds_max
        return self._marks.coords[:n], form.stored(log_odds).astype(form.dtype)[self._marks.values[:n]]

    def _mark_box(self) -> None:
        """Mark all cells of the box round those in view as in view, too."""
        n = len(self._marks)
        block, cell = np.nonzero(self._marks.values[:n] & IN_VIEW)
        cells = self._marks.coords[block] * SIDE + np.stack([cell >> 6, (cell >> 3) & 7, cell & 7], axis=1)
        low, high = cells.min(axis=0), cells.max(axis=0) + 1
        if np.prod(high - low, dtype=float) > MAX_BOX:
            raise StereovoxError(
                f"free 'box': {np.prod(high - low, dtype=float):.2g} cells are too many; use larger ones"
            )
        axes = [np.arange(a // SIDE, -(-b // SIDE)) for a, b in zip(low, high, strict=True)]
        inside = [(SIDE * axis[:, None] + np.arange(SIDE) >= a) & (SIDE * axis[:, None] + np.arange(SIDE) < b)
                  for axis, a, b in zip(axes, low, high, strict=True)]  # fmt: skip
        for i, x in enumerate(axes[0]):
            blocks = np.stack(np.meshgrid([x], *axes[1:], indexing="ij"), axis=-1).reshape(-1, 3)
            every = np.einsum("a,jb,kc->jkabc", inside[0][i], inside[1], inside[2]).reshape(len(blocks), -1)
            places = self._marks.insert(blocks.astype(np.int32))
            self._marks.values[places] |= np.where(every, np.uint8(IN_VIEW), np.uint8(0))


def _picked(source: LidarSource, frames: str | Iterable[int] | None) -> list[int]:
    if not isinstance(source, LidarSource) or not source.has_lidar:
        raise _no_lidar(source)
    if frames is None:
        return list(range(len(source)))
    if not isinstance(frames, str):
        return [range(len(source))[i] for i in frames]
    picked = list(range(len(source))[parse_slice(frames)])
    if not picked:
        raise SourceError(f"frames '{frames}' selects none of the {len(source)} frames of {source.name}; widen it")
    return picked


def _no_lidar(source: Any) -> SourceError:
    return SourceError(f"{source.name}: has no lidar scans, or no calibration of the lidar; give a KITTI recording")


def _on(moving: NDArray[np.bool_] | None, pixels: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which of `pixels` (N, 2), all inside the image, are flagged in `moving` (height, width)."""
    if moving is None:
        return np.zeros(len(pixels), bool)
    u, v = np.floor(pixels + 0.5).astype(int).T
    return moving[v, u]
