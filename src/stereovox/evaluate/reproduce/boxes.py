# SPDX-License-Identifier: Apache-2.0
"""Boxes before a standing camera (Chien 2020, 4.4.1): how many cells wide do they stand in the map, and where?"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.config import Config, load_config
from stereovox.depth import prepare
from stereovox.integrate import make_integrator
from stereovox.maps import State, VoxelMap, make_map
from stereovox.sources.boxes import SIZES
from stereovox.sources.d435 import CAMERA
from stereovox.sources.simulation import Simulation

INTEGRATORS = ("line", "ray")
UPDATES = 100
"""Frames that every map takes in, at least (Chien 2020, 4.3.1)."""
WALL_M, FLOOR_M = 4.1, 1.2
"""Where the wall stands behind the box, and the floor below the camera."""
CLEAR_M = 0.6
"""What is nearer to the wall or to the floor belongs to them; no box is put there."""
NEAREST_M, IN_VIEW = 1.0, 0.9
"""Nearest front of a box; share of the field of view that it may reach."""
DIRECTIONS = ("left", "right", "top", "bottom", "front")


@dataclass(frozen=True)
class Placement:
    """A box: its size by name, distance of its front, and its middle right of and below the optical axis, in metres."""

    size: str
    distance: float
    x: float = 0.0
    y: float = 0.0

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Lowest and highest corner (2, 3) in metres: x right, y down, z forward."""
        width, height, depth = SIZES[self.size]
        low = (self.x - width / 2, self.y - height / 2, self.distance)
        return np.array([low, (low[0] + width, low[1] + height, low[2] + depth)])

    def simulation(self, frames: int) -> Simulation:
        """Return what a D435 sees of it, in Chien's map frame."""
        where = f"sim:box?size={self.size}&distance={self.distance}&x={self.x}&y={self.y}&wall={WALL_M}&axes=optical"
        return Simulation(where, frames=frames)


@dataclass(frozen=True, eq=False)
class BoxFound:
    """A box as it stands in a map.

    cells: (N, 3) its occupied cells. errors: (5,) cells by which its left, right, top, bottom and front lie further
        out (positive) or in than the cells that hold the true sides; None where no cell is occupied.
    width: occupied cells side by side in the fullest row of the layer just below the optical axis.
    hidden, hidden_known: cells behind the box that no ray can reach, and how many of them are not unknown.
    """

    placement: Placement
    integrator: str
    voxel_map: VoxelMap
    cells: NDArray[np.int64]
    errors: NDArray[np.int64] | None
    width: int
    hidden: int
    hidden_known: int

    @property
    def within_one_cell(self) -> bool:
        """Whether the box is there and no side is more than one cell off."""
        return self.errors is not None and int(np.abs(self.errors).max()) <= 1

    def figures(self) -> dict[str, Any]:
        """Return its numbers, fit for JSON."""
        errors = None if self.errors is None else dict(zip(DIRECTIONS, self.errors.tolist(), strict=True))
        place = {name: getattr(self.placement, name) for name in ("size", "distance", "x", "y")}
        counts = {"cells": len(self.cells), "width": self.width}
        hidden = {"hidden": self.hidden, "hidden_known": self.hidden_known}
        return {**place, "integrator": self.integrator, "errors": errors, **counts, **hidden}


def find_boxes(
    places: Sequence[Placement],
    *,
    updates: int = UPDATES,
    integrators: Sequence[str] = INTEGRATORS,
    settings: dict[str, Any] | None = None,
    step: Callable[[], None] = lambda: None,
) -> list[BoxFound]:
    """Map each placement with each integrator under the profile `chien2020` and find the box again.

    The same images go to all integrators. settings: on top of the profile. step: called after each placement.
    """
    configs = [load_config("chien2020", integrator=name, **(settings or {})) for name in integrators]

    def find(place: Placement) -> list[BoxFound]:
        maps = map_together(configs, place.simulation(updates))
        step()
        return [find_box(one, place, name) for one, name in zip(maps, integrators, strict=True)]

    with ThreadPoolExecutor(2) as threads:
        return [found for several in threads.map(find, places) for found in several]


