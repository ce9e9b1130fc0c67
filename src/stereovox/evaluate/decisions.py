# SPDX-License-Identifier: Apache-2.0
"""A map's decision on each cell (occupied, tentative, free, unknown) against the truth, and its error rates.

The rates of all cells, and by range, by thickness of the surface and by number of looks; as tables for the terminal and
for pages, and cell by cell for pictures.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from enum import IntEnum
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.evaluate.curves import distances, round_edges
from stereovox.evaluate.lidar_truth import project
from stereovox.evaluate.metrics import ratio
from stereovox.evaluate.truth import indices
from stereovox.evaluate.truth_cells import Reading, Thickness, TruthCells, thickness
from stereovox.geometry.se3 import Transform, inverse, transform_points
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


LOOKS = (0, 0.5, 3, 10, 30, np.inf)
"""Limits of the classes of looks: none, 1 or 2, 3 to 9, 10 to 29, 30 and more."""
LOOKS_NAMES = ("0", "1 to 2", "3 to 9", "10 to 29", "30 or more")


@dataclass(frozen=True)
class Part:
    """The decisions over a part of the truth's cells.

    by: `range`, `thickness` or `looks`; name: of the part, such as `2 to 4 m`, `line`, `3 to 9`. Thickness and looks
    refer to surface cells, so their parts have no free cells of the truth.
    """

    by: str
    name: str
    decisions: Decisions

    def as_dict(self) -> dict[str, Any]:
        """Return all numbers for JSON."""
        return {"by": self.by, "name": self.name, **asdict(self.decisions)}


def decision_parts(
    reading: Reading,
    truth: TruthCells,
    path: ArrayLike | None = None,
    edges: ArrayLike | None = None,
    looks: NDArray[np.floating] | None = None,
) -> tuple[Part, ...]:
    """Return the decisions by part; parts without cells are left out.

    path: camera positions (P, 3) in metres, world frame: parts by distance to the nearest one, in rings between `edges`
    (M + 1,) in metres or of a round width; None: not by range. looks: (S,) of each surface cell; None: not by looks.
    """
    split = [
        *_by_surface(
            "thickness", thickness(truth.neighbourhood)[truth.counted], [kind.name.lower() for kind in Thickness]
        )
    ]
    if looks is not None:
        split += _by_surface("looks", np.searchsorted(LOOKS, looks, "right") - 1, LOOKS_NAMES)
    parts = [(by, name, _as_cells(truth, chosen)) for by, name, chosen in split]
    if path is not None:
        parts = [*_by_range(truth, path, edges), *parts]
    return tuple(Part(by, name, decide(reading, truth, chosen)) for by, name, chosen in parts if chosen.any())


def _by_surface(by: str, group: NDArray[Any], names: Any) -> Iterator[tuple[str, str, NDArray[np.bool_]]]:
    for i, name in enumerate(names):
        yield by, name, group == i


def _as_cells(truth: TruthCells, chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which cells of the truth (N,) are the `chosen` ones of its surface (S,)."""
    cells = truth.occupied.copy()
    cells[truth.occupied] = chosen
    return cells


def _by_range(
    truth: TruthCells, path: ArrayLike, edges: ArrayLike | None
) -> Iterator[tuple[str, str, NDArray[np.bool_]]]:
    distance = distances(truth.centers(), path)
    limits = round_edges(float(distance.max())) if edges is None else np.asarray(edges, float)
    for low, high in pairwise(limits):
        yield "range", f"{low:g} to {high:g} m", (distance >= low) & (distance < high)


STATES = tuple(state.name.lower() for state in sorted(State, reverse=True))
HEADS = ("what is there", "cells", *STATES)
ERROR_HEADS = ("of the", "cells", "share", "that")
PART_HEADS = ("part", "surface cells", *STATES, "free, alone", "near occupied", "called occupied", "rightly, near")
NOTHING = "-"


def state_rows(found: Decisions) -> list[tuple[str, ...]]:
    """Return the rows below `HEADS`: what the map calls the surface cells and the free cells of the truth."""
    return [
        ("a surface", f"{found.surface:,}", *(percent(getattr(found, f"surface_{state}")) for state in STATES)),
        ("free space", f"{found.air:,}", *(percent(getattr(found, f"air_{state}")) for state in STATES)),
    ]


def error_rows(found: Decisions, tolerance: int) -> list[tuple[str, ...]]:
    """Return the rows below `ERROR_HEADS`: the errors, the worst first."""
    cells = "1 cell" if tolerance == 1 else f"{tolerance} cells"
    surface, known, occupied, free = (f"{n:,}" for n in (found.surface, found.known, found.occupied, found.free))
    return [
        ("surface cells it knows", known, percent(found.known_free), "are called free"),
        ("", "", percent(found.known_free_alone), "the same, nothing tentative or occupied within 1 cell"),
        ("surface cells", surface, percent(found.surface_occupied_near), f"have an occupied cell within {cells}"),
        ("", "", percent(found.surface_near), f"have an occupied or tentative cell within {cells}"),
        ("cells called occupied", occupied, percent(found.occupied_hit), "hold a surface"),
        ("", "", percent(found.occupied_near), f"have a surface within {cells}"),
        ("", "", percent(found.occupied_air), "are free in the truth"),
        ("cells called free", free, percent(found.free_wrong), "hold a surface"),
    ]


