# SPDX-License-Identifier: Apache-2.0
"""The projective integrator on a graphics card: evidence is made and stays there, identical to that of `projective`.

Pinhole cameras only. Per frame the depth image and the view go to the card, and a few block counts come back.
Imported only if `device = "cuda"`.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.config import Config
from stereovox.errors import ConfigError, FrameRefused
from stereovox.frame import DepthImage
from stereovox.integrate import _gpu
from stereovox.integrate.projective import ROOM, make_windows
from stereovox.integrate.views import PerCamera, View, Views, check_blocks, check_view, sensor_table, uses_wide_keys
from stereovox.kernels._gpu import gpu_array, launch, to_gpu
from stereovox.kernels.device import check_device
from stereovox.maps.storage.blocks import CELLS, table_size
from stereovox.maps.storage.gpu import GpuArrays, GpuEvidence
from stereovox.sensors import make_sensor
from stereovox.sensors.protocol import InverseSensorModel

HIT_ROOM = 1024
"""Initial room for blocks with hits."""


class GpuProjective:
    """Evidence by projection on a graphics card. Raises ConfigError for a bad sensor model, or without a card."""

    def __init__(self, config: Config):
        check_device()
        self._eyes = PerCamera(partial(GpuEye, make_sensor(config.sensor), config))

    def evidence(self, image: DepthImage) -> GpuEvidence:
        """Return the evidence of `image` on the cells it sees; its memory is reused by the next call.

        Raises ConfigError for a wide camera, FrameRefused `memory_full` if the card has no room for it.
        """
        if not isinstance(image.camera, PinholeCamera):
            raise ConfigError('device "cuda" maps pinhole cameras only, but this one is wider; use device "cpu"')
        try:
            return self._eyes[image.camera].evidence(image)
        except MemoryError as error:
            raise FrameRefused(
                "memory_full", f'{error}; lower max_range, or use larger cells, smaller images or device "cpu"'
            ) from None


class GpuEye:
    """Tools of one camera on the card: its sensor table, and memory for the evidence of its images."""

    def __init__(self, sensor: InverseSensorModel, config: Config, camera: PinholeCamera):
        check_view(camera, config)
        self._camera, self._views = camera, Views(camera, config)
        self._table = to_gpu(sensor_table(sensor, config, camera))
        self._view = GpuView(self._views.at(np.eye(4)))
        self._windows = GpuWindows(camera, float(self._views.spread) / config.max_range, marks=bool(self._table.marks))
        self._hits = GpuHits(camera, config)
        self._depth_m = gpu_array((camera.height, camera.width), np.float32)
        self._counts = gpu_array(_gpu.COUNTS, np.int32)
        self._boxes = gpu_array((3, 2), np.int32)
        self._make_room(ROOM)

    def evidence(self, image: DepthImage) -> GpuEvidence:
        """Return the evidence of an image of this camera. Raises FrameRefused `view_too_large`."""
        self._depth_m.copy_to_device(np.ascontiguousarray(image.depth_m, np.float32))
        view = self._view.at(self._views.at(image.T_world_sensor))
        origin = tuple(self._views.block)
        flat = self._depth_m.reshape(self._depth_m.size)
        self._windows.build(flat, self._table)
        while True:
            self._list_blocks(flat, view)
            self._evaluate(view, origin)
            counts = self._counts.copy_to_host()
            if self._has_room(counts):
                return GpuEvidence(self._made, int(counts[_gpu.SEEN_MIXED]), int(counts[_gpu.FREE_BLOCKS]))

    def _list_blocks(self, flat: Any, view: View) -> None:
        """List free and mixed blocks, and the cells and blocks with hits."""
        counts, windows, hits = self._counts, self._windows, self._hits
        launch(_gpu.reset, hits.claims, hits.block_claims, hits.table, counts)
        seen = view, self._table, windows.on_gpu
        launch(_gpu.find_boxes, *seen, self._boxes)
        seen = *seen, windows.nearest
        large, middle, mixed, free = self._large, self._middle, self._mixed, self._free
        launch(_gpu.cull_coarse, *seen, self._boxes, free, large, counts)
        launch(_gpu.cull, *seen, large, _gpu.LARGE, 2, free, middle, _gpu.MIDDLE, counts)
        launch(_gpu.cull, *seen, middle, _gpu.MIDDLE, 1, free, mixed, _gpu.SEEN_MIXED, counts)
        hits.find(flat, view, self._table, counts)

    def _evaluate(self, view: View, origin: tuple[np.int32, ...]) -> None:
        counts, hits, made = self._counts, self._hits, self._made
        launch(_gpu.match_hits, hits.table, hits.coords, self._mixed, self._hit_of, hits.taken, counts)
        launch(_gpu.append_hits, hits.coords, self._mixed, self._hit_of, hits.taken, counts)
        launch(
            _gpu.evaluate, self._depth_m, view, self._table, self._windows.on_gpu, origin, self._mixed, self._hit_of,
            hits.values, counts, made.coords, made.values, made.said,
        )  # fmt: skip
        free = self._free, counts, made.uniform, made.steps
        launch(_gpu.passed, view, self._table, origin, hits.table, hits.coords, *free)

    def _has_room(self, counts: NDArray[np.int32]) -> bool:
        """Return whether all lists were long enough; if not, make them longer for another try."""
        most = int(counts[[_gpu.LARGE, _gpu.MIDDLE, _gpu.SEEN_FREE, _gpu.SEEN_MIXED]].max())
        hit_blocks, room, hit_room = int(counts[_gpu.HIT_BLOCKS]), len(self._free), len(self._hits.coords)
        if most > room:
            check_blocks(4 * room, self._camera)
            self._make_room(4 * room)
        if hit_blocks > hit_room:
            check_blocks(2 * hit_room, self._camera)
            self._hits.make_room(2 * hit_room)
        return most <= room and hit_blocks <= hit_room

    def _make_room(self, blocks: int) -> None:
        """Make lists for this many blocks of each kind: all of them, or none if memory is short."""
        lists = [gpu_array((blocks, 3), np.int32) for _ in range(4)]
        hit_of = gpu_array(blocks, np.int32)
        made = GpuArrays(
            coords=gpu_array((blocks, 3), np.int32),
            values=gpu_array((blocks, CELLS), np.int16),
            said=gpu_array(blocks, np.int16),
            uniform=gpu_array((blocks, 3), np.int32),
            steps=gpu_array(blocks, np.int16),
        )
        (self._large, self._middle, self._free, self._mixed), self._hit_of, self._made = lists, hit_of, made


class GpuView:
    """The views of one camera on the card; the parts that change per frame are copied in one piece."""

    def __init__(self, view: View):
        names = [name for name, part in zip(view._fields, view, strict=True) if isinstance(part, np.ndarray)]
        self._names = [name for name in names if name not in ("columns", "rows", "intrinsics", "rim")]
        shapes = [getattr(view, name).shape for name in self._names]
        ends = np.cumsum([int(np.prod(shape)) for shape in shapes])
        self._buffer = gpu_array(int(ends[-1]), np.float32)
        starts = [0, *ends[:-1].tolist()]
        parts = {
            name: self._buffer[start:end].reshape(shape)
            for name, start, end, shape in zip(self._names, starts, ends.tolist(), shapes, strict=True)
        }
        fixed = {name: to_gpu(getattr(view, name)) for name in names if name not in self._names}
        self._view = view._replace(**parts, **fixed)

    def at(self, view: View) -> View:
        """Return `view` on the card; it is valid until the next call."""
        self._buffer.copy_to_device(np.concatenate([getattr(view, name).ravel() for name in self._names]))
        return self._view


class GpuWindows:
    """One camera's window images on the card; see `make_windows`."""

    def __init__(self, camera: PinholeCamera, smallest_tile: float, marks: bool):
        windows, _, nearest = make_windows(camera, smallest_tile)
        self.on_gpu, self.nearest = to_gpu(windows), to_gpu(nearest)
        self._base = gpu_array(windows.image.size, np.float32)
        self._levels, self._size, self._marks = range(1, len(windows.shape)), windows.shape[0].tolist(), marks

    def build(self, depth_m: Any, table: Any) -> None:
        """Fill the images from a flat REP 117 depth image on the card; table: its `KernelTable` there."""
        for level in self._levels:
            launch(_gpu.shrink, depth_m, self._base, self.on_gpu, level)
        launch(_gpu.widen, self._base, self.on_gpu)
        if table.edges:
            launch(_gpu.widen_clear, self._base, self.on_gpu, table)
        launch(_gpu.fill_tiles, self.on_gpu, table.edges)
        launch(_gpu.join_tiles, self.on_gpu)
        if self._marks:
            for size, tiles in zip((16, 64), self.nearest, strict=True):
                launch(_gpu.nearest_tiles, depth_m, *self._size, size, tiles)


