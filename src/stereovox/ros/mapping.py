# SPDX-License-Identifier: Apache-2.0
"""The map that a node makes: its mapper, which another one replaces when a map is loaded or reset."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from stereovox.config import Config, load_config
from stereovox.formats.map_server import read_map_server
from stereovox.frame import Frame, Scan, UpdateReport
from stereovox.mapper import AnyMapper, GridMapper, Mapper
from stereovox.maps import VoxelMap, load_map
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.maps.storage import EVERYWHERE
from stereovox.products.floor_axes import Heights
from stereovox.products.live_projection import LiveProjection
from stereovox.trust.health import Health
from stereovox.trust.history import History


class Mapping:
    """A map in space or of a floor, as the settings say, seen from above.

    heights: between which obstacles mark the 2-D map of one in space. tiles: folder for cells that leave a window.

    Attributes:
        mapper: Makes the map; after `load` and `reset` another one.
    """

    mapper: AnyMapper[Any]  # the node offers it only what its options allow

    def __init__(self, config: Config, heights: Heights | None = None, tiles: Path | None = None):
        self._heights, self._tiles = heights, tiles
        self._begin(config)

    @property
    def config(self) -> Config:
        """The settings of the map."""
        return self.mapper.config

    @property
    def history(self) -> History:
        """What the map remembers of its frames."""
        return self.mapper.map.history

    def add(self, seen: Frame | Scan) -> UpdateReport:
        """Take in a frame or scan."""
        return self.mapper.add(seen)

    def health(self) -> Health:
        """Return how current the map is."""
        return self.mapper.health()

    def grid(self) -> OccupancyGrid | None:
        """Return the map from above; None where nothing is known."""
        return self._above()

    def snapshot(self) -> Callable[[], VoxelMap] | None:
        """Return what makes a copy of the cells in memory, in whatever thread; None for what is not in space."""
        voxel_map = self.mapper.map
        if not isinstance(voxel_map, VoxelMap):
            return None
        coords, cells = voxel_map.storage.blocks_within(*EVERYWHERE)

        def copy() -> VoxelMap:
            copied = VoxelMap(voxel_map.config)
            copied.storage.insert(coords, cells)
            return copied

        return copy

    def save(self, path: str) -> None:
        """Save the map, all or nothing; raises MapFileError."""
        self.mapper.save(path)

    def load(self, path: str) -> None:
        """Go on with a saved map; raises StereovoxError, and changes nothing, where that cannot be."""
        if self.config.dimensions == 2:
            floor = read_map_server(path)
            self._begin_floor(load_config(self.config, voxel_size=floor.resolution), floor)
        else:
            saved = load_map(path)
            saved.storage.check_cells(self.config)  # before the map in use is given up
            self.close()
            self._begin_space(self.config, saved)

    def reset(self) -> None:
        """Begin anew with an empty map."""
        self.close()
        self._begin(self.config)

    def close(self) -> None:
        """Give back what the map holds on disk."""
        self.mapper.close()

    def _begin(self, config: Config) -> None:
        (self._begin_floor if config.dimensions == 2 else self._begin_space)(config)

    def _begin_space(self, config: Config, saved: VoxelMap | None = None) -> None:
        mapper = Mapper(config, resume=saved, tiles=self._tiles)
        self.mapper, self._above = mapper, LiveProjection(mapper.map, self._heights).grid

    def _begin_floor(self, config: Config, saved: OccupancyGrid | None = None) -> None:
        mapper = GridMapper(config, resume=saved)
        self.mapper, self._above = mapper, lambda: _unless_empty(mapper.occupancy())


def _unless_empty(grid: OccupancyGrid) -> OccupancyGrid | None:
    return grid if grid.cells.size else None
