# SPDX-License-Identifier: Apache-2.0
"""The map that a node makes, in space or of a floor: what of them the node needs, under the same names."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from stereovox.config import Config, load_config
from stereovox.errors import MapFileError
from stereovox.frame import Frame, Scan
from stereovox.grid_mapper import GridMapper
from stereovox.health import Health
from stereovox.history import History
from stereovox.mapper import Mapper
from stereovox.maps import VoxelMap, load_map
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.maps.voxel_map import EVERYWHERE
from stereovox.products.floor_axes import Heights
from stereovox.products.live_projection import LiveProjection
from stereovox.products.map_server import read_map_server, write_map_server
from stereovox.update_report import UpdateReport


class Mapping(Protocol):
    """A map in the making. config: its settings."""

    config: Config

    @property
    def history(self) -> History:
        """What the map remembers of its frames."""
        ...

    def add(self, seen: Frame | Scan) -> UpdateReport:
        """Take in a frame or scan."""
        ...

    def health(self) -> Health:
        """Return how current the map is."""
        ...

    def grid(self) -> OccupancyGrid | None:
        """Return the map from above; None where nothing is known."""
        ...

    def snapshot(self) -> Callable[[], VoxelMap] | None:
        """Return what makes a copy of the map as it is now, in whatever thread; None for what is not in space."""
        ...

    def save(self, path: str) -> None:
        """Save the map, all or nothing; raises MapFileError."""
        ...

    def load(self, path: str) -> None:
        """Go on with a saved map; raises StereovoxError, and changes nothing, where that cannot be."""
        ...

    def reset(self) -> None:
        """Begin anew with an empty map."""
        ...

    def close(self) -> None:
        """Give back what the map holds on disk."""
        ...


class SpaceMapping(Mapping):
    """A voxel map. heights: between which obstacles mark its 2-D map. tiles: folder for cells that leave a window."""

    def __init__(self, config: Config, heights: Heights | None = None, tiles: Path | None = None):
        self._heights, self._tiles = heights, tiles
        self.config = config
        self._begin(None)

    @property
    def history(self) -> History:
        """What the map remembers of its frames."""
        return self._mapper.map.history

    def add(self, seen: Frame | Scan) -> UpdateReport:
        """Take in a frame."""
        assert isinstance(seen, Frame)
        return self._mapper.add(seen)

    def health(self) -> Health:
        """Return how current the map is."""
        return self._mapper.health()

    def grid(self) -> OccupancyGrid | None:
        """Return the map from above."""
        return self._above.grid()

    def snapshot(self) -> Callable[[], VoxelMap]:
        """Return what makes a copy of the cells in memory."""
        coords, cells = self._mapper.map.blocks_within(*EVERYWHERE)

        def copy() -> VoxelMap:
            voxel_map = VoxelMap(self.config)
            voxel_map.insert(coords, cells)
            return voxel_map

        return copy

    def save(self, path: str) -> None:
        """Save the map to a folder."""
        self._mapper.map.save(path)

    def load(self, path: str) -> None:
        """Go on with a map in a folder."""
        self._begin(load_map(path))

    def reset(self) -> None:
        """Begin anew."""
        self._begin(None)

    def close(self) -> None:
        """Remove tiles on disk."""
        self._mapper.map.close()

    def _begin(self, saved: VoxelMap | None) -> None:
        if saved is not None:
            saved.check_cells(self.config)  # before the map in use is given up
        if hasattr(self, "_mapper"):
            self.close()
        self._mapper = Mapper(self.config, resume=saved, tiles=self._tiles)
        self._above = LiveProjection(self._mapper.map, self._heights)


class FloorMapping(Mapping):
    """The grid of a floor."""

    def __init__(self, config: Config):
        self.config = config
        self._mapper = GridMapper(config)

    @property
    def history(self) -> History:
        """What the map remembers of its scans."""
        return self._mapper.map.history

    def add(self, seen: Frame | Scan) -> UpdateReport:
        """Take in a scan or depth image."""
        return self._mapper.add(seen)

    def health(self) -> Health:
        """Return how current the map is."""
        return self._mapper.health()

    def grid(self) -> OccupancyGrid | None:
        """Return the map."""
        return self._mapper.occupancy() if self._mapper.map.frames else None

    def snapshot(self) -> None:
        """Return None: there is nothing in space."""

    def save(self, path: str) -> None:
        """Save the map as map_server's two files."""
        if not self._mapper.map.frames:
            raise MapFileError(f"{path}: nothing is mapped so far; save it later")
        write_map_server(self._mapper.occupancy(), path)

    def load(self, path: str) -> None:
        """Go on with map_server's files."""
        before = read_map_server(path)
        self._mapper = GridMapper(load_config(self.config, voxel_size=before.resolution), resume=before)
        self.config = self._mapper.config

    def reset(self) -> None:
        """Begin anew."""
        self._mapper = GridMapper(self.config)

    def close(self) -> None:
        """Nothing lies on disk."""


def make_mapping(config: Config, heights: Heights | None, tiles: Path | None) -> Mapping:
    """Return the map that the settings ask for, of two or three dimensions."""
    return FloorMapping(config) if config.dimensions == 2 else SpaceMapping(config, heights, tiles)
