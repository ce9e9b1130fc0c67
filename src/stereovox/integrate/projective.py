# SPDX-License-Identifier: Apache-2.0
"""The projective integrator: cells are projected into the depth image, from coarse boxes to single cells.

A frame updates each cell at most once. Cells that hold a measured point get its hit evidence, scattered from the
pixels; every other cell gets the evidence of the farthest pixel in a window of about its own size. So thin near
obstacles stay, small holes do not matter, and the result is that of exact ray casting (docs/integrators.md has
figures).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from math import floor, log2
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.config import Config
from stereovox.frame import DepthImage
from stereovox.integrate import _hits, _lanes, _projective, _windows
from stereovox.integrate._cells import NEAR_PLANE, NO_RETURN
from stereovox.integrate.faces import Face, WideCamera, cut, faces_of
from stereovox.integrate.views import (
    RIM_SHARE,
    KernelTable,
    PerCamera,
    View,
    Views,
    check_blocks,
    check_view,
    sensor_table,
    uses_wide_keys,
)
from stereovox.maps.blocks import CELLS, BlockPool
from stereovox.maps.evidence import Evidence
from stereovox.sensors import make_sensor
from stereovox.sensors.model import InverseSensorModel
from stereovox.threads import in_shards, run_both, shards

LEVELS = _windows.COARSEST + 1
"""Number of window sizes: one pixel, and three tiles of 1 to 128 pixels."""
ROOM = 4096
"""Initial capacity of a camera's block lists."""
WORTH_A_THREAD = 256
"""Blocks whose evaluation takes longer than waking a thread."""