def map_together(configs: Sequence[Config], simulation: Simulation) -> list[VoxelMap]:
    """Return one map a config, all made of the same images; the configs differ in what comes after the depth image."""
    maps, integrators = [make_map(config) for config in configs], [make_integrator(config) for config in configs]
    for i in range(len(simulation)):
        image = prepare(simulation.frame(i), configs[0])
        for voxel_map, integrator in zip(maps, integrators, strict=True):
            voxel_map.look_from(image.viewpoint)
            voxel_map.add(integrator.evidence(image))
            voxel_map.frames += 1
    return maps


def random_placements(number: int, seed: int = 0) -> Iterator[Placement]:
    """Yield boxes of both sizes in turn, wholly in view and clear of floor and wall."""
    random = np.random.default_rng(seed)
    slopes = np.array([CAMERA.width / CAMERA.fx, CAMERA.height / CAMERA.fy]) / 2
    for n in range(number):
        size = list(SIZES)[n % len(SIZES)]
        half = np.array(SIZES[size][:2]) / 2
        distance = random.uniform(NEAREST_M, WALL_M - CLEAR_M - SIZES[size][2])
        reach = IN_VIEW * slopes * distance - half
        reach[1] = min(reach[1], FLOOR_M - CLEAR_M - half[1])
        x, y = random.uniform(-reach, reach)
        yield Placement(size, round(distance, 3), round(float(x), 3), round(float(y), 3))


def find_box(voxel_map: VoxelMap, place: Placement, integrator: str = "") -> BoxFound:
    """Return what stands in the map of a box; every occupied cell that is not near wall or floor counts as box."""
    size = voxel_map.voxel_size
    occupied = voxel_map.occupied()
    box = occupied[(occupied[:, 2] < WALL_M - CLEAR_M) & (occupied[:, 1] < FLOOR_M - CLEAR_M + size)]
    cells = np.floor(box / size).astype(np.int64)
    hidden = voxel_map.state(hidden_centres(place, size))
    known = int((hidden != State.UNKNOWN).sum())
    found = (cells, _errors(cells, place, size), _width(cells))
    return BoxFound(place, integrator, voxel_map, *found, len(hidden), known)


def hidden_centres(place: Placement, size: float) -> NDArray[np.float64]:
    """Return the centres (N, 3) of all cells that lie wholly in the box's shadow, up to and in the wall.

    The shadow is the cone of the front face; it begins one cell behind the box, since a measurement may mark so far.
    """
    (x0, y0, front), (x1, y1, back) = place.bounds
    first, last = int(np.floor(back / size)) + 2, int(np.floor(WALL_M / size))
    far = np.abs([x0, x1, y0, y1]).max() * (last + 1) * size / front
    across = np.arange(-int(far / size) - 1, int(far / size) + 2)
    cells = np.stack(np.meshgrid(across, across, np.arange(first, last + 1), indexing="ij"), axis=-1).reshape(-1, 3)
    near, far_side = cells[:, 2] * size, (cells[:, 2] + 1) * size
    inside = np.ones(len(cells), bool)
    for axis, low, high in ((0, x0, x1), (1, y0, y1)):
        start, end = cells[:, axis] * size, (cells[:, axis] + 1) * size
        inside &= np.minimum(start / near, start / far_side) >= low / front
        inside &= np.maximum(end / near, end / far_side) <= high / front
    return np.asarray(cells[inside] + 0.5, float) * size


def _errors(cells: NDArray[np.int64], place: Placement, size: float) -> NDArray[np.int64] | None:
    if not len(cells):
        return None
    low, high = place.bounds / size
    first, last = np.floor(low), np.ceil(high) - 1
    found_first, found_last = cells.min(0), cells.max(0)
    sides = [(first[axis] - found_first[axis], found_last[axis] - last[axis]) for axis in (0, 1)]
    return np.array([*sides[0], *sides[1], first[2] - found_first[2]]).astype(np.int64)


def _width(cells: NDArray[np.int64]) -> int:
    """Return the number of cells in the fullest row, left to right, of the layer y = 0."""
    rows = cells[cells[:, 1] == 0, 2]
    return int(np.unique(rows, return_counts=True)[1].max()) if len(rows) else 0
