# SPDX-License-Identifier: Apache-2.0
"""A map's decision on each cell (occupied, tentative, free, unknown) against the truth: its error rates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereovox.evaluate.metrics import ratio
from stereovox.evaluate.truth_cells import Reading, TruthCells
from stereovox.maps import State, VoxelMap


@dataclass(frozen=True)
class Decisions:
    """The states that a map gives the cells of the truth; shares from 0 to 1, None if there are no such cells.

    Of the truth's `surface` cells (a number): surface_occupied, surface_tentative, surface_free (the fatal error) and
    surface_unknown, the shares in each state; surface_free_alone: free, with nothing tentative or occupied within one
    cell; surface_occupied_near, surface_near: with a cell within the tolerance that is occupied, or occupied or
    tentative. Of those known to the map, `known` in number: known_free, known_free_alone, likewise.
    Of the truth's `air` cells, free ones: air_occupied, air_tentative, air_free, air_unknown.
    Of the map's `occupied` cells that the truth knows: occupied_hit, with a surface in it; occupied_near, with one
    within the tolerance; occupied_air, free in the truth. Of the map's `free` ones: free_wrong, with a surface in it.
    """

    surface: int
    surface_occupied: float | None
    surface_tentative: float | None
    surface_free: float | None
    surface_unknown: float | None
    surface_free_alone: float | None
    surface_occupied_near: float | None
    surface_near: float | None
    known: int
    known_free: float | None
    known_free_alone: float | None
    air: int
    air_occupied: float | None
    air_tentative: float | None
    air_free: float | None
    air_unknown: float | None
    occupied: int
    occupied_hit: float | None
    occupied_near: float | None
    occupied_air: float | None
    free: int
    free_wrong: float | None


def decisions(voxel_map: VoxelMap, truth: VoxelMap | TruthCells) -> Decisions:
    """Compare the state that `voxel_map` itself gives each cell of the truth with the truth.

    truth: a map whose occupied cells have a surface and whose free cells were in view and have none, or `TruthCells`,
    made once for many maps. Raises StereovoxError for maps of different cell sizes and an empty truth.
    """
    cells = truth if isinstance(truth, TruthCells) else TruthCells(truth)
    return decide(cells.read(voxel_map), cells)


def decide(reading: Reading, truth: TruthCells, chosen: NDArray[np.bool_] | None = None) -> Decisions:
    """Return the decisions over the `chosen` cells (N,) of the truth; None: all."""
    counted = np.ones(len(truth.cells), bool) if chosen is None else chosen
    is_surface = truth.occupied & counted
    surface, air = _numbers(reading.states[is_surface]), _numbers(reading.states[counted & ~truth.occupied])
    of_surface = counted[truth.occupied]  # (S,)
    beside, near = reading.beside[of_surface], reading.reached[of_surface]
    alone = int(((reading.states[is_surface] == State.FREE) & (beside < State.TENTATIVE)).sum())
    n_surface, n_air = sum(surface), sum(air)
    known = n_surface - surface[State.UNKNOWN]
    occupied, free = (surface[state] + air[state] for state in (State.OCCUPIED, State.FREE))
    close = int(((reading.states == State.OCCUPIED) & truth.near & counted).sum())
    return Decisions(
        surface=n_surface,
        **{f"surface_{state.name.lower()}": ratio(surface[state], n_surface) for state in State},
        surface_free_alone=ratio(alone, n_surface),
        surface_occupied_near=ratio(int((near == State.OCCUPIED).sum()), n_surface),
        surface_near=ratio(int((near >= State.TENTATIVE).sum()), n_surface),
        known=known,
        known_free=ratio(surface[State.FREE], known),
        known_free_alone=ratio(alone, known),
        air=n_air,
        **{f"air_{state.name.lower()}": ratio(air[state], n_air) for state in State},
        occupied=occupied,
        occupied_hit=ratio(surface[State.OCCUPIED], occupied),
        occupied_near=ratio(close, occupied),
        occupied_air=ratio(air[State.OCCUPIED], occupied),
        free=free,
        free_wrong=ratio(surface[State.FREE], free),
    )


def _numbers(states: NDArray[np.uint8]) -> list[int]:
    """Return the number of cells in each `State`, indexed by state."""
    return np.bincount(states, minlength=len(State)).tolist()
