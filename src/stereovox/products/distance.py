# SPDX-License-Identifier: Apache-2.0
"""Distance from every cell of a box to the nearest obstacle (an unsigned ESDF), updated frame by frame.

The exact Euclidean distance transform of a box of cells, kept up to date as cells become obstacles or cease to be.

Felzenszwalb and Huttenlocher 2012, Distance Transforms of Sampled Functions: axis by axis.
Our own, because SciPy and OpenCV only redo the whole box (20 to 51 ms, not 2.5 to 6.6:
`benchmarks/distance.py`).
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.errors import StereovoxError
from stereovox.files.safe_io import replacing
from stereovox.kernels.threads import MapLock, in_shards
from stereovox.maps import State, VoxelMap
from stereovox.maps.cells.cell_format import CellRules
from stereovox.maps.query.queries import INDEX_LIMIT, points_of, state_bits
from stereovox.maps.storage.blocks import CELLS, SIDE
from stereovox.products import _distance

LANES = 32
"""Rows are padded to a multiple of this: whole vectors."""
MAX_CELLS, MAX_SIDE = 2**28, 2**14
"""Longest side of a box, in cells."""
UNLIMITED = np.float32(3e38)


class Field(NamedTuple):
    """The arrays of a transform as kernels take them. Axes by length: slabs a, rows b, and lanes c with padding.

    mask: (a, b, c) uint8, 1 for obstacles.
    runs: (a, b, c) int16 rows to the nearest obstacle of the same slab and lane.
    partial: (b, a, c) float32 squares to the nearest in the same slab.
    gone: earlier values of `partial` that were smaller, else infinite; valid only where `touched`.
    squares: (b, a, c) float32 to the nearest of all. metres: the same as distances.
    lowest, highest: (b, a) of `partial`, of `squares`.
    touched: (b, a) least square that changed in `partial`, before or after; -1 if none did.
    """

    mask: NDArray[np.uint8]
    runs: NDArray[np.int16]
    partial: NDArray[np.float32]
    superseded: NDArray[np.float32]
    squares: NDArray[np.float32]
    metres: NDArray[np.float32]
    lowest: NDArray[np.float32]
    highest: NDArray[np.float32]
    touched: NDArray[np.float32]


class Costs(NamedTuple):
    """The square by offset in cells, for each axis, in units of `unit` metres; lanes: for both directions.

    none: the square for no obstacle.
    """

    across: NDArray[np.float32]
    along: NDArray[np.float32]
    lanes: NDArray[np.float32]
    none: np.float32
    unit: np.float32


class Transform:
    """Distances in a box of `shape` (3,) cells with `sides` (3,) in metres; initially without obstacles.

    max_distance: metres, to one part in a million; obstacles farther away are ignored.
    nearer: cells by which obstacles count as nearer along each axis: 0 from centre to centre of cells, 0.5 from the
    centre to the nearest face, 1 from the nearest of all points of a cell; more as if all obstacles were larger by the
    rest.
    order: the axes from the longest to the shortest. field: the arrays, whose axes are in that order.
    """

    def __init__(self, shape: tuple[int, ...], sides: ArrayLike, max_distance: float, nearer: float = 0.0):
        _check(shape, max_distance)
        self.order = tuple(np.argsort([-n for n in shape], kind="stable").tolist())
        self._sides = np.array(sides, float)[list(self.order)]
        slabs, rows, self.lanes = (shape[axis] for axis in self.order)
        self.costs = self._costs((slabs, rows, -(-self.lanes // LANES) * LANES), max_distance, nearer)
        self.field = self._empty(slabs, rows)

    def update(self, dirty: NDArray[np.uint8], threads: int = 1) -> None:
        """Update `field` after its mask changed in the slabs marked in `dirty` (slabs,)."""

        def in_slabs(part: slice) -> None:
            _distance.across_slabs(self.field, self.costs, self.lanes, dirty, part.start, threads)

        def in_planes(part: slice) -> None:
            _distance.across_planes(self.field, self.costs, part.start, threads)

        interleaved = [slice(n, None) for n in range(threads)]  # changes are close together
        in_shards(in_slabs, interleaved)
        in_shards(in_planes, interleaved)

    @property
    def metres(self) -> NDArray[np.float32]:
        """Distances of all cells in metres, with the box's axes, infinite if there is no obstacle; a view."""
        return self.as_box(self.field.metres.swapaxes(0, 1))

    def as_box(self, cells: NDArray) -> NDArray:
        """Return an array (slabs, rows, padded lanes) with the axes of the box, a view."""
        return cells[:, :, : self.lanes].transpose(np.argsort(self.order))

    def _costs(self, shape: tuple[int, int, int], max_distance: float, nearer: float) -> Costs:
        unit = float(self._sides.min())
        across, along, lanes = (
            (np.maximum(np.arange(n) - nearer, 0) * side / unit) ** 2
            for n, side in zip(shape, self._sides, strict=True)
        )
        both = np.concatenate([lanes[:0:-1], lanes])
        both = np.pad(both, (1, 0), constant_values=np.inf)  # an even number: the middle is at half of it
        reach = (1 + 1e-6) * (max_distance / unit) ** 2
        none = UNLIMITED if reach > UNLIMITED else np.nextafter(np.float32(reach), np.float32(np.inf))
        across, along, both = (array.astype(np.float32) for array in (across, along, both))
        return Costs(across, along, both, np.float32(none), np.float32(unit))

    def _empty(self, slabs: int, rows: int) -> Field:
        padded, none = self.costs.lanes.size // 2, self.costs.none
        mask, runs = np.zeros((slabs, rows, padded), np.uint8), np.full((slabs, rows, padded), _distance.FAR)
        squares = np.zeros((rows, slabs, padded), np.float32)  # zero in the padding: nothing to search there
        squares[:, :, : self.lanes] = none
        superseded, metres = np.empty_like(squares), np.full_like(squares, np.inf)
        lowest, touched = np.full((rows, slabs), none), np.full((rows, slabs), _distance.UNCHANGED)
        return Field(mask, runs, squares, superseded, squares.copy(), metres, lowest, lowest.copy(), touched)