def part_rows(parts: Sequence[Part]) -> list[tuple[str, ...]]:
    """Return the rows below `PART_HEADS`; cells called occupied are reported by range only."""
    return [
        (
            f"{part.by}: {part.name}",
            f"{one.surface:,}",
            *(percent(getattr(one, f"surface_{state}")) for state in STATES),
            percent(one.surface_free_alone),
            percent(one.surface_occupied_near),
            *((f"{one.occupied:,}", percent(one.occupied_near)) if part.by == "range" else (NOTHING, NOTHING)),
        )
        for part in parts
        for one in (part.decisions,)
    ]


def percent(share: float | None) -> str:
    """Format a share, with enough digits for rare errors."""
    if share is None:
        return NOTHING
    return f"{share:.1%}" if share >= 0.1 or share == 0 else f"{share:.2%}"


class Outcome(IntEnum):
    """Outcome of a cell that the map or the truth calls occupied.

    HIT: both do. NEAR: only the map does, with a surface within the tolerance; FALSE: without one. FOUND: only the
    truth does, with an occupied cell of the map within the tolerance; MISSED: without one; UNSEEN: without one, and the
    map has never observed the cell.
    """

    HIT = 0
    NEAR = 1
    FALSE = 2
    FOUND = 3
    MISSED = 4
    UNSEEN = 5


@dataclass(frozen=True, eq=False)
class Outcomes:
    """Cells (M, 3) int32 that the map or the truth calls occupied, and the `Outcome` (M,) uint8 of each."""

    cells: NDArray[np.int32]
    outcome: NDArray[np.uint8]
    voxel_size: float
    up: str


def outcomes(reading: Reading, truth: TruthCells, threshold: float) -> Outcomes:
    """Return the outcome of each cell of the truth that the truth or the map calls occupied."""
    marked, actual = reading.marked(threshold), truth.occupied
    outcome = np.where(truth.near, Outcome.NEAR, Outcome.FALSE).astype(np.uint8)
    missed = np.where(reading.observed[actual], Outcome.MISSED, Outcome.UNSEEN)
    outcome[actual] = np.where(reading.found(threshold), Outcome.FOUND, missed)
    outcome[marked & actual] = Outcome.HIT
    shown = marked | actual
    return Outcomes(indices(truth.cells[shown]), outcome[shown], truth.voxel_size, truth.up)


MOST_PLACES = 100
"""Most places tried; a longer path is sampled evenly."""
_INSIDE = 1e-3
"""Distance in cells from a face to the target point inside the cell."""
_FACES = np.array([sign * axis for axis in np.eye(3, dtype=int) for sign in (-1, 1)])


def looks(voxel_map: VoxelMap, truth: TruthCells) -> NDArray[np.floating] | None:
    """Return the number of places (S,) on the path of `voxel_map` that could see each surface cell of the truth.

    A map keeps places of its camera at least 5 cm or 0.1 rad apart (`VoxelMap.path`), so a standing camera counts once,
    however many frames it takes. None for a map without a path or a camera, such as an imported one, and for one of
    several sensors, whose cameras are not kept.
    """
    path, viewpoint = voxel_map.history.path, voxel_map.viewpoint
    if viewpoint is None or len(path.stops) != 1:
        return None
    poses = path.poses(next(iter(path.stops)))
    chosen = np.unique(np.linspace(0, len(poses) - 1, MOST_PLACES).round().astype(int))
    counted = views(truth, poses[chosen], viewpoint.camera, voxel_map.config.max_range)
    return counted * (len(poses) / len(chosen))


def views(
    truth: TruthCells, poses: Sequence[Transform] | NDArray[np.float64], camera: PinholeCamera, max_range: float
) -> NDArray[np.int64]:
    """Count, for each surface cell of the truth (S,), the `poses`, T_world_camera, that can see it.

    A cell is seen if the middle of one of its faces is in the image, at most `max_range` metres away along the optical
    axis, and the straight line to it meets no other surface cell.
    """
    cells, size = truth.surface(), truth.voxel_size
    counts = np.zeros(len(cells), np.int64)
    for pose in poses:
        seen = np.zeros(len(cells), bool)
        near = _in_reach(cells, pose, max_range, size)
        for face in _FACES:
            middle = (cells[near] + 0.5 + (0.5 - _INSIDE) * face) * size
            turned = (pose[:3, 3] - middle) @ face > 0
            local = transform_points(inverse(pose), middle[turned])
            shown = project(camera, local)[1] & (local[:, 2] <= max_range)
            asked = near[turned][shown]
            seen[asked] |= _reached(truth.map, pose[:3, 3], middle[turned][shown], cells[asked])
        counts += seen
    return counts


def _in_reach(cells: NDArray[np.integer], pose: Transform, max_range: float, size: float) -> NDArray[np.int64]:
    """Return which cells are ahead of the camera, within its range and two cells."""
    ahead = ((cells + 0.5) * size - pose[:3, 3]) @ pose[:3, 2]
    return np.flatnonzero((ahead > -2 * size) & (ahead < max_range + 2 * size))


def _reached(
    truth: VoxelMap, origin: NDArray[np.float64], points: NDArray[np.float64], cells: NDArray[np.integer]
) -> NDArray[np.bool_]:
    """Return which `points` (N, 3), each in its cell, are the first hit of the ray from `origin`."""
    if not len(points):
        return np.zeros(0, bool)
    hits = truth.cast_rays(origin, points - origin, np.inf)
    return (hits.cell == cells).all(axis=1)
