# SPDX-License-Identifier: Apache-2.0
"""Cameras, poses and sensor tables as kernels take them, tuples of float32 numbers and arrays; and their limits."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

from stereovox.cameras.lidar import Lidar, RangeSensor
from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.rigs import VirtualCamera
from stereovox.config import Config
from stereovox.errors import FrameRefused
from stereovox.frame import DepthImage
from stereovox.geometry.se3 import Transform
from stereovox.integrate import _cells
from stereovox.maps.cells.evidence import to_units
from stereovox.maps.query.queries import INDEX_LIMIT
from stereovox.maps.storage.blocks import CELLS, SIDE
from stereovox.sensors.models import Arc
from stereovox.sensors.noise import PoseNoise, RangeNoise
from stereovox.sensors.protocol import COLUMNS, REACH_SIGMA, InverseSensorModel, SensorTable, tabulate

CACHE_LINE = 64
"""Bytes."""
MAX_CAMERAS, MAX_PIXELS = 16, 1 << 26
"""Most cameras whose tools are cached, and pixels of all; beyond that, as with a zoom lens, the cache is emptied."""
WINDOW_SHARE = 0.27
"""Tile size of a cell's window image over the cell's size in the image; a window is three tiles wide.

Chosen so that a cell is cleared if any ray passes through it, as in exact ray casting (see docs/integrators.md).
"""
RIM_SHARE = 0.35
"""`rim_share` of the image of a pinhole camera."""
MIN_BLOCKS, BLOCKS_PER_PIXEL = 1 << 18, 32
"""Most blocks that a camera may see: a base for any image, and more per pixel."""
MAX_BLOCKS = 1 << 21
"""Most blocks of one frame: 10^9 cells. Their indices fit into 22 bits (`_hits.scatter`)."""
CURE = "check the camera's size and focal length, lower max_range, or use larger cells"
CELL_CENTRES = (np.stack([axis.ravel() for axis in np.mgrid[:SIDE, :SIDE, :SIDE]]) + 0.5).astype(np.float32)
"""(3, 512) centres of a block's cells from its corner, in cells."""
Camera = TypeVar("Camera", bound=VirtualCamera | Lidar)
Tools = TypeVar("Tools")


def aligned(length: int, dtype: DTypeLike) -> NDArray[Any]:
    """Return zeros (length,) that begin at a cache line: vectors across two lines take twice as long."""
    room = np.zeros(length * np.dtype(dtype).itemsize + CACHE_LINE, np.uint8)
    start = -room.ctypes.data % CACHE_LINE
    return room[start : start + length * np.dtype(dtype).itemsize].view(dtype)


class PerCamera(Generic[Camera, Tools]):
    """Cache of the tools of each camera, made when the camera is first seen."""

    def __init__(self, make: Callable[[Camera], Tools]):
        self._make = make
        self._kept: dict[Camera, Tools] = {}
        self._last: tuple[Camera, Tools] | None = None

    def __getitem__(self, camera: Camera) -> Tools:
        last = self._last
        if last is None or last[0] is not camera:  # mostly it is the same, and hashing takes longer
            self._last = last = camera, self._find(camera)
        return last[1]

    def _find(self, camera: Camera) -> Tools:
        tools = self._kept.get(camera)
        if tools is None:
            tools = self._make(camera)
            pixels = sum(kept.width * kept.height for kept in (*self._kept, camera))
            if len(self._kept) >= MAX_CAMERAS or pixels > MAX_PIXELS:
                self._kept.clear()
            self._kept[camera] = tools
        return tools


class KernelTable(NamedTuple):
    """A sensor table in whole thousandths of log-odds, split by sign."""

    clear: NDArray[np.int32]  # (rows, columns) negative evidence, 0 elsewhere; column 0 exactly the free value
    mark: NDArray[np.int32]  # (rows, columns) positive evidence next to the hit, 0 elsewhere
    hit: NDArray[np.int32]  # (rows,) evidence of the cell that holds the measured point
    passed: NDArray[np.int32]  # (rows,) largest loss of a cell at the row's depth that is seen through; negative
    edged: NDArray[np.int32]  # (rows,) the same next to an edge
    columns_per_metre: NDArray[np.float32]  # (rows,) table columns per metre
    reach: NDArray[np.float32]  # (rows,) half width of the table in metres
    safe: NDArray[np.float32]  # (rows + 1,) nearest z that is not plainly free for some later row
    before: NDArray[np.float32]  # (rows,) cells at z up to the row's end are plainly free this far before a measurement
    behind: np.float32  # metres behind a measurement where negative evidence ends
    rows_per_metre: np.float32
    blind: np.float32  # depth in metres up to which nothing is cleared
    free: np.int32  # evidence far before a measurement, if `passed` allows it
    marks: bool  # whether there is any positive evidence next to the hit
    edges: bool  # whether cells next to an edge lose less than others


