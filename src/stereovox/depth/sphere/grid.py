# SPDX-License-Identifier: Apache-2.0
"""The spherical grid: the distance to the nearest surface in each direction from the vehicle (Valenti 2018, 5.3).

The directions of the cells of a spherical grid.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.cameras.rigs import VirtualCamera
from stereovox.config import Config, SphereConfig, load_config
from stereovox.depth.sphere import _sphere
from stereovox.errors import ConfigError
from stereovox.frame import DepthImage, Reason
from stereovox.geometry.se3 import Transform, transform_points
from stereovox.sensors.noise import SUBPIXEL

ROUNDING = 1e-6
"""Share of a cell by which a bound may exceed a cell without adding another."""


class KernelLayout(NamedTuple):
    """A layout as kernels read it."""

    per_radian: np.float32  # cells a radian
    half_turn: np.int32  # cells from pole to pole
    turn: np.int32  # cells round the pole
    first_polar: np.int32
    first_azimuth: np.int32
    polars: np.int32
    azimuths: np.int32


@dataclass(frozen=True)
class SphereLayout:
    """The cells of a spherical grid, in the frame of the body: x forward, y left, z up.

    Polar angle theta counts from the z axis, azimuth phi from the x axis to the y axis (Valenti 2018, Eq 5.2). All
    grids of one step share one lattice, so they can be stitched whatever their bounds: polar cells count from theta =
    0, azimuth cells from phi = -180 degrees and on round the pole.
    per_half_turn: cells in 180 degrees. first_polar, first_azimuth: the first cell; polars, azimuths: their number.
    """

    per_half_turn: int
    first_polar: int
    first_azimuth: int
    polars: int
    azimuths: int

    @classmethod
    def of(
        cls,
        step_deg: float,
        polar_deg: tuple[float, float] = (0.0, 180.0),
        azimuth_deg: tuple[float, float] = (-180.0, 180.0),
    ) -> SphereLayout:
        """Return the smallest layout of whole cells that contains these angles.

        Raises ConfigError, one line, as for the settings of the same names.
        """
        given = {"step_deg": step_deg, "polar_deg": polar_deg, "azimuth_deg": azimuth_deg}
        return cls.configured(load_config(sphere=given).sphere)

    @classmethod
    def configured(cls, config: SphereConfig) -> SphereLayout:
        """Return the layout of the settings. Raises ConfigError if they have no step."""
        if config.step_deg is None:
            raise ConfigError(
                "sphere.step_deg is not set, so there is no spherical grid; set it to degrees, for example 2"
            )
        n = round(180 / config.step_deg)
        step = 180 / n
        low, high = (_whole(angle / step) for angle in config.polar_deg)
        left, right = (_whole((angle + 180) / step) for angle in config.azimuth_deg)
        azimuths = min(math.ceil(right) - math.floor(left), 2 * n)
        return cls(n, math.floor(low), math.floor(left) % (2 * n), math.ceil(high) - math.floor(low), azimuths)

    @property
    def shape(self) -> tuple[int, int]:
        """Shape (azimuths, polars) of the grid's arrays."""
        return self.azimuths, self.polars

    @property
    def step(self) -> float:
        """Width of a cell in both angles, radians."""
        return math.pi / self.per_half_turn

    def whole(self) -> SphereLayout:
        """Return the layout of the same step that holds all directions."""
        return SphereLayout(self.per_half_turn, 0, 0, self.per_half_turn, 2 * self.per_half_turn)

    def polar(self) -> NDArray[np.float64]:
        """Return the polar angle (polars,) of the cells' centres in radians, 0 (up) to pi (down)."""
        return (self.first_polar + np.arange(self.polars, dtype=float) + 0.5) * self.step

    def azimuth(self) -> NDArray[np.float64]:
        """Return the azimuth (azimuths,) of the cells' centres in radians; ascending, from -pi to 3 pi at most."""
        return (self.first_azimuth + np.arange(self.azimuths, dtype=float) + 0.5) * self.step - math.pi

    def directions(self) -> NDArray[np.float64]:
        """Return the unit vectors (azimuths, polars, 3) of the cells' centres, frame of the body."""
        theta, phi = self.polar()[None, :], self.azimuth()[:, None]
        parts = np.broadcast_arrays(np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta))
        return np.stack(parts, axis=-1)

    def cells_of(self, directions: ArrayLike) -> NDArray[np.int64]:
        """Return the number (N,) of the cell of each direction (N, 3) of any length, -1 outside (Eq 5.2)."""
        x, y, z = np.asarray(directions, float).reshape(-1, 3).T
        polar = np.arctan2(np.hypot(x, y), z) / self.step
        j = np.minimum(polar.astype(np.int64), self.per_half_turn - 1) - self.first_polar
        i = np.floor((np.arctan2(y, x) + math.pi) / self.step).astype(np.int64) - self.first_azimuth
        i %= 2 * self.per_half_turn
        inside = (i < self.azimuths) & (j >= 0) & (j < self.polars)
        return np.where(inside, i * self.polars + j, -1)

    def places_in(self, other: SphereLayout) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the indices of this layout's azimuth (azimuths,) and polar cells (polars,) in one that contains
        them."""
        i = (self.first_azimuth - other.first_azimuth + np.arange(self.azimuths)) % (2 * self.per_half_turn)
        return i, self.first_polar - other.first_polar + np.arange(self.polars)

    def for_kernels(self) -> KernelLayout:
        """Return the layout as kernels read it."""
        n = self.per_half_turn
        whole = (n, 2 * n, self.first_polar, self.first_azimuth, self.polars, self.azimuths)
        return KernelLayout(np.float32(n / math.pi), *map(np.int32, whole))


def union(layouts: Sequence[SphereLayout]) -> SphereLayout:
    """Return a layout that contains all of these. Raises ConfigError if their steps differ."""
    steps = sorted({layout.per_half_turn for layout in layouts})
    if len(steps) != 1:
        found = " and ".join(f"{180 / n:g}" for n in reversed(steps)) or "none"
        raise ConfigError(f"sphere: only grids of equal steps can be stitched, these have {found} deg")
    low = min(layout.first_polar for layout in layouts)
    high = max(layout.first_polar + layout.polars for layout in layouts)
    first, azimuths = _arc([(layout.first_azimuth, layout.azimuths) for layout in layouts], 2 * steps[0])
    return SphereLayout(steps[0], low, first, high - low, azimuths)


def _arc(arcs: list[tuple[int, int]], turn: int) -> tuple[int, int]:
    """Return first cell and length of the shortest arc round the pole that contains all of these."""
    best = (0, turn)
    for first, _ in sorted(arcs):
        length = max((start - first) % turn + count for start, count in arcs)
        if length < best[1]:
            best = (first, length)
    return best


def _whole(cells: float) -> float:
    return round(cells) if abs(cells - round(cells)) < ROUNDING else cells


PIXEL = 1.5
"""Assumed pixel size: its diagonal, with a margin since the grid's origin may be nearer than the eye."""
NEVER = np.iinfo(np.int64).min
"""Stamp of a cell that was never seen."""
RANK = np.array([1, 3, 0, 2, 3, 3], np.uint8)
"""Priority of each `Reason` if two meet, lowest first: too near, surface, free up to a range, unknown."""
ARRAYS = ("range_m", "reason", "count", "stamp_ns")