def transformed(
    mask: NDArray[np.bool_], sides: ArrayLike, max_distance: float = np.inf, nearer: float = 0.0
) -> NDArray[np.float32]:
    """Return the distance (x, y, z) float32 in metres of each cell to the nearest one in `mask` (x, y, z) bool.

    sides: of a cell, (3,) metres. Infinite if none is near enough. max_distance, nearer: see `Transform`.
    """
    transform = Transform(mask.shape, sides, max_distance, nearer)
    transform.field.mask[:, :, : transform.lanes] = mask.transpose(transform.order)
    transform.update(np.ones(len(transform.field.mask), np.uint8))
    return transform.metres


def _check(shape: tuple[int, ...], max_distance: float) -> None:
    if not max_distance > 0:
        raise StereovoxError(f"max_distance {max_distance:g}: give a length of more than 0 m")
    if np.prod(np.array(shape, float)) > MAX_CELLS or max(shape) > MAX_SIDE:
        sizes = " x ".join(map(str, shape))
        raise StereovoxError(f"a box of {sizes} cells is too large for a distance field; choose a smaller one")


TRIGGER = 1 / 8
"""A window follows the camera once the camera is farther from its centre than this share of its size."""
TIE = 1e-6
"""A face of the box this near to a face of cells, in cells, counts as on it."""
CORNER = "(3,) metres, x y z"
MEASURES = {"centres": 0.0, "faces": 0.5, "gap": 1.0}
"""Cells by which an obstacle counts as nearer along each axis."""