class Rays(NamedTuple):
    """The rays of any camera at its pose, in metres relative to the corner of the camera's block.

    If the sides of a cell differ, the world is stretched to make cells cubes of `voxel_size`; depths stay metres.
    """

    forward: NDArray[np.float32]  # (3, 3) camera to world, transposed: row a is the camera's axis a in the world
    position: NDArray[np.float32]  # (3,) of the camera, from the corner of its block
    columns: NDArray[np.float32]  # (width,) of `camera.rays()`
    rows: NDArray[np.float32]  # (height, 2)
    voxel_size: np.float32
    max_range: np.float32


class View(NamedTuple):
    """A pinhole camera at its pose, in metres relative to the corner of the camera's block; as in `Rays`."""

    rotation: NDArray[np.float32]  # (3, 3) world to camera
    forward: NDArray[np.float32]  # (3, 3) as in `Rays`
    position: NDArray[np.float32]  # (3,) of the camera, from the corner of its block
    sides: NDArray[np.float32]  # (4, 5) the image's sides as planes: normal, half width of a unit box, offset
    columns: NDArray[np.float32]  # (width,) x/z of pixel columns
    rows: NDArray[np.float32]  # (height, 2) y/z of pixel rows, and 1
    intrinsics: NDArray[np.float32]  # fx, fy, cx, cy
    width: np.int32
    height: np.int32
    voxel_size: np.float32
    max_range: np.float32
    spread: np.float32  # window tile size in pixels times depth
    rim: NDArray[np.float32]  # (2,) margin in u and v within which cells count as seen, pixels times depth
    steps: NDArray[np.float32]  # (3, 512) fx * x, fy * y and z of a block's cells from its corner, camera axes


def sensor_table(sensor: InverseSensorModel, config: Config, camera: VirtualCamera | Lidar) -> KernelTable:
    """Return the kernel table of a sensor model for a camera with the configured noise, or a lidar with its own.

    Of a cone it is that of the model `Arc`, whatever is configured; it clears nothing nearer than it measures.
    """
    blind = config.blind
    if isinstance(camera, RangeSensor):
        sensor, blind = Arc(camera.solid_angle), max(blind, camera.range_min)
    noise = RangeNoise.of(config.noise, camera)
    table = tabulate(sensor, noise, config.max_range, config.voxel_size, PoseNoise.of(config.noise))
    return kernel_table(table, config.max_range, blind, config.projective.edge_share)


def kernel_table(table: SensorTable, max_range: float, blind: float = 0.0, edge_share: float = 1.0) -> KernelTable:
    """Return `table` in the form that kernels read; up to depth `blind` in metres nothing is cleared.

    edge_share: see `ProjectiveConfig`.
    """
    units = to_units(table.log_odds)
    clear, mark = np.minimum(units, 0), np.maximum(units, 0)
    free = int(units[0, 0])
    passed = np.maximum(to_units(table.passed), free)
    reach = REACH_SIGMA * table.sigma
    edges = np.arange(len(reach)) / table.rows_per_metre
    safe = np.append(np.minimum.accumulate((edges - reach)[::-1])[::-1], max_range)
    return KernelTable(
        clear,
        mark,
        to_units(table.hit),
        passed,
        np.floor(edge_share * passed).astype(np.int32),
        (COLUMNS / (2 * reach)).astype(np.float32),
        reach.astype(np.float32),
        safe.astype(np.float32),
        _before(edges, reach),
        _behind(clear, reach),
        np.float32(table.rows_per_metre),
        np.float32(blind),
        np.int32(free),
        bool((mark > 0).any()),
        edge_share < 1,
    )