class Projective:
    """Evidence by projection, coarse to fine. Raises ConfigError for a bad sensor model."""

    def __init__(self, config: Config):
        self._config = config
        sensor = make_sensor(config.sensor)
        self._eyes = PerCamera(partial(_eye, sensor, config))  # without `self`, which would keep itself alive
        self._faces = PerCamera(partial(_eyes_of_faces, sensor, config))

    def evidence(self, image: DepthImage) -> Evidence:
        """Return the evidence of `image` on the cells it sees; wide images are cut into pinhole images."""
        if isinstance(image.camera, PinholeCamera):
            return self._of_pinhole(self._eyes[image.camera], image, image.depth_m)
        faces = [(eye, cut(image, face, self._config.max_range)) for face, eye in self._faces[image.camera]]
        return strongest([self._of_pinhole(eye, face.image, face.ends) for eye, face in faces])

    def _of_pinhole(self, eye: _Eye, image: DepthImage, ends: NDArray[np.float32]) -> Evidence:
        depth_m = image.depth_m
        view = eye.views.at(image.T_world_sensor)
        threads = self._config.threads if eye.mixed_before >= 2 * WORTH_A_THREAD else 1
        _, (windows, n_free, n_mixed) = run_both(
            threads,
            lambda: eye.hits.find(depth_m, view),
            lambda: eye.candidates(depth_m, ends, view),
        )
        free, mixed, hit_of = eye.with_hits(n_free, n_mixed)
        eye.mixed_before = len(mixed)
        values = np.empty((len(mixed), CELLS), np.int16)
        hits = eye.hits.blocks.values

        def one_shard(part: slice) -> None:
            _projective.evaluate(
                depth_m, view, eye.table, windows, mixed[part], hit_of[part], hits, values[part], _layer_scratch()
            )  # fmt: skip

        in_shards(one_shard, shards(len(mixed), min(threads, len(mixed) // WORTH_A_THREAD or 1)))
        free_values = np.empty(len(free), np.int16)
        _projective.passed(view, eye.table, free, free_values)
        origin = eye.views.block
        return Evidence(mixed + origin, values, free + origin, free_values)


class LayerScratch(NamedTuple):
    """Memory for one layer of cells, (LAYER,) each."""

    depths: NDArray[np.float32]  # of the cells' centres
    measured: NDArray[np.float32]  # window values there
    scale: NDArray[np.float32]  # table columns a metre
    at: NDArray[np.int32]  # places of window values, then of entries of the sensor table
    row: NDArray[np.int32]  # rows of the sensor table, then its entries


def _layer_scratch() -> LayerScratch:
    floats, ints = np.empty((3, _projective.LAYER), np.float32), np.empty((2, _projective.LAYER), np.int32)
    return LayerScratch(*floats, *ints)


class _Eye:
    """Tools of one camera: its sensor table, and memory for the evidence of its images."""

    def __init__(self, camera: PinholeCamera, table: KernelTable, config: Config, rim_share: float):
        check_view(camera, config)
        self._camera, self.table = camera, table
        self.mixed_before = 0  # blocks evaluated in the frame before: the estimate for the next
        self.views = Views(camera, config, rim_share)
        self.hits = HitFinder(camera, table, config)
        self._windows = WindowBuilder(camera)
        self._max_range = config.max_range
        self._free, self._mixed = (np.empty((ROOM, 3), np.int32) for _ in range(2))
        self._stack = np.empty((_projective.STACK, 4), np.int32)

    def candidates(
        self, depth_m: NDArray[np.float32], ends: NDArray[np.float32], view: View
    ) -> tuple[Windows, int, int]:
        """List free and mixed blocks; return the window images, and how many there are of each.

        ends: `depth_m`, but for pixels that see nothing: the depth up to which that is so.
        """
        windows, farthest = self._windows.build(ends, float(view.spread) / self._max_range)
        if self.table.marks:
            self._windows.build_nearest(depth_m)
        end, nearest = np.float32(self._end_of_view(farthest)), self._windows.nearest
        while True:
            lists = self._stack, self._free, self._mixed
            n_free, n_mixed = _projective.candidates(view, self.table, windows, nearest, end, *lists)
            if n_free >= 0:
                return windows, n_free, n_mixed
            check_blocks(4 * len(self._free), self._camera)
            self._free, self._mixed = (np.empty((4 * len(self._free), 3), np.int32) for _ in range(2))

    def with_hits(self, n_free: int, n_mixed: int) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]:
        """Return the free blocks, the mixed ones, those with hits included, and where each has its hits (-1: none)."""
        hits = self.hits.blocks
        most = n_mixed + len(hits)
        if most > len(self._mixed):
            self._mixed = np.concatenate([self._mixed, np.empty((most, 3), np.int32)])
        hit_of, listed = np.empty(most, np.int32), np.zeros(len(hits), np.uint8)
        n_free, n_mixed = _projective.with_hits(
            hits.table, hits.coords, len(hits), self._free, n_free, self._mixed, n_mixed, hit_of, listed
        )
        return self._free[:n_free], self._mixed[:n_mixed], hit_of[:n_mixed]

    def _end_of_view(self, farthest: float) -> float:
        """Return the depth in metres beyond which this image gives no evidence."""
        if farthest >= NO_RETURN:
            return self._max_range
        behind = float(self.table.reach[-1] if self.table.marks else self.table.behind)
        return min(self._max_range, max(float(farthest), 10 * float(NEAR_PLANE)) * 1.001 + behind)


def _eye(sensor: InverseSensorModel, config: Config, camera: PinholeCamera, rim_share: float = RIM_SHARE) -> _Eye:
    return _Eye(camera, sensor_table(sensor, config, camera), config, rim_share)


def _eyes_of_faces(sensor: InverseSensorModel, config: Config, camera: WideCamera) -> list[tuple[Face, _Eye]]:
    return [(face, _eye(sensor, config, face.camera, 0.0)) for face in faces_of(camera, config)]


class HitFinder:
    """Finds the hits of one camera, and keeps the memory for them.

    blocks: the result of `find`: evidence in thousandths on each cell that holds a point, 0 elsewhere; blocks count
    from the one the camera stands in.
    """

    def __init__(self, camera: PinholeCamera, table: KernelTable, config: Config):
        self.blocks = BlockPool(np.int16, capacity=1024)
        self._camera, self._table = camera, table
        self._full_share = np.float32(config.projective.full_share)
        pixels = _hits.GROUP * -(-camera.width // _hits.GROUP)
        kind = np.int64 if uses_wide_keys(camera, config.max_range, config) else np.int32
        self._keys, self._seen = np.zeros((2, camera.width + 1), kind), np.zeros(_hits.SEEN, kind)
        self._news, self._fresh = np.zeros(pixels, np.uint8), np.zeros(pixels + 1, np.int32)
        self._listed = np.zeros(camera.height * camera.width, np.int32)
        floats, ints = np.zeros((11, _hits.LANES), np.float32), np.zeros(_hits.LANES, np.int32)
        self._lanes = HitLanes(*floats, ints)

    def find(self, depth_m: NDArray[np.float32], view: View) -> None:
        """Fill `blocks` from a REP 117 depth image."""
        blocks = self.blocks
        blocks.clear()
        while (n := self._scatter(depth_m, view)) < 0:
            check_blocks(2 * len(blocks.coords), self._camera)
            blocks.clear()
            blocks.reserve(2 * len(blocks.coords))
        _hits.weigh(
            depth_m, view, self._table, self._full_share, self._listed, n, blocks.coords, blocks.values, self._lanes
        )

    def _scatter(self, depth_m: NDArray[np.float32], view: View) -> int:
        scratch = self._keys, self._news, self._fresh, self._seen, self._listed
        blocks = self.blocks
        return _hits.scatter(depth_m, view, *scratch, blocks.table, blocks.coords, blocks.count, blocks.values)


class HitLanes(NamedTuple):
    """Memory for the cells that are weighed together, (LANES,) each."""

    x: NDArray[np.float32]  # the centre in camera axes, x and y times the focal length
    y: NDArray[np.float32]
    z: NDArray[np.float32]
    share: NDArray[np.float32]  # part of the footprint that measures a depth within the cell
    u: NDArray[np.float32]  # upper left corner of the footprint
    v: NDArray[np.float32]
    samples: NDArray[np.float32]  # along each side of it
    step: NDArray[np.float32]  # pixels between samples
    looked: NDArray[np.float32]  # samples inside the image so far
    depth: NDArray[np.float32]  # measured at the present sample
    counts: NDArray[np.float32]  # whether that lies inside the image, 0 or 1
    at: NDArray[np.int32]  # its pixel


class Windows(NamedTuple):
    """All window images in one; see `_windows.py`."""

    image: NDArray[np.float32]  # flat; `_windows.place` says where a pixel stands; the last entry is UNSEEN
    pitch: np.int32
    height: np.int32
    lows: NDArray[np.float32]
    highs: NDArray[np.float32]
    tile_offset: NDArray[np.int32]  # (levels, 2) where tiles of 16 and of 64 start
    tile_width: NDArray[np.int32]  # (levels, 2) tiles in a row
    first: np.int32  # lowest level that is filled


class WindowBuilder:
    """Builds one camera's window images, and keeps the memory for them. shape: (levels, 2) rows and columns of each."""

    def __init__(self, camera: PinholeCamera):
        h, w = camera.height, camera.width
        coarsest = 1 << (LEVELS - 2)
        strides = np.array([1] + [1 << level for level in range(LEVELS - 1)])
        self.shape = np.stack([-(-h // strides), -(-w // strides)], axis=1).astype(np.int32)
        tiles = np.stack([-(-self.shape // 16), -(-self.shape // 64)], axis=1)
        tile_offset = _starts(tiles.prod(axis=2).ravel()).reshape(LEVELS, 2)
        pitch = coarsest * -(-w // coarsest)
        size = pitch * (2 * h + -(-h // 2))
        self._scratch = np.zeros(size, np.float32), np.zeros((4, pitch), np.float32), *np.zeros((4, pitch), np.float32)
        lows, highs = np.zeros((2, tiles.prod(axis=2).sum()), np.float32)
        image = np.append(np.zeros(size, np.float32), _projective.UNSEEN)
        self._windows = Windows(
            image, np.int32(pitch), np.int32(h), lows, highs,
            tile_offset, np.ascontiguousarray(tiles[:, :, 1], np.int32), np.int32(0),
        )  # fmt: skip
        self.nearest = tuple(np.zeros((-(-h // size), -(-w // size)), np.float32) for size in (16, 64))

    def empty(self, smallest_tile: float) -> Windows:
        """Return the window images from tiles of about `smallest_tile` pixels on, as the image before has left them."""
        first = min(max(floor(log2(max(smallest_tile, 1e-9))) + 2, 0), LEVELS - 1)
        return self._windows._replace(first=np.int32(first))

    def build(self, depth_m: NDArray[np.float32], smallest_tile: float) -> tuple[Windows, float]:
        """Return the window images of a REP 117 depth image, from tiles of about `smallest_tile` pixels on.

        With them the image's farthest depth in metres, `NO_RETURN` where a pixel saw nothing.
        """
        windows = self.empty(smallest_tile)
        base, *rows = self._scratch
        farthest = _windows.build(
            depth_m.reshape(-1), base, windows.image, *rows, windows.lows, windows.highs,
            self.shape, windows.tile_offset, windows.tile_width, int(windows.first),
        )  # fmt: skip
        return windows, farthest

    def build_nearest(self, depth_m: NDArray[np.float32]) -> None:
        """Fill `nearest`, for sensor models that mark cells beside the hit."""
        low16, low64 = (tiles.reshape(-1) for tiles in self.nearest)
        _windows.nearest_tiles(depth_m.reshape(-1), *depth_m.shape, low16, low64)


def _starts(sizes: NDArray[np.int64]) -> NDArray[np.int32]:
    return np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(np.int32)


def strongest(parts: Sequence[Evidence]) -> Evidence:
    """Return one frame's evidence: a cell keeps the strongest, positive before negative, of all `parts`.

    Blocks that are wholly free in one part alone stay uniform; they are expanded where another part has the block too.
    """
    if len(parts) == 1:
        return parts[0]
    if not parts:
        return Evidence(
            np.empty((0, 3), np.int32),
            np.empty((0, CELLS), np.int16),
            np.empty((0, 3), np.int32),
            np.empty(0, np.int16),
        )
    pool = BlockPool(np.int16, capacity=max(1, sum(len(part.coords) + len(part.uniform) for part in parts)))
    free, free_values, shared = _alone(parts)
    for part, both in zip(parts, shared, strict=True):
        _lanes.merge(pool.values, part.values, pool.insert(part.coords), False)
        spelt = np.repeat(part.uniform_values[both, None], CELLS, axis=1)
        _lanes.merge(pool.values, spelt, pool.insert(part.uniform[both]), False)
    n = len(pool)
    return Evidence(pool.coords[:n].copy(), pool.values[:n].copy(), free, free_values)


def _alone(parts: Sequence[Evidence]) -> tuple[NDArray[np.int32], NDArray[np.int16], list[NDArray[np.bool_]]]:
    """Return the uniform blocks that no part expands, each once with its strongest value, and for each part a mask of
    its own uniform blocks that another part expands."""
    spelt = np.unique(np.concatenate([part.coords for part in parts]), axis=0)
    known = {tuple(block) for block in spelt.tolist()}
    shared = [np.array([tuple(b) in known for b in part.uniform.tolist()], bool) for part in parts]
    pairs = list(zip(parts, shared, strict=True))
    alone, of_block = np.unique(
        np.concatenate([part.uniform[~both] for part, both in pairs]), axis=0, return_inverse=True
    )
    values = np.zeros(len(alone), np.int16)
    np.minimum.at(values, of_block.ravel(), np.concatenate([part.uniform_values[~both] for part, both in pairs]))
    return alone.astype(np.int32).reshape(-1, 3), values, shared
