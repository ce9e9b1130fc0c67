# SPDX-License-Identifier: Apache-2.0
"""Two boxes at 2 m (Chien 2020, 4.4.1) at many settings: in how many are both two cells wide in the map?

The thesis shows one setting and leaves open k, p_min and the clamp of its sensor model, the boxes' positions within
their cells, and the noise. So its statement is judged over a grid of all these.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from stereovox.config import Config, load_config
from stereovox.depth import prepare
from stereovox.frame import DepthImage
from stereovox.integrate import Integrator, make_integrator
from stereovox.maps import VoxelMap, make_map
from stereovox.simulate.simulation import SIMPLE, Simulation
from stereovox_lab.papers.chapter import Chapter, Claim, Sheet
from stereovox_lab.papers.chien.boxes import CLEAR_M, NAMES, WALL_M, Placement, row_width

BOXES = ("large", "small")
DISTANCE_M = 2.0
WIDTH = 2
"""Cells side by side, of both boxes (Fig 4.6, 4.9)."""
CELL_M = 0.2
"""The thesis's own cell size, to which its statement refers."""
SHARE = 0.9
"""Least share of the settings in which a statement about them must hold."""
CHOSEN = "k 0.05 m, p_min 0.25, clamp 0.93"
MODELS: dict[str, dict[str, float]] = {
    CHOSEN: {},
    "the same, p_min 0.4": {"sensor.p_free": 0.4},
    "the same, clamp 0.85": {"sensor.p_max": 0.85},
    "the same, clamp 0.98": {"sensor.p_max": 0.98},
    "the same, k 0.02 m": {"sensor.k": 0.02},
    "the same, k 0.1 m": {"sensor.k": 0.1},
}
"""Constants of Eq 3.3 that the thesis does not give; the first are the profile `chien2020`'s."""
FACTORS = ("model", "cell", "place", "noise", "updates", "tracer")
HEADS = ("setting", "settings", "large box: 2 cells", "small box: 2 cells", "both", "share")
WHY = (
    "The statement is a matter of the settings, not of the method: the width of the large box is 2.35 cells of 0.2 m, "
    "that of the small one 1.25, and both come out at two only where they stand evenly on a border of cells, and where "
    "the constants make a cell occupied that is half filled and not one that is a sixth filled. The profile's "
    "constants were chosen so that it comes out."
)


@dataclass(frozen=True)
class Extent:
    """The values of each factor.

    places: of camera and boxes, in cells to the right and ahead of the thesis's; noises:
    standard deviation of the disparity in pixels; updates: ascending numbers of frames.
    """

    models: tuple[str, ...] = tuple(MODELS)
    cells: tuple[float, ...] = (0.15, CELL_M, 0.25)
    places: tuple[tuple[float, float], ...] = ((0.0, 0.0), (0.25, 0.0), (0.5, 0.0), (0.0, 0.5))
    noises: tuple[float, ...] = (0.04, 0.08, 0.16)
    updates: tuple[int, ...] = (10, 50)
    tracers: tuple[str, ...] = ("line", "ray")

    @property
    def images(self) -> int:
        """Number of images."""
        return len(self.noises) * len(BOXES) * self.updates[-1]


@dataclass(frozen=True)
class Setting:
    """One point of the grid, and the width in cells of the boxes in its map, by size."""

    model: str
    cell: float
    place: tuple[float, float]
    noise: float
    updates: int
    tracer: str
    widths: dict[str, int]

    @property
    def gives_it(self) -> bool:
        """Whether both boxes are two cells wide."""
        return all(width == WIDTH for width in self.widths.values())

    def text(self, factor: str) -> str:
        """Return the value of a factor, for a table."""
        value = getattr(self, factor)
        words = {
            "cell": "cells of {} m",
            "noise": "noise of {} px",
            "updates": "{} updates",
            "place": "moved by {} cells",
        }
        told = NAMES.get(value, value) if isinstance(value, str) else value
        told = "{:g} across, {:g} ahead".format(*told) if factor == "place" else told
        return words.get(factor, "{}").format(told)


class _Run:
    """One map, and its camera's place. integrator: of these settings; several runs may share one."""

    def __init__(self, config: Config, integrator: Integrator, place: tuple[float, float]):
        self._map, self._integrator, cell = make_map(config), integrator, config.voxel_size
        self._shift = np.array([place[0], 0.0, place[1]]) * cell

    def add(self, image: DepthImage) -> None:
        """Add an image, as if the camera and its view were elsewhere within the cells."""
        T = image.T_world_sensor.copy()
        T[:3, 3] += self._shift
        moved = replace(image, T_world_sensor=T)
        self._map.storage.set_viewpoint(moved.viewpoint)
        self._map.add(self._integrator.evidence(moved))
        self._map.frames += 1

    def width(self) -> int:
        """Return the width in cells of the box in front of the wall."""
        return box_width(self._map, WALL_M - CLEAR_M + float(self._shift[2]))