def _before(edges: NDArray[np.float64], reach: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return, for z up to each row's end, the largest reach of all rows that can reach back that far."""
    ends = np.append(edges[1:], np.inf)
    reaches_back = ends[:, None] + reach >= edges
    return (1.001 * np.where(reaches_back, reach, 0).max(axis=1)).astype(np.float32)


def _behind(clear: NDArray[np.int32], reach: NDArray[np.float64]) -> np.float32:
    clears = clear != 0
    last = np.where(clears.any(axis=1), COLUMNS - np.argmax(clears[:, ::-1], axis=1), 0)  # columns from the first
    return np.float32(max(1.001 * ((last / COLUMNS - 0.5) * 2 * reach).max(), 0))


def origin_block(T_world_camera: Transform, config: Config) -> NDArray[np.int64]:
    """Return the camera's block (3,); kernels count blocks and metres from there to keep float32 exact."""
    return np.floor(T_world_camera[:3, 3] / np.multiply(SIDE, config.cell)).astype(np.int64)


def check_place(T_world_sensor: Transform, config: Config) -> None:
    """Raise FrameRefused `pose_too_far` if a sensor at this pose sees cells that no map can have."""
    limit = INDEX_LIMIT - (2 << _cells.WIDE)
    if not (np.abs(T_world_sensor[:3, 3]) < limit * np.array(config.cell)).all():
        detail = f"the pose is more than {limit} cells from the map's origin; subtract an offset, or use larger cells"
        raise FrameRefused("pose_too_far", detail)


def rays_of(image: DepthImage, config: Config) -> Rays:
    """Return the kernel rays of a depth image's camera and pose."""
    T, (columns, rows), stretch = image.T_world_sensor, camera_rays(image.camera), _stretch(config)
    corner = origin_block(T, config) * np.multiply(SIDE, config.cell)
    forward = np.ascontiguousarray((stretch[:, None] * T[:3, :3]).T, np.float32)
    position = (stretch * (T[:3, 3] - corner)).astype(np.float32)
    return Rays(forward, position, columns, rows, np.float32(config.voxel_size), np.float32(config.max_range))


def _stretch(config: Config) -> NDArray[np.float64]:
    """Return the factors (3,) that make cells cubes of `voxel_size`."""
    return config.voxel_size / np.array(config.cell)


class Views:
    """Makes the kernel views of one pinhole camera; a view is valid until the next is made.

    rim_share: a cell counts as inside the image if its centre is at most this share of its size outside.
    """

    def __init__(self, camera: PinholeCamera, config: Config, rim_share: float = RIM_SHARE):
        size, fx, fy = config.voxel_size, camera.fx, camera.fy
        rim = rim_share * size * np.array([fx, fy])
        intrinsics = np.array([fx, fy, camera.cx, camera.cy])
        shape = np.array([camera.width, camera.height], float)
        self._given = np.array(config.cell, float), size, intrinsics, shape, rim, CELL_CENTRES
        self.block = np.zeros(3, np.int32)
        columns, rows = camera_rays(camera)
        self._view = View(
            rotation=np.zeros((3, 3), np.float32),
            forward=np.zeros((3, 3), np.float32),
            position=np.zeros(3, np.float32),
            sides=np.zeros((4, 5), np.float32),
            columns=columns,
            rows=rows,
            intrinsics=intrinsics.astype(np.float32),
            width=np.int32(camera.width),
            height=np.int32(camera.height),
            voxel_size=np.float32(size),
            max_range=np.float32(config.max_range),
            spread=np.float32(WINDOW_SHARE * fx * size),
            rim=rim.astype(np.float32),
            steps=np.zeros((3, SIDE**3), np.float32),
        )

    @property
    def spread(self) -> np.float32:
        """Size of the tiles of a cell's window image in pixels, times depth."""
        return self._view.spread

    def at(self, T_world_camera: Transform) -> View:
        """Return the view from this pose; `block` is then the camera's block (3,)."""
        view = self._view
        written = view.rotation, view.forward, view.position, view.sides, view.steps
        _cells.aim(np.ascontiguousarray(T_world_camera, float), *self._given, self.block, *written)
        return view


def check_view(camera: VirtualCamera, config: Config) -> None:
    """Raise FrameRefused `bad_camera` if the view up to the maximum range is out of proportion to the image."""
    blocks = camera.volume(config.max_range) / (CELLS * float(np.prod(config.cell)))
    if blocks > _fitting_blocks(camera):
        seen = f"{camera.width}x{camera.height} pixels see {CELLS * blocks:.2g} cells up to {config.max_range:g} m"
        raise FrameRefused("bad_camera", f"{seen}: {CURE}")


def check_blocks(blocks: int, camera: VirtualCamera) -> None:
    """Raise FrameRefused `view_too_large` for evidence on more blocks than can be kept, or than suit the image."""
    most = min(MAX_BLOCKS, _fitting_blocks(camera))
    if blocks > most:
        raise FrameRefused("view_too_large", f"the frame has evidence on more than {CELLS * most:.2g} cells: {CURE}")


def _fitting_blocks(camera: VirtualCamera) -> int:
    return MIN_BLOCKS + BLOCKS_PER_PIXEL * camera.width * camera.height


def uses_wide_keys(camera: VirtualCamera, reach: float, config: Config) -> bool:
    """Return whether cells that a camera sees at depths up to `reach` metres need keys of 64 bits.

    Raises FrameRefused `bad_camera` if these do not suffice either.
    """
    cells = farthest_cells(camera, reach, config)
    if cells >= 1 << (_cells.WIDE - 1):
        detail = f"the camera's view and noise reach {cells:.2g} cells far, more than can be counted"
        raise FrameRefused("bad_camera", f"{detail}: check focal length and baseline, or use larger cells")
    return cells >= 1 << (_cells.NARROW - 1)


@lru_cache
def camera_rays(camera: VirtualCamera) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return `camera.rays()`, made once."""
    return camera.rays()


def farthest_cells(camera: VirtualCamera, reach: float, config: Config) -> float:
    """Return the most cells from its block's corner that a camera can see, at depths up to `reach` metres.

    One cell is added: points count as hits even behind the middle of the farthest cells.
    """
    columns, rows = camera_rays(camera)
    corner = np.hypot(np.abs(columns).max(), np.hypot(*rows.T).max())
    return float(corner * (reach + float(np.linalg.norm(config.cell))) / min(config.cell) + SIDE)
