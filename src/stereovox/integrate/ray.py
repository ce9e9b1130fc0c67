# SPDX-License-Identifier: Apache-2.0
"""Integrators that follow every pixel's ray: through every cell it crosses, or as a thin line of cells."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial
from math import ceil
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.rigs import VirtualCamera
from stereovox.config import Config
from stereovox.depth.prepare import downsample
from stereovox.errors import FrameRefused
from stereovox.frame import DepthImage
from stereovox.integrate import _lanes, _ray
from stereovox.integrate._lanes import LANES, MEMORY_BITS
from stereovox.integrate.views import (
    KernelTable,
    PerCamera,
    Rays,
    aligned,
    check_blocks,
    origin_block,
    rays_of,
    sensor_table,
    uses_wide_keys,
)
from stereovox.kernels.threads import in_shards, shards
from stereovox.maps.cells.evidence import Evidence
from stereovox.maps.storage.blocks import CELLS, SIDE, BlockPool
from stereovox.sensors import make_sensor
from stereovox.sensors.protocol import InverseSensorModel

Floats = NDArray[np.float32]
Ints = NDArray[np.int32]
Keys = NDArray[np.signedinteger]

MOST_LARGER = 64
OBLIQUE = 1.5
"""Cells that a ray crosses per cell length of depth: the average over all directions."""
MAX_CELL_PX = 512
"""Most pixels along a cell at a depth of one metre; with more, `_lanes` would round the weight of a ray to 0."""


STEPS_PER_MS, BLOCKS_PER_MS = 200_000, 100
"""Least number of cells that rays cross in a millisecond, and of blocks new to the frame that are entered in one."""
OVERRUN = 4
"""Estimated time of a frame, in multiples of `deadline_ms`, above which its pixels are made larger. Below that, the
deadline's own levels suffice."""
STEPS_AT_ONCE, SLOW_STEPS = 20_000_000, 50_000_000
"""Cells after which Ctrl-C is checked, and cells of a frame (half a second) above which the user is warned."""