def box_width(voxel_map: VoxelMap, nearer_than: float) -> int:
    """Return the number of occupied cells side by side in the layer y = 0, nearer than `nearer_than` metres along z."""
    occupied = voxel_map.occupied()
    return row_width(np.floor(occupied[occupied[:, 2] < nearer_than] / voxel_map.voxel_size).astype(np.int64))


def widths_over_grid(extent: Extent, *, camera: str = SIMPLE, step: Callable[[], None] = lambda: None) -> list[Setting]:
    """Map both boxes at every setting of the grid; step is called after each image.

    The same images go to all settings of one noise. camera: as in the simulation's options.
    """
    found: dict[tuple[Any, ...], dict[str, int]] = {}

    def look(which: tuple[float, str]) -> None:
        noise, size = which
        simulation = Placement(size, DISTANCE_M).simulation(extent.updates[-1], camera, noise)
        for key, width in _widths(extent, noise, simulation, step):
            found.setdefault(key, {})[size] = width

    with ThreadPoolExecutor(2) as threads:
        list(threads.map(look, product(extent.noises, BOXES)))
    values = (extent.models, extent.cells, extent.places, extent.noises, extent.updates, extent.tracers)
    return [Setting(*key, found[key]) for key in product(*values)]


def _widths(
    extent: Extent, noise: float, simulation: Simulation, step: Callable[[], None]
) -> list[tuple[tuple[Any, ...], int]]:
    runs = {}
    for model, cell, tracer in product(extent.models, extent.cells, extent.tracers):
        config = load_config("chien2020", integrator=tracer, voxel_size=cell, **MODELS[model])
        integrator = make_integrator(config)
        runs |= {(model, cell, place, tracer): _Run(config, integrator, place) for place in extent.places}
    profile, told = load_config("chien2020"), []
    for i in range(len(simulation)):
        image = prepare(simulation.frame(i), profile)
        for run in runs.values():
            run.add(image)
        if i + 1 in extent.updates:
            for (model, cell, place, tracer), run in runs.items():
                told.append(((model, cell, place, noise, i + 1, tracer), run.width()))
        step()
    return told


def chapter(found: Sequence[Setting]) -> Chapter:
    """Return the chapter."""
    own = [one for one in found if one.cell == CELL_M]
    rows = [_row("all settings", found), _row(f"cells of {CELL_M:g} m, the thesis's", own)]
    for factor in FACTORS:
        of = found if factor == "cell" else own
        values = list(dict.fromkeys(getattr(one, factor) for one in of))
        for value in values:
            same = [one for one in of if getattr(one, factor) == value]
            rows.append(_row(same[0].text(factor), same))
    heading = f"In how many settings each box is two cells wide; all rows but those of cells: cells of {CELL_M:g} m"
    return Chapter(
        "box_grid",
        "Two cells wide: at which settings?",
        f"The two boxes at 2 m once more, at {len(found)} settings: six sets of the sensor model's constants that the "
        "thesis does not give, three sizes of cells, four places of the boxes within their cells, three levels of "
        "noise, two numbers of updates, both tracers, each with each. A statement about them holds if it does in at "
        f"least {100 * SHARE:.0f} % of the settings.",
        _claims(own),
        sheets=[Sheet(heading, HEADS, rows)],
        remarks=[WHY],
        numbers={"settings": [vars(one) | {"gives_it": one.gives_it} for one in found],
                 "give_it": sum(one.gives_it for one in found), "give_it_own_cells": sum(one.gives_it for one in own),
                 "own_cells": len(own)},
    )  # fmt: skip


def _claims(own: Sequence[Setting]) -> list[Claim]:
    texts = {
        f"cells of {CELL_M:g} m, whatever else is set: both boxes are two cells wide": own,
        f"cells of {CELL_M:g} m, boxes placed as in the thesis, whatever else is set: both are two cells wide":
            [one for one in own if one.place == (0.0, 0.0)],
        f"cells of {CELL_M:g} m, the chosen constants ({CHOSEN}), whatever else is set: both are two cells wide":
            [one for one in own if one.model == CHOSEN],
    }  # fmt: skip
    return [_claim(text, some) for text, some in texts.items()]


def _claim(text: str, some: Sequence[Setting]) -> Claim:
    giving = sum(one.gives_it for one in some)
    return Claim(text, "two cells, one setting shown", f"{giving} of {len(some)} settings", giving >= SHARE * len(some))


def _row(name: str, some: Sequence[Setting]) -> tuple[Any, ...]:
    counts = [sum(one.widths[size] == WIDTH for one in some) for size in BOXES]
    both = sum(one.gives_it for one in some)
    return (name, len(some), *counts, both, f"{100 * both / max(len(some), 1):.0f}\u00a0%")