class Cells(NamedTuple):
    """Statistics of the ranges in each cell, flat arrays as kernels write them."""

    number: NDArray[np.int32]
    mean: NDArray[np.float32]
    squares: NDArray[np.float32]  # sum of squared differences from the mean
    nearest: NDArray[np.float32]
    free_to: NDArray[np.float32]  # range up to which rays without an obstacle are free
    too_near: NDArray[np.uint8]  # whether anything was nearer than the camera can measure


@dataclass(frozen=True, eq=False)
class SphereGrid:
    """One range for each direction from the origin of the body, and its age. Arrays are (azimuths, polars).

    layout: the directions. range_m: float32 metres to the nearest surface if `reason` is VALID; end of the free
        part if TOO_FAR; 0 if TOO_NEAR; NaN if nothing was seen.
    reason: uint8 of `Reason`, UNKNOWN if nothing was seen. count: int32 points of a cell.
    stamp_ns: int64 time of a cell's range, NEVER if it has none.
    camera: the contributing camera with the noisiest ranges; None if unknown.
    """

    layout: SphereLayout
    range_m: NDArray[np.float32]
    reason: NDArray[np.uint8]
    count: NDArray[np.int32]
    stamp_ns: NDArray[np.int64]
    camera: VirtualCamera | None = None

    @property
    def known(self) -> NDArray[np.bool_]:
        """(azimuths, polars) bool: which cells have been seen."""
        return self.stamp_ns != NEVER

    def points(self) -> NDArray[np.float64]:
        """Return the surfaces (N, 3) in metres, frame of the body: each at the middle of its cell."""
        surface = self.reason == Reason.VALID
        return self.layout.directions()[surface] * self.range_m[surface, None]

    def since(self, stamp_ns: int) -> SphereGrid:
        """Return the grid with all cells older than `stamp_ns` unknown again."""
        old, nothing = self.stamp_ns < stamp_ns, empty(self.layout)
        return replace(self, **{name: np.where(old, getattr(nothing, name), getattr(self, name)) for name in ARRAYS})