class Ray:
    """Evidence by ray casting: every cell that a ray crosses (Chien 2020, Alg 2).

    `ray.update = "every"`: each ray adds its evidence to each cell, weighted so that the rays through one cell count
    as about one (Chien 2020, Eq 3.21; the focal length of a smaller image contains the down-sampling ratio). `"once"`:
    a cell keeps the strongest evidence of the frame, as OctoMap does.
    """

    _kernel: ClassVar[Callable[..., bool]] = staticmethod(_ray.cast)

    def __init__(self, config: Config):
        sensor = make_sensor(config.sensor)
        self._config = config
        self._pools = [BlockPool(np.int32, capacity=8192) for _ in range(config.threads)]
        self._eyes = PerCamera(partial(_eye, sensor, config))
        self._warned = False

    def evidence(self, image: DepthImage) -> Evidence:
        """Return the evidence of `image` on the cells that its rays cross."""
        config, image = self._config, self._in_time(self._of_countable_rays(image))
        camera = image.camera
        eye, view = self._eyes[camera], rays_of(image, config)
        weight = np.float32(self._cell_px(camera) ** -2) if config.ray.update == "every" else None
        workers = len(shards(camera.height, config.threads))
        parts = [slice(n, camera.height, workers) for n in range(workers)]  # equally many long rays for each
        chunks = int(self._steps(image) / workers / STEPS_AT_ONCE) + 1
        in_shards(lambda part: self._follow(image, view, weight, eye, part, chunks), parts)
        pool = merged(self._pools[:workers], weight is not None)
        values = np.empty((len(pool), CELLS), np.int16)
        _lanes.to_thousandths(pool.values[: len(pool)], 0 if weight is None else _lanes.FRACTION_BITS, values)
        origin = origin_block(image.T_world_sensor, config).astype(np.int32)
        return Evidence(pool.coords[: len(pool)] + origin, values, np.empty((0, 3), np.int32), np.empty(0, np.int16))

    def _cell_px(self, camera: VirtualCamera) -> float:
        """Return the side of a cell in pixels at a depth of one metre."""
        return camera.focal_px / camera.binning * self._config.voxel_size

    def _of_countable_rays(self, image: DepthImage) -> DepthImage:
        """Return the image, or its block minima if the weight of one ray would be too small to count."""
        cell_px = self._cell_px(image.camera)
        if self._config.ray.update != "every" or cell_px <= MAX_CELL_PX:
            return image
        if isinstance(image.camera, PinholeCamera):
            return downsample(image, ceil(cell_px / MAX_CELL_PX))
        raise FrameRefused(
            "bad_camera",
            f"its image has {cell_px:.0f} pixels per cell at one metre, but ray.update every takes at most "
            f"{MAX_CELL_PX}; use integrator projective or ray.update once",
        )

    def _steps(self, image: DepthImage) -> float:
        """Return an estimate of the number of cells that the rays of an image cross."""
        ends = image.depth_m.clip(0, np.float32(self._config.max_range))  # -inf and NaN have no ray
        metres = float(np.nansum(ends, dtype=np.float64))
        return OBLIQUE * metres / self._config.voxel_size

    def _in_time(self, image: DepthImage) -> DepthImage:
        """Return the image, or its block minima if its rays would cross too many cells for the deadline.

        Raises FrameRefused `no_time` for a camera whose pixels cannot be merged.
        """
        steps = self._steps(image)
        if steps > SLOW_STEPS and not self._warned:
            self._warned = True
            line = (
                f"integrator {self._config.integrator} follows rays through {steps / 1e6:,.0f} million cells of "
                f"{self._config.voxel_size:g} m for one image, which is far from real time; "
                "use integrator projective, larger cells (voxel_size) or a shorter max_range"
            )
            warnings.warn(line, RuntimeWarning, stacklevel=2)
        deadline_ms = self._config.deadline_ms
        larger = 1 if deadline_ms is None else self._larger(image, steps, OVERRUN * deadline_ms)
        if larger == 1:
            return image
        if isinstance(image.camera, PinholeCamera):
            return downsample(image, min(larger, *image.depth_m.shape))
        cure = "use integrator projective, larger cells or a shorter max_range"
        raise FrameRefused("no_time", f"its rays cross {steps / 1e6:,.0f} million cells; {cure}")

    def _larger(self, image: DepthImage, steps: float, most_ms: float) -> int:
        """Return the factor by which pixels must grow for a frame of `steps` cells to take at most `most_ms`."""
        ends = np.minimum(image.depth_m, np.float32(self._config.max_range))
        pixel = (image.camera.binning / image.camera.focal_px) ** 2
        metres3 = float(np.nansum(ends**3, dtype=np.float64)) / 3 * pixel
        blocks = 2 * metres3 / (SIDE * self._config.voxel_size) ** 3  # twice: blocks at its faces are seen in part
        larger = 1
        while (
            steps / larger**2 / STEPS_PER_MS + min(steps / larger**2 / SIDE, blocks) / BLOCKS_PER_MS > most_ms
            and larger < MOST_LARGER
        ):
            larger += 1
        return larger

    def _follow(
        self, image: DepthImage, view: Rays, weight: np.float32 | None, eye: _Eye, part: slice, chunks: int
    ) -> None:
        """Follow the rays of some rows; the number of the first row selects the thread's memory.

        chunks: parts between which Ctrl-C is checked.
        """
        pool = self._pools[part.start]
        pool.clear()
        rows = range(part.start, part.stop, part.step)
        size = -(-len(rows) // chunks) or 1
        begin = 0
        while begin < len(rows):
            some = rows[begin : begin + size]
            if self._kernel(
                image.depth_m, view, eye.table, eye.look_up, weight, *eye.scratch[part.start],
                pool.table, pool.coords, pool.count, pool.values, some.start, some.stop, some.step,
            ):  # fmt: skip
                begin += size
                continue
            check_blocks(2 * len(pool.coords), image.camera)
            pool.clear()
            pool.reserve(2 * len(pool.coords))
            begin = 0


class Line(Ray):
    """Evidence by line drawing: one cell in each layer along a ray's longest axis (Chien 2020, Alg 1).

    Faster than casting, but it skips cells that a ray only grazes.
    """

    _kernel = staticmethod(_ray.draw)


def merged(pools: list[BlockPool], adds: bool) -> BlockPool:
    """Merge the evidence of several threads into the first one's pool: sums (`adds`), or the strongest; return it."""
    first, *others = pools
    for other in others:
        places = first.insert(other.coords[: len(other)])
        _lanes.merge(first.values, other.values[: len(other)], places, adds)
    return first


class _Eye(NamedTuple):
    """Tools of one camera: its sensor table, the same table with both signs together, and scratch for each thread."""

    table: KernelTable
    look_up: NDArray[np.int32]
    scratch: list[tuple[Lanes, Memory]]


def _eye(sensor: InverseSensorModel, config: Config, camera: VirtualCamera) -> _Eye:
    table = sensor_table(sensor, config, camera)
    wide = uses_wide_keys(camera, config.max_range + (float(table.reach[-1]) if table.marks else 0), config)
    scratch = [(make_lanes(wide), make_memory()) for _ in range(config.threads)]
    return _Eye(table, (table.clear + table.mark).ravel(), scratch)


class Lanes(NamedTuple):
    """State of the lanes, one number each. Depths are along the optical axis in metres, positions in cells from the
    camera's block."""

    column: Floats  # x/z of the ray
    depth: Floats  # measured depth, NO_RETURN for nothing up to the maximum range
    end: Floats  # depth at which the ray ends, negative for a lane without a ray
    entered: Floats  # depth at which the ray entered its present cell (or the depth of the sample)
    row: Ints  # row of the sensor table
    columns: Floats  # table columns per metre
    reach: Floats  # half width of the sensor table's row
    x: Floats  # the face through which the ray leaves its cell along x: whole numbers, kept as floats
    y: Floats
    z: Floats
    per_x: Floats  # depth per cell along each axis; for line drawing, cells per metre of depth
    per_y: Floats
    per_z: Floats
    hit: Keys  # key of the cell that holds the measured point, -1 without one
    cell: Keys  # key of the cell that the ray enters next
    key: Keys  # key of the cell that gets evidence in this step
    middle: Floats  # depth in the middle of the ray's path through it, NOWHERE for no evidence
    place: Ints  # its index in the sensor table, then the number there
    passed: Ints  # the same for the largest loss
    gain: Ints  # the evidence
    within: Ints  # sums of gains of earlier lanes of the same group
    groups: Ints  # sums of gains of earlier groups
    bit: Ints  # the lane's own bit: 1, 2, 4


class Memory(NamedTuple):
    """Cache of recently found blocks, so that most need no hash look-up: (2^MEMORY_BITS,) each."""

    block: NDArray[np.int64]  # key of its first cell, -1 for none
    place: NDArray[np.int64]  # its index in the pool


def make_lanes(wide: bool) -> Lanes:
    """Return scratch with keys of 64 bits (`wide`) or 32 bits, which serve cells within 2^9 of the camera."""
    types = {"Floats": np.float32, "Ints": np.int32, "Keys": np.int64 if wide else np.int32}
    kinds = {name: getattr(kind, "__forward_arg__", kind) for name, kind in Lanes.__annotations__.items()}
    arrays: dict[str, Any] = {name: aligned(LANES, types[kind]) for name, kind in kinds.items()}
    arrays["bit"][:] = (1 << np.arange(LANES, dtype=np.uint32)).view(np.int32)
    return Lanes(**arrays)


def make_memory() -> Memory:
    """Return an empty cache of blocks."""
    return Memory(*(np.full(1 << MEMORY_BITS, -1, np.int64) for _ in range(2)))
