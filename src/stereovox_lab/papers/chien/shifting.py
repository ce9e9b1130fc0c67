# SPDX-License-Identifier: Apache-2.0
"""Map shifting (Chien 2020, 3.6): a flight whose window moves with the camera, and the cost of a move."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.config import load_config
from stereovox.depth import prepare
from stereovox.integrate import make_integrator
from stereovox.maps.storage.rolling import RollingMap
from stereovox.maps.storage.tiles import TILE
from stereovox.simulate.simulation import Simulation
from stereovox.view.figures import INK, PATH_COLOUR, labels, title
from stereovox_lab.papers.chapter import Chapter, Claim, Shown
from stereovox_lab.papers.pictures import OURS, SECOND, THESIS, figure_of, png

DOWNSAMPLE = 2
"""Images of the flight are 212 pixels wide: 2x2 of them are 8x8 of a D435."""
OUTSIDE = ("drop", "keep")
"""Cells that leave the window: lost, or kept in tiles on disk."""
NEAR_M = 0.5
"""Height in metres above and below the first camera of drawn cells: without floor and ceiling."""
PAPER = (
    "Once the camera hits the trigger boundary, the whole map shifts one unit; the dynamic region moves with the "
    "vehicle and is the only one that is updated. Cells outside are eliminated and can be stored in another memory, "
    "or removed."
)
OUR_PICTURE = (
    "The flight from above: the window at four moments (blue, the last one orange), in it the trigger box (red); grey "
    "squares are the tiles of 32 cells a side that went to disk. Right: what a move costs."
)
NAMES = {"drop": "Cells that leave are dropped", "keep": "Cells that leave are kept in tiles"}


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
        """Largest distance of the camera from the window's middle, along any axis, in metres."""
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
        voxel_map.storage.set_viewpoint(image.viewpoint)
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
    if voxel_map.storage.tile_store is None:
        return np.zeros((0, 2, 3))
    low = np.array(voxel_map.storage.tile_store.tiles()).reshape(-1, 3)
    return np.stack([low, low + 1], axis=1) * TILE * voxel_map.voxel_size


def flight_png(flight: Flight) -> bytes:
    """Return the flight from above with windows and tiles (after Fig 3.14 to 3.16), and the cost of moves."""
    figure = figure_of(7.0)
    left, right = figure.subplots(1, 2, width_ratios=[2.4, 1])
    _flight_plan(left, flight)
    right.hist(1e3 * flight.shift_ms, np.linspace(0, 1e3 * np.percentile(flight.shift_ms, 97), 40).tolist(), color=OURS)
    title(right, f"{len(flight.shift_ms)} moves of the window")
    labels(right, "time of one move [microseconds]", "moves")
    return png(figure)


def _flight_plan(axis: Any, flight: Flight) -> None:
    occupied = flight.voxel_map.occupied()
    occupied = occupied[np.abs(occupied[:, 1] - flight.way[0, 1]) < NEAR_M]
    cells = np.unique(np.floor(occupied[:, [0, 2]] / flight.voxel_map.voxel_size), axis=0) + 0.5
    x, z = cells.T * flight.voxel_map.voxel_size
    axis.plot(z, x, "s", color=INK, markersize=1.1)
    for low, high in flight.tiles:
        axis.fill(*_rectangle(low, high), fill=False, edgecolor=THESIS, linewidth=0.8)
    shown = np.linspace(0, len(flight.windows) - 1, 4).astype(int)
    for n, k in enumerate(shown):
        low, high = flight.windows[k]
        middle, trigger = (low + high) / 2, flight.voxel_map.config.window.trigger
        colour = OURS if n < len(shown) - 1 else SECOND
        axis.fill(*_rectangle(low, high), fill=False, edgecolor=colour, linewidth=1.6)
        axis.fill(*_rectangle(middle - trigger, middle + trigger), fill=False, edgecolor=PATH_COLOUR, linewidth=1.4)
    axis.plot(flight.way[:, 2], flight.way[:, 0], color=PATH_COLOUR, linewidth=1)
    axis.set_aspect("equal")
    title(axis, "Occupied cells near the flight's height, way, windows, trigger boxes, tiles")
    labels(axis, "z, ahead [m]", "x, to the right [m]")


def _rectangle(low: NDArray[np.float64], high: NDArray[np.float64]) -> tuple[list[float], list[float]]:
    return [low[2], high[2], high[2], low[2]], [low[0], low[0], high[0], high[0]]


def chapter(flights: Sequence[Flight]) -> Chapter:
    """Return the chapter; the last flight is drawn."""
    figures = {flight.outside: flight.figures() for flight in flights}
    claims = [claim for flight in flights for claim in _claims(flight)]
    kept, dropped = figures["keep"]["occupied"], figures["drop"]["occupied"]
    claims.append(
        Claim("Cells outside can be stored elsewhere", "yes",
              f"{kept:,} occupied cells known at the end, {dropped:,} where they are dropped", kept > dropped)
    )  # fmt: skip
    return Chapter(
        "shifting",
        "Map shifting",
        f"A flight of {figures['keep']['metres']:.0f} m out and back through a hall at 5 m/s, with the window of "
        "Table 4.1: 20x6x20 m, trigger box 1 m to all sides. Images are 212 pixels wide and downsampled 2x2, so a "
        "frame has as many rays as 8x8 of a D435.",
        claims,
        [Shown("Fig 3.14 to 3.16", PAPER, OUR_PICTURE, flight_png(flights[-1]))],
        numbers=figures,
    )


def _claims(flight: Flight) -> list[Claim]:
    figures, way = flight.figures(), NAMES[flight.outside]
    move, stay = 1e3 * figures["shift_ms_median"], 1e3 * figures["stay_ms_median"]
    return [
        Claim(f"{way}: a move of one cell", "no time given",
              f"{move:.0f} microseconds (median of {figures['shifts']}), {stay:.0f} where nothing moves", None),
        Claim(f"{way}: memory does not grow", "not unboundedly",
              f"{figures['memory_bytes'] / 1e6:.2f} MB from the first frame to the last",
              figures["memory_changed_bytes"] == 0),
        Claim(f"{way}: the camera stays in the trigger box", "1 m (Table 4.1)",
              f"{flight.most_off_m:.2f} m off the window's middle at most", flight.most_off_m < 1.001),
    ]  # fmt: skip