def empty(layout: SphereLayout) -> SphereGrid:
    """Return a grid in which every cell is unknown."""
    shape = layout.shape
    return SphereGrid(
        layout,
        np.full(shape, np.nan, np.float32),
        np.full(shape, Reason.UNKNOWN, np.uint8),
        np.zeros(shape, np.int32),
        np.full(shape, NEVER, np.int64),
    )


def accumulate(
    image: DepthImage, T_body_sensor: Transform, config: Config, layout: SphereLayout | None = None
) -> SphereGrid:
    """Return the grid of one depth image (Valenti 2018, Eq 5.2 to 5.4).

    T_body_sensor: (4, 4) maps the image's optical frame into the body's (x forward, y left, z up), the grid's origin.
    layout: the directions; default: `config.sphere`. A cell is TOO_NEAR if any of its pixels is, else
    VALID if any pixel has a depth, else TOO_FAR if any pixel is. Near the poles, where cells are narrower than
    pixels, gaps between pixels take the nearest adjacent value.
    """
    layout = layout or SphereLayout.configured(config.sphere)
    cells, camera = _new_cells(layout), image.camera
    columns, rows = camera.rays()
    _sphere.gather_image(
        image.depth_m, image.reason, columns, rows, np.ascontiguousarray(T_body_sensor[:3], np.float32),
        np.float32(config.min_range), np.float32(config.max_range), layout.for_kernels(), cells,
        np.empty((2, camera.width), np.float32),
    )  # fmt: skip
    grid = replace(_grid(cells, layout, config.sphere, image.stamp_ns), camera=camera)
    _fill_between_pixels(grid, PIXEL * camera.binning / camera.focal_px)
    return grid


def gather(points: ArrayLike, stamp_ns: int, config: SphereConfig, layout: SphereLayout | None = None) -> SphereGrid:
    """Return the grid of points (N, 3) in metres, frame of the body, seen at one time; NaN points are ignored."""
    layout = layout or SphereLayout.configured(config)
    finite = np.asarray(points, np.float32).reshape(-1, 3)
    finite = np.ascontiguousarray(finite[np.isfinite(finite).all(axis=1)])
    cells = _new_cells(layout)
    _sphere.gather_points(finite, np.zeros(len(finite), np.uint8), layout.for_kernels(), cells)
    return _grid(cells, layout, config, stamp_ns)


def _new_cells(layout: SphereLayout) -> Cells:
    n = layout.azimuths * layout.polars
    far = np.full((2, n), np.inf, np.float32)
    none = np.zeros((2, n), np.float32)
    return Cells(np.zeros(n, np.int32), none[0], none[1], far[0], far[1], np.zeros(n, np.uint8))


def _grid(cells: Cells, layout: SphereLayout, config: SphereConfig, stamp_ns: int) -> SphereGrid:
    near, valid, free = cells.too_near > 0, cells.number > 0, np.isfinite(cells.free_to)
    ranges = np.select([near, valid, free], [np.float32(0), _nearest(cells, config), cells.free_to], np.float32(np.nan))
    codes = [np.uint8(code) for code in (Reason.TOO_NEAR, Reason.VALID, Reason.TOO_FAR)]
    reason = np.select([near, valid, free], codes, np.uint8(Reason.UNKNOWN))
    stamps = np.where(near | valid | free, np.int64(stamp_ns), NEVER)
    shape = layout.shape
    return SphereGrid(
        layout, ranges.reshape(shape), reason.reshape(shape), cells.number.reshape(shape), stamps.reshape(shape)
    )


def _nearest(cells: Cells, config: SphereConfig) -> NDArray[np.float32]:
    """Return the distance of the most dangerous obstacle of each cell (Valenti 2018, Eq 5.4)."""
    if config.statistic == "minimum":
        return cells.nearest
    std = np.sqrt(cells.squares / np.maximum(cells.number, 1).astype(np.float32))
    robust = cells.mean - np.float32(config.spread) * std
    return np.where((std < config.std_threshold) & (robust > 0), robust, cells.nearest)


