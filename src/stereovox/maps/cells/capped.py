# SPDX-License-Identifier: Apache-2.0
"""A map without spatial bounds but within `max_memory`: frames that need more are refused."""

from __future__ import annotations

from stereovox.config import Config
from stereovox.errors import ConfigError, FrameRefused
from stereovox.maps.cells.cell_pool import CellPool, CellTimes
from stereovox.maps.cells.evidence import Evidence
from stereovox.maps.storage.storage import Storage
from stereovox.maps.storage.window import format_bytes, most_blocks
from stereovox.maps.voxel_map import VoxelMap


class CappedStorage(Storage):
    """The blocks of a map that refuses frames, as `memory_full`, if they need more blocks than fit into `max_memory`.

    Room for all blocks is reserved at the start, so nothing is ever copied to grow; the system provides a block's
    memory on first use. Refusals depend only on the cells and the frame. Raises ConfigError if not even one block fits.
    """

    bounded = True

    def __init__(self, config: Config):
        super().__init__(config)
        self._most, self._allowed = most_blocks(config), format_bytes(config.max_memory or 0)
        self._pool = CellPool(self.rules, self._most, self._most)
        self._times = CellTimes(config.map, self._most) if config.map.keep_times else None

    def go_on_with(self, earlier: Storage) -> None:
        """Start from the cells of an earlier map. Raises ConfigError if they do not fit."""
        earlier.check_cells(self.config)
        for coords, cells in earlier.slabs():
            rows, bare = self._pool.needed_by(cells)
            if max(rows, bare) > self._most or (self._times is not None and len(self._pool) + len(coords) > self._most):
                raise ConfigError(
                    f"cannot continue: the map needs more memory than max_memory {self._allowed}; "
                    'allow more, or set when_full to "spill"'
                )
            self.insert(coords, cells)
            if self._times is not None:
                self.set_times(coords, earlier.times_of(coords), earlier.times_start_ns)
        self.take_history(earlier)

    def check_room(self, evidence: Evidence) -> None:
        """Raise FrameRefused `memory_full` if `evidence` needs more memory than the map may take."""
        mine = self._in_my_units(evidence)
        needed = max(self._pool.needed_for(mine.coords, mine.values, mine.uniform))
        if self._times is not None:  # forgetting cells can make any block need numbers again
            needed = max(needed, len(self._pool) + self._times.missing(mine))
        if needed > self._most:
            raise FrameRefused(
                "memory_full",
                f"the map would need {needed} blocks of cells, max_memory {self._allowed} holds "
                f'{self._most}; allow more, use larger cells, or set when_full to "roll" or "spill"',
            )


class CappedMap(VoxelMap):
    """A map without spatial bounds within `max_memory`; see `CappedStorage`. Raises ConfigError as that does."""

    storage: CappedStorage  # pyrefly: ignore[bad-override-mutable-attribute] - set once

    def __init__(self, config: Config):
        super().__init__(config, storage=CappedStorage(config))
