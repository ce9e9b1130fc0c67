# SPDX-License-Identifier: Apache-2.0
"""Map shifting (Chien 2020, 3.6): a flight whose window moves with the camera, and what a move costs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.config import load_config
from stereovox.depth import prepare
from stereovox.integrate import make_integrator
from stereovox.maps.rolling import RollingMap
from stereovox.maps.tiles import TILE
from stereovox.sources.simulation import Simulation

DOWNSAMPLE = 2
"""Images of the flight are 212 pixels wide: 2x2 of them are 8x8 of a D435."""
OUTSIDE = ("drop", "keep")
"""What happens to cells that leave the window: lost, or kept in tiles on disk."""


@dataclass(frozen=True, eq=False)
class Flight:
    """One flight. outside: see `OUTSIDE`; its map is still open.

    way: (N, 3) camera positions. windows: (N, 2, 3) corners in metres after each frame. shift_ms, shift_cells: (K,)
    time and number of cells of each move; stay_ms: time of the same call when nothing moves. memory: (N,) bytes.
    tiles: (T, 2, 3) corners in metres of the tiles on disk.
    """

    outside: str
    voxel_map: RollingMap
    way: NDArray[np.float64]
    windows: NDArray[np.float64]
    shift_ms: NDArray[np.float64]
    shift_cells: NDArray[np.int64]
    stay_ms: NDArray[np.float64]
    memory: NDArray[np.int64]
    tiles: NDArray[np.float64]

    def figures(self) -> dict[str, Any]:
        """Return its numbers, fit for JSON."""
        return {
            "outside": self.outside,
            "frames": len(self.way),
            "metres": float(np.linalg.norm(np.diff(self.way, axis=0), axis=1).sum()),
            "shifts": len(self.shift_ms),
            "cells_a_shift_median": float(np.median(self.shift_cells)),
            "shift_ms_median": float(np.median(self.shift_ms)),
            "shift_ms_p95": float(np.percentile(self.shift_ms, 95)),
            "stay_ms_median": float(np.median(self.stay_ms)),
            "memory_bytes": int(self.memory[-1]),
            "memory_changed_bytes": int(np.ptp(self.memory)),
            "tiles": len(self.tiles),
            **self.voxel_map.counts(),
        }

    @property
    def most_off_m(self) -> float:
        """How far the camera ever was from the window's middle, along any axis, in metres."""
        return float(np.abs(self.way - self.windows.mean(axis=1)).max())


def fly(outside: str, *, length_m: float = 80.0, step: Callable[[], None] = lambda: None) -> Flight:
    """Fly out and back through a hall under the profile `chien2020` and time each move of its window."""
    config = load_config("chien2020", **{"window.outside": outside, "depth.downsample": DOWNSAMPLE})
    simulation = Simulation(f"sim:flight?length={length_m}&speed=5&axes=optical")
    voxel_map, integrator = RollingMap(config), make_integrator(config)
    windows, memory, moves = [], [], []
    for frame in simulation:
        image = prepare(frame, config)
        start = perf_counter()
        voxel_map.look_from(image.viewpoint)
        ms = 1e3 * (perf_counter() - start)
        voxel_map.add(integrator.evidence(image))
        voxel_map.frames += 1
        window = voxel_map.window
        assert window is not None
        moved = 0 if not windows else round(float(np.abs(window[0] - windows[-1][0]).sum()) / config.voxel_size)
        windows.append(window)
        moves.append((ms, moved))
        memory.append(voxel_map.memory_bytes)
        step()
    ms, cells = np.array(moves[1:]).T
    way = np.array([simulation.pose(i)[:3, 3] for i in range(len(simulation))])
    return Flight(outside, voxel_map, way, np.array(windows), ms[cells > 0], cells[cells > 0].astype(np.int64),
                  ms[cells == 0], np.array(memory), _tiles(voxel_map))  # fmt: skip


def _tiles(voxel_map: RollingMap) -> NDArray[np.float64]:
    if voxel_map.store is None:
        return np.zeros((0, 2, 3))
    low = np.array(voxel_map.store.tiles()).reshape(-1, 3)
    return np.stack([low, low + 1], axis=1) * TILE * voxel_map.voxel_size