class GpuHits:
    """Finds the hits of one camera on the card, and keeps the memory for them; see `HitFinder`.

    coords, values: (room, 3) and (room, 512) of the blocks with hits, counted from the camera's block. table: their
    hash. taken: (room,) uint8, whether a block is among the mixed ones. claims, block_claims: hashes of the keys of
    cells and blocks with hits.
    """

    def __init__(self, camera: PinholeCamera, config: Config):
        self._wide = bool(uses_wide_keys(camera, config.max_range, config))
        self._full_share = np.float32(config.projective.full_share)
        pixels = camera.width * camera.height
        slots = 1 << (3 * pixels // 2).bit_length()
        self.claims, self.block_claims = gpu_array(slots, np.int64), gpu_array(slots, np.int64)
        self._listed = gpu_array(pixels, np.int64)
        self.make_room(HIT_ROOM)

    def make_room(self, blocks: int) -> None:
        """Make room for this many blocks with hits: in all arrays, or in none if memory is short."""
        self.coords, self.values, self.table, self.taken = (
            gpu_array((blocks, 3), np.int32),
            gpu_array((blocks, CELLS), np.int16),
            gpu_array(table_size(blocks), np.int32),
            gpu_array(blocks, np.uint8),
        )

    def find(self, depth_m: Any, view: View, table: Any, counts: Any) -> None:
        """List the blocks with hits of a flat REP 117 depth image on the card; all tables must be empty."""
        launch(_gpu.list_cells, depth_m, view, self._wide, self.claims, self._listed, counts)
        launch(_gpu.list_blocks, self._listed, self._wide, self.block_claims, self.coords, counts)
        launch(_gpu.enter_blocks, self.table, self.coords, self.values, self.taken, counts)
        launch(
            _gpu.weigh, depth_m, view, table, self._full_share, self._listed, self._wide, self.table, self.coords,
            self.values, counts,
        )  # fmt: skip
