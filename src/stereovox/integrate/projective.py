# SPDX-License-Identifier: Apache-2.0
"""The projective integrator: cells are projected into the depth image, from coarse boxes to single cells.

A frame updates each cell at most once. Cells that hold a measured point get its hit evidence, scattered from the
pixels; every other cell gets evidence by how far one sees through a window of about its own size (`_windows`). So thin
near obstacles stay, small holes do not matter, and the result is close to exact ray casting, which clears more
(docs/integrators.md has figures).
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
from stereovox.integrate.cube_faces import Face, WideCamera, cut, faces_of
from stereovox.integrate.views import (
    RIM_SHARE,
    KernelTable,
    PerCamera,
    View,
    Views,
    aligned,
    check_blocks,
    check_view,
    sensor_table,
    uses_wide_keys,
)
from stereovox.kernels.threads import Scratch, in_shards, run_both, shards
from stereovox.maps.cells.evidence import Evidence
from stereovox.maps.storage.blocks import CELLS, BlockPool
from stereovox.sensors import make_sensor
from stereovox.sensors.protocol import InverseSensorModel

LEVELS = _windows.COARSEST + 1
"""Number of window sizes: one pixel, and three tiles of 1 to 128 pixels."""
ROOM = 4096
"""Initial capacity of a camera's block lists."""
WORTH_A_THREAD = 256
"""Number of blocks whose evaluation takes longer than waking a thread."""
WEIGHED_BY_A_THREAD = 2048
"""Number of cells with hits whose weighing does."""


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
        n_hits, (windows, n_free, n_mixed) = run_both(
            threads,
            lambda: eye.hits.scatter(depth_m, view),
            lambda: eye.candidates(depth_m, ends, view),
        )
        in_shards(
            lambda part: eye.hits.weigh(depth_m, view, part),
            shards(n_hits, min(threads, n_hits // WEIGHED_BY_A_THREAD or 1)),
        )
        free, free_values, mixed, hit_of = eye.with_hits(view, n_free, n_mixed)
        eye.mixed_before = len(mixed)
        values = np.empty((len(mixed), CELLS), np.int16)
        hits = eye.hits.blocks.values

        def one_shard(part: slice) -> None:
            blocks = mixed[part], hit_of[part], hits, values[part]
            eye.layers.lend(lambda layer: _projective.evaluate(depth_m, view, eye.table, windows, *blocks, layer))

        in_shards(one_shard, shards(len(mixed), min(threads, len(mixed) // WORTH_A_THREAD or 1)))
        origin = eye.views.block
        return Evidence(mixed + origin, values, free + origin, free_values)


class LayerScratch(NamedTuple):
    """Memory for one layer of cells, (LAYER,) each."""

    depths: NDArray[np.float32]  # of the cells' centres
    measured: NDArray[np.float32]  # window values there
    scale: NDArray[np.float32]  # clear depths there, then table columns per metre
    at: NDArray[np.int32]  # indices of window values, then of entries of the sensor table
    row: NDArray[np.int32]  # rows of the sensor table, then its entries


def _layer_scratch() -> LayerScratch:
    size = _projective.LAYER
    return LayerScratch(*(aligned(size, np.float32) for _ in range(3)), *(aligned(size, np.int32) for _ in range(2)))


class _Eye:
    """Tools of one camera: its sensor table, and memory for the evidence of its images."""

    def __init__(self, camera: PinholeCamera, table: KernelTable, config: Config, rim_share: float):
        check_view(camera, config)
        self._camera, self.table = camera, table
        self.mixed_before = 0  # blocks evaluated in the last frame: the estimate for the next
        self.views = Views(camera, config, rim_share)
        self.hits = HitFinder(camera, table, config)
        self._windows = make_windows(camera, float(self.views.spread) / config.max_range)
        self._free, self._mixed = (np.empty((ROOM, 3), np.int32) for _ in range(2))
        self._stack = np.empty((_projective.STACK, 4), np.int32)
        self.layers = Scratch(_layer_scratch)

    def candidates(
        self, depth_m: NDArray[np.float32], ends: NDArray[np.float32], view: View
    ) -> tuple[Windows, int, int]:
        """List free and mixed blocks; return the window images, and the numbers of both.

        ends: `depth_m`, but for pixels that see nothing, the depth up to which they see nothing.
        """
        windows, scratch, nearest = self._windows
        while True:
            lists = self._stack, self._free, self._mixed
            n_free, n_mixed = _projective.survey(depth_m, ends, view, self.table, windows, scratch, nearest, *lists)
            if n_free >= 0:
                return windows, n_free, n_mixed
            check_blocks(4 * len(self._free), self._camera)
            self._free, self._mixed = (np.empty((4 * len(self._free), 3), np.int32) for _ in range(2))

    def with_hits(
        self, view: View, n_free: int, n_mixed: int
    ) -> tuple[NDArray[np.int32], NDArray[np.int16], NDArray[np.int32], NDArray[np.int32]]:
        """Return the free blocks and their evidence, the mixed ones, including those with hits, and the index of the
        hits of each of these (-1: none).
        """
        hits = self.hits.blocks
        most = n_mixed + len(hits)
        if most > len(self._mixed):
            self._mixed = np.concatenate([self._mixed, np.empty((most, 3), np.int32)])
        hit_of, listed, values = np.empty(most, np.int32), np.zeros(len(hits), np.uint8), np.empty(n_free, np.int16)
        n_free, n_mixed = _projective.with_hits(
            view, self.table, hits.table, hits.coords, len(hits), self._free, n_free, self._mixed, n_mixed, hit_of,
            listed, values,
        )  # fmt: skip
        return self._free[:n_free], values[:n_free], self._mixed[:n_mixed], hit_of[:n_mixed]


def _eye(sensor: InverseSensorModel, config: Config, camera: PinholeCamera, rim_share: float = RIM_SHARE) -> _Eye:
    return _Eye(camera, sensor_table(sensor, config, camera), config, rim_share)


def _eyes_of_faces(sensor: InverseSensorModel, config: Config, camera: WideCamera) -> list[tuple[Face, _Eye]]:
    return [(face, _eye(sensor, config, face.camera, 0.0)) for face in faces_of(camera, config)]


class HitFinder:
    """Finds the hits of one camera, and keeps the memory for them.

    blocks: the result, once `scatter` has found the cells and `weigh` has weighed them all: evidence in thousandths
    on each cell that holds a point, 0 elsewhere; block coordinates count from the camera's block.
    """

    def __init__(self, camera: PinholeCamera, table: KernelTable, config: Config):
        self.blocks = BlockPool(np.int16, capacity=1024)
        self._camera, self._table = camera, table
        self._full_share = np.float32(config.projective.full_share)
        pixels = _hits.GROUP * -(-camera.width // _hits.GROUP)
        kind = np.int64 if uses_wide_keys(camera, config.max_range, config) else np.int32
        self._scratch = HitScratch(
            np.zeros((2, camera.width + 1), kind), np.zeros(pixels, np.uint8), np.zeros(pixels + 1, np.int32),
            np.zeros(_hits.SEEN, kind),
        )  # fmt: skip
        self._listed = np.zeros(camera.height * camera.width, np.int32)
        self._lanes = Scratch(_hit_lanes)

    def scatter(self, depth_m: NDArray[np.float32], view: View) -> int:
        """Find the cells that hold points of a REP 117 depth image; return their number."""
        blocks = self.blocks
        blocks.clear()
        while (n := self._scatter(depth_m, view)) < 0:
            check_blocks(2 * len(blocks.coords), self._camera)
            blocks.clear()
            blocks.reserve(2 * len(blocks.coords))
        return n

    def weigh(self, depth_m: NDArray[np.float32], view: View, part: slice) -> None:
        """Write the evidence of a part of the cells that were found."""
        hits = self._listed[part], self.blocks.coords, self.blocks.values
        self._lanes.lend(lambda lanes: _hits.weigh(depth_m, view, self._table, self._full_share, *hits, lanes))

    def _scatter(self, depth_m: NDArray[np.float32], view: View) -> int:
        blocks = self.blocks
        return _hits.scatter(
            depth_m, view, self._scratch, self._listed, blocks.table, blocks.coords, blocks.count, blocks.values
        )


class HitScratch(NamedTuple):
    """Memory of `_hits.scatter`."""

    keys: NDArray[np.signedinteger]  # (2, w + 1); int32 serves cells within 2^9 of the camera, int64 the rest
    news: NDArray[np.uint8]  # (w rounded up to GROUP,) whether a pixel's cell differs from its neighbours'
    fresh: NDArray[np.int32]  # one longer: the pixels with such cells
    seen: NDArray[np.signedinteger]  # (SEEN,) keys of recently entered cells


class HitLanes(NamedTuple):
    """Memory for the cells that are weighed together, (LANES,) each."""

    x: NDArray[np.float32]  # the centre in camera axes, x and y times the focal length
    y: NDArray[np.float32]
    z: NDArray[np.float32]
    share: NDArray[np.float32]  # share of the footprint that measures a depth within the cell
    u: NDArray[np.float32]  # upper left corner of the footprint
    v: NDArray[np.float32]
    samples: NDArray[np.float32]  # along each side of it
    step: NDArray[np.float32]  # pixels between samples
    looked: NDArray[np.float32]  # samples inside the image so far
    depth: NDArray[np.float32]  # measured at the current sample
    counts: NDArray[np.float32]  # whether that is inside the image, 0 or 1
    at: NDArray[np.int32]  # its pixel


def _hit_lanes() -> HitLanes:
    return HitLanes(*(aligned(_hits.LANES, np.float32) for _ in range(11)), at=aligned(_hits.LANES, np.int32))


class Windows(NamedTuple):
    """All window images in one; see `_windows.py`."""

    image: NDArray[np.float32]  # flat; `_windows.place` gives the index of a pixel; the last entry is UNSEEN
    clear: NDArray[np.float32]  # likewise: the depth up to which an area about twice as wide is plainly free
    pitch: np.int32
    height: np.int32
    shape: NDArray[np.int32]  # (levels, 2) rows and columns
    lows: NDArray[np.float32]  # least values of tiles of `clear`
    highs: NDArray[np.float32]  # farthest values of tiles of `image`
    tile_offset: NDArray[np.int32]  # (levels, 2) start of tiles of 16 and of 64
    tile_width: NDArray[np.int32]  # (levels, 2) tiles in a row
    first: np.int32  # lowest level that is filled


class WindowScratch(NamedTuple):
    """Memory of `_windows.build`."""

    base: NDArray[np.float32]  # like `Windows.image`: how far one sees through single tiles
    row: NDArray[np.float32]  # (pitch,), like the rest
    other: NDArray[np.float32]
    high_row: NDArray[np.float32]
    low_row: NDArray[np.float32]


Tiles = tuple[NDArray[np.float32], NDArray[np.float32]]
"""Nearest depth in tiles of 16 and of 64 pixels, for sensor models that mark cells next to the hit."""


def make_windows(camera: PinholeCamera, smallest_tile: float) -> tuple[Windows, WindowScratch, Tiles]:
    """Return a camera's window images, from tiles of about `smallest_tile` pixels up, and memory to build them."""
    h, w = camera.height, camera.width
    coarsest = 1 << (LEVELS - 2)
    strides = np.array([1] + [1 << level for level in range(LEVELS - 1)])
    shape = np.stack([-(-h // strides), -(-w // strides)], axis=1).astype(np.int32)
    tiles = np.stack([-(-shape // 16), -(-shape // 64)], axis=1)
    first = min(max(floor(log2(max(smallest_tile, 1e-9))) + 2, 0), LEVELS - 1)
    pitch = coarsest * -(-w // coarsest)
    size = pitch * (2 * h + -(-h // 2))
    image, clear = np.zeros((2, size + 1), np.float32)
    image[size] = clear[size] = _projective.UNSEEN
    lows, highs = np.zeros((2, tiles.prod(axis=2).sum()), np.float32)
    windows = Windows(
        image, clear, np.int32(pitch), np.int32(h), shape, lows, highs,
        _starts(tiles.prod(axis=2).ravel()).reshape(LEVELS, 2), np.ascontiguousarray(tiles[:, :, 1], np.int32),
        np.int32(first),
    )  # fmt: skip
    scratch = WindowScratch(np.zeros(size, np.float32), *np.zeros((4, pitch), np.float32))
    near16, near64 = (np.zeros((-(-h // tile), -(-w // tile)), np.float32) for tile in (16, 64))
    return windows, scratch, (near16, near64)


def _starts(sizes: NDArray[np.int64]) -> NDArray[np.int32]:
    return np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(np.int32)


def strongest(parts: Sequence[Evidence]) -> Evidence:
    """Return one frame's evidence: a cell keeps the strongest, positive before negative, of all `parts`.

    Blocks that are wholly free stay uniform, unless another part has evidence on single cells of the block.
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
    """Return the uniform blocks that no part has cell by cell, each once with its strongest value, and for each part a
    mask of its uniform blocks that another part has cell by cell."""
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