class DistanceField:
    """Exact distances in metres from all cells of a box to the nearest obstacle in the box.

    The box is `low` to `high`, widened to whole cells, or a window of `size` around the camera, which it follows by
    whole blocks of 8 cells once the map has a frame. Obstacles outside the box do not count: a cell nearer to the
    border of the box than to an obstacle may be nearer to one beyond it. After `update` the field equals one computed
    from scratch.

    One thread may update while others call `distance` and `gradient`: each answer belongs to a single update. The
    properties are for the updating thread only.

    Args:
        voxel_map: The map.
        low: Lowest corner (3,) of the box in metres, world frame.
        high: Highest corner (3,).
        size: Sides (3,) of a moving window in metres, in place of `low` and `high`.
        max_distance: Metres; obstacles farther away are ignored.
        to: States that count as obstacles (not FREE); with UNKNOWN, unseen space also keeps a robot away.
        measure: `centres`: from cell centre to cell centre, 0 in an obstacle, as
            `scipy.ndimage.distance_transform_edt`. `faces`: from the cell's centre to the nearest face of the obstacle.
            `gap`: from the nearest point of the cell: a ball around any point of the cell touches nothing if its radius
            is smaller.

    Raises:
        StereovoxError: No box, too large a box, or other bad input.
    """

    def __init__(
        self,
        voxel_map: VoxelMap,
        low: ArrayLike | None = None,
        high: ArrayLike | None = None,
        *,
        size: ArrayLike | None = None,
        max_distance: float = np.inf,
        to: Iterable[State] = (State.OCCUPIED,),
        measure: str = "centres",
    ):
        if measure not in MEASURES:
            raise StereovoxError(f"measure '{measure}': name one of {', '.join(MEASURES)}")
        self._map, self._wanted = voxel_map, state_bits(to, "to")
        self._lock = MapLock()
        self._cell = np.array(voxel_map.config.cell)
        self._follows = size is not None
        self._low, shape = self._about_zero(size) if self._follows else self._between(low, high)
        self._transform = Transform(tuple(shape.tolist()), self._cell, max_distance, MEASURES[measure])
        blocks = ((self._low + shape - 1) >> 3) - (self._low >> 3) + 1
        self._seen = np.zeros((int(blocks.prod()), CELLS), np.uint8)
        self._shape, self._refreshed = shape, False
        if not self._follows or voxel_map.viewpoint is not None:
            self.update()

    def __repr__(self) -> str:
        shape, cell = (" x ".join(f"{x:g}" for x in of) for of in (self._shape.tolist(), self._cell.tolist()))
        return f"<DistanceField of {shape} cells of {cell} m>"

    def update(self) -> int:
        """Bring the field up to date with the map.

        Returns:
            Number of cells that became obstacles or ceased to be.

        Raises:
            StereovoxError: A window has no camera to follow because the map has no frame yet.
        """
        with ExitStack() as mine:
            with self._map.lock:  # always taken before this field's own, only while the map is read
                mine.enter_context(self._lock)
                if self._follows:
                    self._follow()
                changed, dirty = self._refresh()
            self._transform.update(dirty, self._map.config.threads)
            self._refreshed = True
            return changed

    @property
    def origin(self) -> NDArray[np.float64]:
        """Lowest corner (3,) of the box in metres, world frame: the corner of cell [0, 0, 0] of `metres`."""
        return np.asarray(self._low * self._cell, float)

    @property
    def cell(self) -> NDArray[np.float64]:
        """Sides (3,) of a cell in metres."""
        return self._cell.copy()

    @property
    def metres(self) -> NDArray[np.float32]:
        """Distances of all cells (x, y, z) in metres, infinite if no obstacle is near enough.

        A read-only view that `update` changes.
        """
        self._check_place()
        return self._transform.metres

    @property
    def obstacles(self) -> NDArray[np.bool_]:
        """Obstacle mask (x, y, z); a read-only view."""
        self._check_place()
        return self._transform.as_box(self._transform.field.mask).view(bool)

    def distance(self, points: ArrayLike) -> NDArray[np.float32]:
        """Look up distances.

        Args:
            points: (N, 3) metres, world frame.

        Returns:
            (N,) float32 metres of the cells that hold the points: infinite if no obstacle is near enough, NaN
                outside the box and for points that are not finite.
        """
        with self._lock:
            return self._at(*self._cells_of(points))

    def gradient(self, points: ArrayLike) -> NDArray[np.float32]:
        """Return the gradient of the distance, which points away from the nearest obstacle.

        Its length is about 1, and smaller midway between obstacles. Central differences; one-sided at the border of the
        box and next to cells without a distance.

        Args:
            points: (N, 3) metres, world frame.

        Returns:
            (N, 3) float32 metres per metre along each axis, world frame; NaN if the point's own cell has no
                distance.
        """
        with self._lock:
            cells, inside = self._cells_of(points)
            here = self._at(cells, inside)
            slopes = [self._slope(cells, inside, here, axis) for axis in range(3)]
        return np.where(np.isfinite(here)[:, None], np.stack(slopes, axis=1), np.float32(np.nan))

    def _refresh(self) -> tuple[int, NDArray[np.uint8]]:
        """Read the map; return how many cells changed, and which slabs they are in."""
        field, order = self._transform.field, np.array(self._transform.order)
        dirty = np.zeros(len(field.mask), np.uint8)
        cells = self._map.storage.cells_within(self._low, self._low + self._shape)
        changed = _distance.refresh(
            cells, CellRules(self._map.config.map).thresholds, self._wanted, self._low, order,
            self._shape[order], self._seen, field.mask, dirty,
        )  # fmt: skip
        return int(changed), dirty

    def _check_place(self) -> None:
        if self._follows and self._map.viewpoint is None:
            raise StereovoxError("the window of the distance field has no place yet: add a frame to the map and update")

    def _slope(
        self, cells: NDArray[np.int64], inside: NDArray[np.bool_], here: NDArray[np.float32], axis: int
    ) -> NDArray[np.float32]:
        """Return the difference quotient (N,) along one axis; 0 if no neighbour has a distance."""
        ends, offs = [], []
        for step in (-1, 1):
            beside = cells.copy()
            beside[:, axis] += step
            there = self._at(beside, inside & (beside[:, axis] >= 0) & (beside[:, axis] < self._shape[axis]))
            ends.append(np.where(np.isfinite(there), there, here))
            offs.append(np.isfinite(there))
        with np.errstate(invalid="ignore"):
            rise = (ends[1] - ends[0]) / np.float32(self._cell[axis])
        return rise / np.maximum(offs[0].astype(np.float32) + offs[1], 1)

    def _cells_of(self, points: ArrayLike) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Return cells (N, 3) of the box, and a mask (N,) of the points inside it."""
        with np.errstate(invalid="ignore"):
            cells = np.floor(points_of(points) / self._cell) - self._low
            inside = np.all((cells >= 0) & (cells < self._shape), axis=1)  # False for NaN
        return np.where(inside[:, None], cells, 0).astype(np.int64), inside

    def _at(self, cells: NDArray[np.int64], inside: NDArray[np.bool_]) -> NDArray[np.float32]:
        x, y, z = np.where(inside[:, None], cells, 0).T
        return np.where(inside, self.metres[x, y, z], np.float32(np.nan))

    def _between(self, low: ArrayLike | None, high: ArrayLike | None) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the first cell (3,) and the number of cells (3,) of a box in metres."""
        if low is None or high is None:
            raise StereovoxError(
                "a distance field needs low and high of a box, or the size of a window about the camera"
            )
        corners = (
            np.concatenate([points_of(low, "low", wanted=CORNER), points_of(high, "high", wanted=CORNER)]) / self._cell
        )
        if corners.shape != (2, 3) or not (np.abs(corners) < INDEX_LIMIT).all() or not (corners[0] < corners[1]).all():
            raise StereovoxError(f"box {low} to {high}: give two corners x, y, z in metres, the lower one first")
        first = np.floor(corners[0] + TIE).astype(np.int64)
        return first, np.ceil(corners[1] - TIE).astype(np.int64) - first

    def _about_zero(self, size: ArrayLike | None) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the window before the camera is known, aligned to blocks."""
        wanted = points_of([] if size is None else size, "size", wanted="(3,) metres") / self._cell
        if wanted.shape != (1, 3) or not ((wanted > 0) & (wanted < INDEX_LIMIT)).all():
            raise StereovoxError(f"size {size}: give three lengths in metres")
        return np.zeros(3, np.int64), np.ceil(wanted[0] - TIE).astype(np.int64)

    def _follow(self) -> None:
        """Move the window by whole blocks if the camera is too far off centre: `_seen` is stored by blocks."""
        self._check_place()
        assert self._map.viewpoint is not None
        camera = self._map.viewpoint.T_world_camera[:3, 3] / self._cell
        away = np.abs(camera - (self._low + self._shape / 2))
        if not self._refreshed or (away > np.maximum(TRIGGER * self._shape, SIDE)).any():
            self._low = SIDE * np.rint((camera - self._shape / 2) / SIDE).astype(np.int64)


def write_distance(field: DistanceField, path: str | Path) -> None:
    """Write a field for `numpy.load`.

    Arrays: `distance` (x, y, z) float32 metres, infinite if no obstacle is near enough; `origin` (3,) metres, lowest
    corner of cell [0, 0, 0]; `cell` (3,) metres, its sides. The centre of cell (i, j, k) is at origin + (i + 0.5, ...)
    * cell. Raises StereovoxError for an ending other than .npz, MapFileError if the file cannot be written.
    """
    if Path(path).suffix.lower() != ".npz":
        raise StereovoxError(f"{path}: distances are written as .npz; name the file so")
    with replacing(path) as file:
        np.savez_compressed(file, distance=field.metres, origin=field.origin, cell=field.cell)