def _fill_between_pixels(grid: SphereGrid, pixel: float) -> None:
    """Close the holes near the poles, in place: a pixel `pixel` radians wide covers several cells there."""
    width = np.sin(grid.layout.polar()) * grid.layout.step
    known = grid.known
    for j in np.flatnonzero((width < pixel) & known.any(axis=0) & ~known.all(axis=0)).tolist():
        beside = _winner_beside(grid, j, min(int(np.ceil(pixel / width[j])), grid.layout.per_half_turn))
        taken = ~known[:, j] & (beside >= 0)
        for name in ARRAYS:
            values = getattr(grid, name)
            values[taken, j] = values[beside[taken], j]


def _winner_beside(grid: SphereGrid, j: int, reach: int) -> NDArray[np.int64]:
    """Return the azimuth cell (azimuths,) that wins among those up to `reach` away in one ring, -1: none known."""
    n, turn = grid.layout.azimuths, 2 * grid.layout.per_half_turn
    rank = RANK[grid.reason[:, j]] * 1e6 + np.nan_to_num(grid.range_m[:, j].astype(float))
    rank[~grid.known[:, j]] = np.inf
    i = np.arange(n)[:, None] + np.arange(-reach, reach + 1)
    i = i % turn if n == turn else i
    ranks = np.where((i >= 0) & (i < n), rank[np.clip(i, 0, n - 1)], np.inf)
    best = np.argmin(ranks, axis=1)
    return np.where(np.isfinite(ranks[np.arange(n), best]), i[np.arange(n), best], -1)


def stitch(grids: Sequence[SphereGrid]) -> SphereGrid:
    """Return one grid from several: in each direction the nearest wins and keeps its age (Valenti 2018, 5.4).

    A surface wins against directions only known to be free up to a range; at equal ranges the newest wins. Bounds may
    differ. Raises ConfigError if steps differ.
    """
    layout = union([grid.layout for grid in grids])
    return reduce(_nearer, (_widened(grid, layout) for grid in grids), empty(layout))


def moved(grid: SphereGrid, T_new_old: Transform) -> SphereGrid:
    """Return the grid as the body sees it after it has moved; T_new_old (4, 4) maps its old frame into the new one.

    Each range moves to its new direction and keeps its age; gaps between two cells are unknown. For moves that
    are small compared with the ranges: what was hidden from the old position stays unknown.
    """
    seen = grid.known & (grid.reason != Reason.TOO_NEAR)
    points = transform_points(T_new_old, grid.layout.directions()[seen] * grid.range_m[seen, None])
    ranges = np.linalg.norm(points, axis=1)
    values = {"range_m": ranges, **{name: getattr(grid, name)[seen] for name in ARRAYS[1:]}}
    order = np.lexsort((-ranges, -RANK[values["reason"]].astype(int)))  # the winner is written last
    place = grid.layout.cells_of(points)
    order = order[place[order] >= 0]
    into = empty(grid.layout)
    for name in ARRAYS:
        getattr(into, name).reshape(-1)[place[order]] = values[name][order]
    return replace(into, camera=grid.camera)


def _widened(grid: SphereGrid, layout: SphereLayout) -> SphereGrid:
    """Return the grid with wider bounds, which contain its own."""
    if grid.layout == layout:
        return grid
    into = empty(layout)
    place = np.ix_(*grid.layout.places_in(layout))
    for name in ARRAYS:
        getattr(into, name)[place] = getattr(grid, name)
    return replace(into, camera=grid.camera)


def _nearer(a: SphereGrid, b: SphereGrid) -> SphereGrid:
    rank_a, rank_b = (RANK[grid.reason] for grid in (a, b))
    nearer = (rank_b < rank_a) | ((rank_b == rank_a) & (b.range_m < a.range_m))  # false for NaN, which is unknown
    take = nearer | ((rank_b == rank_a) & (b.range_m == a.range_m) & (b.stamp_ns > a.stamp_ns))
    arrays = {name: np.where(take, getattr(b, name), getattr(a, name)) for name in ARRAYS}
    return replace(a, **arrays, camera=max(a.camera, b.camera, key=_noise))


def _noise(camera: VirtualCamera | None) -> float:
    """Return the growth of a camera's noise with the square of the depth; 0 if unknown, -1 without a camera."""
    if camera is None or camera.baseline is None:
        return -1.0 if camera is None else 0.0
    return (camera.subpixel or SUBPIXEL) / (camera.focal_px * camera.baseline)
