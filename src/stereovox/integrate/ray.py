# SPDX-License-Identifier: Apache-2.0
"""The ray integrator: every pixel's ray, every cell it crosses, exactly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras import PinholeCamera
from stereovox.config import Config
from stereovox.frame import DepthImage
from stereovox.integrate import _ray
from stereovox.integrate.shards import in_shards, shards
from stereovox.integrate.views import KernelTable, View, origin_block, sensor_table, view_of
from stereovox.maps.blocks import CELLS, BlockPool
from stereovox.maps.evidence import Evidence
from stereovox.sensors import make_sensor


class Ray:
    """Evidence by ray casting.

    `ray.update = "every"`: each ray adds its evidence to each cell, weighted so that the rays of one cell count about
    one (Chien 2020, Eq 3.21). `"once"`: a cell keeps the strongest evidence of the frame, as OctoMap does.
    """

    def __init__(self, config: Config):
        self._config = config
        self._sensor = make_sensor(config.sensor)
        self._pools = [BlockPool(np.int32, capacity=8192) for _ in range(config.threads)]
        self._camera: PinholeCamera | None = None

    def evidence(self, image: DepthImage) -> Evidence:
        """Return what `image` says about the cells its rays cross."""
        config, camera = self._config, image.camera
        if camera != self._camera:
            self._table: KernelTable = sensor_table(self._sensor, config, camera)
            self._camera = camera
        view = view_of(image, config.voxel_size, config.max_range)
        weight = np.float32((camera.fx * config.voxel_size) ** -2 if config.ray.update == "every" else 0)
        parts = shards(camera.height, config.threads)
        pool_of = {part.start: pool for part, pool in zip(parts, self._pools, strict=False)}
        in_shards(lambda part: self._cast(image.depth_m, view, weight, pool_of[part.start], part), parts)
        pool = self._merged([*pool_of.values()], bool(weight > 0))
        values = np.empty((len(pool), CELLS), np.int16)
        _ray.to_thousandths(pool.values[: len(pool)], _ray.FRACTION_BITS if weight > 0 else 0, values)
        origin = origin_block(image.T_world_sensor, config.voxel_size).astype(np.int32)
        return Evidence(pool.coords[: len(pool)] + origin, values, np.empty((0, 3), np.int32), 0)

    def _cast(self, depth_m: NDArray[np.float32], view: View, weight: np.float32, pool: BlockPool, part: slice) -> None:
        pool.clear()
        while not _ray.cast(
            depth_m, view, self._table, weight,
            pool.table, pool.coords, pool.count, pool.values, part.start, part.stop,
        ):  # fmt: skip
            pool.clear()
            pool.reserve(2 * len(pool.coords))

    def _merged(self, pools: list[BlockPool], weighted: bool) -> BlockPool:
        first, *others = pools
        for other in others:
            places = first.insert(other.coords[: len(other)])
            _ray.merge(first.values, other.values[: len(other)], places, weighted)
        return first
