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
from stereovox.integrate import _cull, _evaluate
from stereovox.integrate._cells import NEAR_PLANE, NO_RETURN
from stereovox.integrate.faces import Face, WideCamera, cut, faces_of
from stereovox.integrate.hits import HitFinder
from stereovox.integrate.merging import strongest
from stereovox.integrate.per_camera import PerCamera
from stereovox.integrate.views import RIM_SHARE, KernelTable, View, Views, check_blocks, check_view, sensor_table
from stereovox.integrate.windows import WindowBuilder, Windows
from stereovox.maps.blocks import CELLS
from stereovox.maps.evidence import Evidence
from stereovox.sensors import make_sensor
from stereovox.shards import in_shards, shards, together

ROOM = 4096
"""Blocks that a camera's lists have room for at first."""
WORTH_A_THREAD = 256
"""Blocks whose evaluation takes longer than it takes to wake a thread."""


class Projective:
    """Evidence by projection, coarse to fine. Raises ConfigError for a bad sensor model."""

    def __init__(self, config: Config):
        self._config = config
        sensor = make_sensor(config.sensor)

        def eye(camera: PinholeCamera, rim_share: float) -> _Eye:  # knows no `self`, which would keep itself alive
            return _Eye(camera, sensor_table(sensor, config, camera), config, rim_share)

        self._eyes: PerCamera[PinholeCamera, _Eye] = PerCamera(lambda camera: eye(camera, RIM_SHARE))
        self._faces: PerCamera[WideCamera, list[tuple[Face, _Eye]]] = PerCamera(
            lambda camera: [(face, eye(face.camera, 0.0)) for face in faces_of(camera, config)]
        )

    def evidence(self, image: DepthImage) -> Evidence:
        """Return what `image` says about the cells it sees; that of a wide camera is cut into pinhole images."""
        if isinstance(image.camera, PinholeCamera):
            return self._of_pinhole(self._eyes[image.camera], image, image.depth_m)
        seen = [(eye, cut(image, face, self._config.max_range)) for face, eye in self._faces[image.camera]]
        return strongest([self._of_pinhole(eye, face.image, face.ends) for eye, face in seen])

    def _of_pinhole(self, eye: _Eye, image: DepthImage, ends: NDArray[np.float32]) -> Evidence:
        depth_m = image.depth_m
        view = eye.views.at(image.T_world_sensor)
        threads = self._config.threads if eye.mixed_before >= 2 * WORTH_A_THREAD else 1
        _, (windows, n_free, n_mixed) = together(
            threads,
            lambda: eye.hits.find(depth_m, view),
            lambda: eye.candidates(depth_m, ends, view),
        )
        free, mixed, hit_of = eye.with_hits(n_free, n_mixed)
        eye.mixed_before = len(mixed)
        values = np.empty((len(mixed), CELLS), np.int16)
        hits = eye.hits.blocks.values

        def one_shard(part: slice) -> None:
            scratch = np.empty((2, _evaluate.LAYER), np.float32)
            _evaluate.evaluate(
                depth_m, view, eye.table, windows, mixed[part], hit_of[part], hits, values[part], *scratch
            )  # fmt: skip

        in_shards(one_shard, shards(len(mixed), min(threads, len(mixed) // WORTH_A_THREAD or 1)))
        origin = eye.views.block
        return Evidence(mixed + origin, values, free + origin, int(eye.table.free))


class _Eye:
    """What one camera needs: its sensor table, and memory for what its images say."""

    def __init__(self, camera: PinholeCamera, table: KernelTable, config: Config, rim_share: float):
        check_view(camera, config)
        self._camera, self.table = camera, table
        self.mixed_before = 0  # blocks to be evaluated in the frame before: about as much is to be done in the next
        self.views = Views(camera, config, rim_share)
        self.hits = HitFinder(camera, table, config)
        self._windows = WindowBuilder(camera)
        self._max_range = config.max_range
        self._free, self._mixed = (np.empty((ROOM, 3), np.int32) for _ in range(2))
        self._stack = np.empty((_cull.STACK, 4), np.int32)

    def candidates(
        self, depth_m: NDArray[np.float32], ends: NDArray[np.float32], view: View
    ) -> tuple[Windows, int, int]:
        """List free and mixed blocks; return the window images, and how many there are of each.

        ends: `depth_m`, but for pixels that see nothing: how far that is.
        """
        windows, farthest = self._windows.build(ends, float(view.spread) / self._max_range)
        if self.table.marks:
            self._windows.build_nearest(depth_m)
        end, nearest = np.float32(self._end_of_view(farthest)), self._windows.nearest
        while True:
            lists = self._stack, self._free, self._mixed
            n_free, n_mixed = _cull.candidates(view, self.table, windows, nearest, end, *lists)
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
        n_free, n_mixed = _cull.with_hits(
            hits.table, hits.coords, len(hits), self._free, n_free, self._mixed, n_mixed, hit_of, listed
        )
        return self._free[:n_free], self._mixed[:n_mixed], hit_of[:n_mixed]

    def _end_of_view(self, farthest: float) -> float:
        """Return the depth in metres beyond which this image says nothing."""
        if farthest >= NO_RETURN:
            return self._max_range
        behind = float(self.table.reach[-1] if self.table.marks else self.table.behind)
        return min(self._max_range, max(float(farthest), 10 * float(NEAR_PLANE)) * 1.001 + behind)
