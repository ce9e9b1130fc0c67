# SPDX-License-Identifier: Apache-2.0
"""The projective integrator: cells are projected into the depth image, from coarse boxes to single cells.

A frame updates each cell at most once. Cells that hold a measured point get its hit evidence, scattered from the
pixels; every other cell gets what the farthest pixel in a window about its own size says. So thin near obstacles
stay, small holes do not matter, and the outcome is what exact ray casting gives (docs/integrators.md has figures).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras import PinholeCamera
from stereovox.config import Config
from stereovox.frame import DepthImage
from stereovox.integrate import _cull, _evaluate, _hits, _keys
from stereovox.integrate._cells import NEAR_PLANE, NO_RETURN
from stereovox.integrate.faces import faces_of
from stereovox.integrate.merging import strongest
from stereovox.integrate.views import KernelTable, View, Views, farthest_cells, sensor_table
from stereovox.integrate.windows import WindowBuilder, Windows
from stereovox.maps.blocks import CELLS, BlockPool
from stereovox.maps.evidence import Evidence
from stereovox.sensors import make_sensor
from stereovox.shards import in_shards, shards, together


class Projective:
    """Evidence by projection, coarse to fine. Raises ConfigError for a bad sensor model."""

    def __init__(self, config: Config):
        self._config = config
        self._sensor = make_sensor(config.sensor)
        self._hits = BlockPool(np.int16, capacity=4096)
        self._free, self._mixed = (np.empty((16384, 3), np.int32) for _ in range(2))
        self._camera: PinholeCamera | None = None

    def evidence(self, image: DepthImage) -> Evidence:
        """Return what `image` says about the cells it sees; that of a wide camera is cut into pinhole images."""
        if isinstance(image.camera, PinholeCamera):
            return self._of_pinhole(image, image.camera)
        return strongest([self._of_pinhole(face, face.camera) for face in faces_of(image)])  # pyright: ignore

    def _of_pinhole(self, image: DepthImage, camera: PinholeCamera) -> Evidence:
        self._prepare(camera)
        depth_m, view = image.depth_m, self._views.at(image.T_world_sensor)
        (windows, n_free, n_mixed), _ = together(
            self._config.threads, lambda: self._candidates(depth_m, view), lambda: self._scatter_hits(depth_m, view)
        )
        free, mixed, hit_of = self._with_hits(n_free, n_mixed)
        values = self._evaluate(depth_m, view, windows, mixed, hit_of)
        origin = self._views.block
        return Evidence(mixed + origin, values, free + origin, int(self._table.free))

    def _prepare(self, camera: PinholeCamera) -> None:
        if camera == self._camera:
            return
        self._table: KernelTable = sensor_table(self._sensor, self._config, camera)
        self._views = Views(camera, self._config)
        self._builder = WindowBuilder(camera)
        self._keys = self._key_rows(camera)
        pixels = _hits.GROUP * -(-camera.width // _hits.GROUP)
        self._news = np.zeros(pixels, np.uint8)
        self._fresh = np.zeros(pixels + 1, np.int32)
        self._seen = np.zeros(_hits.SEEN, self._keys.dtype)
        self._listed = np.zeros(camera.height * camera.width, np.int32)
        self._weighing = np.zeros((9, _hits.LANES), np.float32)
        self._camera = camera

    def _key_rows(self, camera: PinholeCamera) -> NDArray[np.signedinteger]:
        """Return scratch for the keys of two pixel rows, of the narrowest kind that tells all cells apart."""
        cells = farthest_cells(camera, self._config.max_range, self._config)
        narrow = cells < 1 << (_keys.NARROW - 1)
        return np.zeros((2, camera.width + 1), np.int32 if narrow else np.int64)

    def _end_of_view(self, farthest: float) -> float:
        """Return the depth in metres beyond which this image says nothing."""
        limit = self._config.max_range
        if farthest >= NO_RETURN:
            return limit
        behind = float(self._table.reach[-1]) if self._table.marks else 0.0
        return min(limit, max(float(farthest), 10 * float(NEAR_PLANE)) * 1.001 + behind)

    def _scatter_hits(self, depth_m: NDArray[np.float32], view: View) -> None:
        hits = self._hits
        hits.clear()
        scratch = (self._keys, self._news, self._fresh, self._seen, self._listed)
        while (n := _hits.scatter(depth_m, view, *scratch, hits.table, hits.coords, hits.count, hits.values)) < 0:
            hits.clear()
            hits.reserve(2 * len(hits.coords))
        share = np.float32(self._config.projective.full_share)
        _hits.weigh(depth_m, view, self._table, share, self._listed, n, hits.coords, hits.values, self._weighing)

    def _candidates(self, depth_m: NDArray[np.float32], view: View) -> tuple[Windows, int, int]:
        """List free and mixed blocks in `_free` and `_mixed`; return how many, and the window images."""
        windows, farthest = self._builder.build(depth_m, float(view.spread) / self._config.max_range)
        if self._table.marks:
            self._builder.build_nearest(depth_m)
        end = np.float32(self._end_of_view(farthest))
        while True:
            n_free, n_mixed = _cull.candidates(
                view, self._table, windows, self._builder.nearest, end, self._free, self._mixed
            )
            if n_free >= 0:
                return windows, n_free, n_mixed
            self._free, self._mixed = (np.empty((4 * len(self._free), 3), np.int32) for _ in range(2))

    def _with_hits(self, n_free: int, n_mixed: int) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]:
        """Return the free blocks, the mixed ones, those with hits included, and where each has its hits."""
        hits, most = self._hits, n_mixed + len(self._hits)
        if most > len(self._mixed):
            self._mixed = np.concatenate([self._mixed, np.empty((most, 3), np.int32)])
        hit_of, listed = np.empty(most, np.int32), np.zeros(len(hits), np.uint8)
        n_free, n_mixed = _cull.with_hits(
            hits.table, hits.coords, len(hits), self._free, n_free, self._mixed, n_mixed, hit_of, listed
        )
        return self._free[:n_free], self._mixed[:n_mixed], hit_of[:n_mixed]

    def _evaluate(
        self,
        depth_m: NDArray[np.float32],
        view: View,
        windows: Windows,
        mixed: NDArray[np.int32],
        hit_of: NDArray[np.int32],
    ) -> NDArray[np.int16]:
        values = np.empty((len(mixed), CELLS), np.int16)

        def one_shard(part: slice) -> None:
            scratch = np.empty((2, _evaluate.LAYER), np.float32)
            _evaluate.evaluate(
                depth_m,
                view,
                self._table,
                windows,
                mixed[part],
                hit_of[part],
                self._hits.values,
                values[part],
                *scratch,
            )

        in_shards(one_shard, shards(len(mixed), self._config.threads))
        return values
