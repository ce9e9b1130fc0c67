# SPDX-License-Identifier: Apache-2.0
"""A narrow aisle (Chien 2020, 4.4.2.2 and Fig 4.12): how much of its far walls survives downsampling?"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stereovox.config import load_config
from stereovox.evaluate.cells import Keys, keys, occupied_cells, position, within
from stereovox.evaluate.sightings import Sightings
from stereovox.evaluate.truth import touched_cells
from stereovox.frame import Frame
from stereovox.mapper import Mapper
from stereovox.maps import VoxelMap
from stereovox.sources.simulation import Simulation
from stereovox.sources.stage import Face

FAR_M = 8.0
"""From this distance on a wall counts as far."""
MAX_RANGE_M = 13.0
"""Depths that count here: the profile's 10 m would end before the aisle does."""


@dataclass(frozen=True)
class Variant:
    """One way to map the aisle.

    update: see the setting `ray.update`. wanted: whether it must find nearly all that full resolution does.
    """

    name: str
    integrator: str
    downsample: int
    update: str = "every"
    wanted: bool = False


VARIANTS = (
    Variant("exact rays, strongest evidence of a frame, full resolution", "ray", 1, "once"),
    Variant("line, full resolution", "line", 1),
    Variant("line, 4x4 minimum", "line", 4),
    Variant("line, 8x8 minimum", "line", 8),
    Variant("line, 10x10 minimum", "line", 10),
    Variant("voxel traversal, full resolution", "ray", 1),
    Variant("voxel traversal, 8x8 minimum", "ray", 8),
    Variant("footprint rule, full resolution", "projective", 1, wanted=True),
    Variant("footprint rule, 2x2 minimum", "projective", 2),
)
"""The first one is what all are measured by: whatever a pixel saw is in it."""


@dataclass(frozen=True, eq=False)
class AisleFound:
    """One variant's map. far_cells: cells of walls beyond `FAR_M` that the camera sees; found: share of them occupied.

    near_found: the same for the walls before. against_full: `found` over that of full resolution. stray: share of the
    occupied cells beyond `FAR_M` that have no wall, floor or ceiling within one cell. ms: a frame, median.
    """

    variant: Variant
    voxel_map: VoxelMap
    far_cells: int
    found: float
    near_found: float
    against_full: float
    stray: float
    ms: float

    def figures(self) -> dict[str, Any]:
        """Return its numbers, fit for JSON."""
        names = ("far_cells", "found", "near_found", "against_full", "stray", "ms")
        return {"name": self.variant.name, **{name: getattr(self, name) for name in names}}


def compare_aisles(
    *, frames: int = 100, variants: Sequence[Variant] = VARIANTS, step: Callable[[], None] = lambda: None
) -> tuple[list[AisleFound], Simulation]:
    """Map the same images of an aisle of 12 m in every way; the first variant is what all are measured by."""
    simulation = Simulation("sim:aisle?length=12&axes=optical", frames=frames)
    mappers = [Mapper(_config(variant)) for variant in variants]
    times: list[list[float]] = [[] for _ in variants]
    for frame in simulation:
        for mapper, ms in zip(mappers, times, strict=True):
            ms.append(_add(mapper, frame))
        step()
    size = mappers[0].map.voxel_size
    far, near = (seen_cells(simulation, cells, size) for cells in wall_cells(simulation.faces, size))
    surfaces = touched_cells(simulation.scene.triangles, size)
    shares = [share_found(mapper.map, far) for mapper in mappers]
    found = [
        AisleFound(variant, mapper.map, len(far), share, share_found(mapper.map, near), share / max(shares[0], 1e-9),
                   _stray(mapper.map, keys(surfaces)), float(np.median(ms[1:] or ms)))
        for variant, mapper, ms, share in zip(variants, mappers, times, shares, strict=True)
    ]  # fmt: skip
    return found, simulation


def wall_cells(faces: Sequence[Face], size: float) -> tuple[Keys, Keys]:
    """Return the cells that the walls' faces touch beyond and before `FAR_M`; z is the distance."""
    triangles = np.concatenate([face.corners[[[0, 1, 2], [0, 2, 3]]] for face in faces])
    cells = touched_cells(triangles, size)
    far = cells[:, 2] * size >= FAR_M
    return keys(cells[far]), keys(cells[~far])


def seen_cells(simulation: Simulation, cells: Keys, size: float) -> Keys:
    """Return those of `cells` in which a pixel of the standing camera's image ends."""
    sightings = Sightings(cells, size)
    sightings.add(simulation.true_depth(0), simulation.camera, simulation.pose(0))
    return cells[sightings.frames > 0]


def share_found(voxel_map: VoxelMap, cells: Keys) -> float:
    """Return the share of `cells` that the map calls occupied."""
    return float((position(cells, np.sort(keys(occupied_cells(voxel_map)))) >= 0).mean())


def _config(variant: Variant) -> Any:
    settings = {"depth.downsample": variant.downsample, "ray.update": variant.update}
    settings |= {"integrator": variant.integrator, "window.size": None, "max_range": MAX_RANGE_M}
    return load_config("chien2020", **settings)


def _add(mapper: Mapper, frame: Frame) -> float:
    report = mapper.add(frame)
    return report.depth_ms + report.integrate_ms


def _stray(voxel_map: VoxelMap, surfaces: Keys) -> float:
    occupied = occupied_cells(voxel_map)
    far = keys(occupied[occupied[:, 2] * voxel_map.voxel_size >= FAR_M])
    return float(1 - within(far, surfaces, 1).mean()) if len(far) else 0.0
