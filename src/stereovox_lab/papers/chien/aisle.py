# SPDX-License-Identifier: Apache-2.0
"""A narrow aisle (Chien 2020, 4.4.2.2 and Fig 4.12): how much of its far walls survives downsampling?"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.config import load_config
from stereovox.evaluate.truth import Keys, keys, occupied_cells, position, touched_cells, within
from stereovox.evaluate.truth_cells import Sightings
from stereovox.frame import Frame
from stereovox.mapper import Mapper
from stereovox.maps import VoxelMap
from stereovox.products.floor_axes import layer
from stereovox.simulate.scene import Scene, Solid
from stereovox.simulate.simulation import SIMPLE, Simulation
from stereovox.simulate.stage import Face
from stereovox.view.figures import GREY, STATE_COLOURS, labels, title
from stereovox_lab.papers.chapter import Chapter, Claim, Sheet, Shown, percent
from stereovox_lab.papers.pictures import SECOND, cut, figure_of, png

FAR_M = 8.0
"""Walls beyond this distance count as far."""
MAX_RANGE_M = 13.0
"""Largest depth used here: the profile's 10 m would end before the aisle does."""
MIN_SHARE = 0.95
"""Share of full resolution's findings that counts as nothing lost."""
MIN_FOUND = 0.9
"""Least share of the far walls' cells that exact rays find, to serve as a reference."""
PAPER = (
    "The resolution downsampling value affected aisle-like scenes a lot: only the closest depth of each block "
    "counts, so the further depth of the aisle may be filtered out. The further cells cannot be updated often with a "
    "higher ratio."
)
OURS = (
    "The layer of cells below the camera's height; the aisle lies on its side, the camera stands at the left. Dark is "
    "occupied, cream free, orange undecided, grey unknown; lines are the true walls. Far is right of the dotted line."
)
HEADS = ("variant", f"found beyond {FAR_M:g} m", "of exact rays", "found nearer", "stray", "ms a frame")
WHY = (
    "The yardstick is exact rays at full resolution with the strongest evidence a frame: whatever any pixel measured "
    "is in that map. The footprint rule (integrator projective) comes to the same in a tenth of the time and needs "
    "no smaller image: a near cell is judged by all pixels of its footprint, so nothing near is lost, and a far cell "
    "by its own few pixels. The thesis's rule, by which all rays add up, loses far walls even at full resolution: "
    "beyond 8 m the noise spreads the hits over several cells, each too weak against the rays that graze the cell on "
    "their way further. A 4x4 minimum takes away part of that noise and finds more; from there on a higher ratio "
    "only loses."
)
STRAY = (
    "Stray: share of the occupied cells beyond 8 m that have no wall, floor or ceiling within one cell; noise along "
    "the rays is 0.25 m at 8 m and 0.55 m at 12 m, so the end wall is smeared. Times are medians and include "
    "preparing the image."
)


@dataclass(frozen=True)
class Variant:
    """One method of mapping the aisle.

    update: see the setting `ray.update`. wanted: whether it must find nearly all that full resolution finds.
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
"""The first one is the reference: it contains all that any pixel saw."""


@dataclass(frozen=True, eq=False)
class AisleFound:
    """One variant's map. far_cells: cells of walls beyond `FAR_M` that the camera sees; found: share of them occupied.

    near_found: the same for nearer walls. against_full: `found` relative to full resolution. stray: share of the
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
    *,
    frames: int = 100,
    variants: Sequence[Variant] = VARIANTS,
    camera: str = SIMPLE,
    step: Callable[[], None] = lambda: None,
) -> tuple[list[AisleFound], Simulation]:
    """Map the same images of an aisle of 12 m with every variant; the first is the reference.

    camera: as in the simulation's options.
    """
    simulation = Simulation(f"sim:aisle?length=12&axes=optical&camera={camera}", frames=frames)
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
    """Return those of `cells` in which a pixel of the static camera's image ends."""
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


def aisle_png(found: Sequence[AisleFound], solids: Sequence[Solid]) -> bytes:
    """Return the layer at the camera's height of every variant, the aisle lying on its side (after Fig 4.12)."""
    figure = figure_of(1.75 * len(found) + 0.5)
    axes = figure.subplots(len(found), 1, sharex=True, squeeze=False)[:, 0]
    for axis, one in zip(axes, found, strict=True):
        cut_open = layer(one.voxel_map, "y", 0.0)
        axis.imshow(_state_image(cut_open.state.T), origin="lower", interpolation="nearest",
                    extent=(*cut_open.extent[2:], *cut_open.extent[:2]))  # fmt: skip
        for solid in solids:
            polygon = cut(solid, 0.0)
            if len(polygon) > 2:
                axis.fill(*polygon[:, ::-1].T, fill=False, edgecolor=SECOND, linewidth=0.9)
        axis.axvline(FAR_M, color=GREY, linewidth=1, linestyle=":")
        axis.set(xlim=(-0.3, 13.0), ylim=(-0.85, 0.85))
        title(axis, f"{one.variant.name}: {100 * one.found:.0f} % of the far walls' cells")
        labels(axis, "", "x [m]")
    axes[-1].set_xlabel("distance [m]; right of the dotted line is far", color=GREY)
    return png(figure)


def _state_image(states: NDArray[np.uint8]) -> NDArray[np.uint8]:
    colours = [[int(STATE_COLOURS[state][i : i + 2], 16) for i in (1, 3, 5)] for state in sorted(STATE_COLOURS)]
    return np.array(colours, np.uint8)[states]


def chapter(found: Sequence[AisleFound], scene: Scene) -> Chapter:
    """Return the chapter."""
    rows = [
        (one.variant.name, percent(one.found), percent(one.against_full), percent(one.near_found), percent(one.stray),
         f"{one.ms:.2f}")
        for one in found
    ]  # fmt: skip
    return Chapter(
        "aisle",
        "Aisle of 12 m",
        "The camera stands at one end of an aisle 1.27 m wide and looks along it. Far cells are those beyond "
        f"{FAR_M:g} m that a side wall or the end wall touches and a pixel sees: {found[0].far_cells} cells of 0.2 m. "
        "All variants get the same images and the sensor model of chien2020, with depths up to 13 m and no window.",
        claims_of(found),
        [Shown("Fig 4.12", PAPER, OURS, aisle_png(found, scene.solids))],
        [Sheet("All variants", HEADS, rows)],
        [WHY, STRAY],
        {"variants": [one.figures() for one in found]},
    )


def claims_of(found: Sequence[AisleFound]) -> list[Claim]:
    """Return what is claimed; the first one found is the reference."""
    lines = [one for one in found if one.variant.integrator == "line" and one.variant.downsample > 1]
    falling = all(a.found >= b.found for a, b in pairwise(lines)) and lines[0].found > lines[-1].found
    ours = ", ".join(f"{one.variant.downsample}x{one.variant.downsample}: {percent(one.found)}" for one in lines)
    claims = [Claim("Line drawing: the higher the ratio, the fewer far cells are found", "yes", ours, falling)]
    claims.append(_yardstick(found[0]))
    claims += [claim for one in found if one.variant.wanted for claim in _claims(one, found[0])]
    return claims


def _yardstick(exact: AisleFound) -> Claim:
    """Return whether exact rays find enough to serve as reference."""
    text = f"{exact.variant.name}: at least {100 * MIN_FOUND:.0f} % of all far cells, to be a yardstick"
    return Claim(text, "-", percent(exact.found), exact.found >= MIN_FOUND)


def _claims(one: AisleFound, exact: AisleFound) -> list[Claim]:
    """Return what is claimed of stereovox's own rule: nearly all that exact rays find, and no more stray cells."""
    text = f"{one.variant.name}: at least {100 * MIN_SHARE:.0f} % of the far cells that exact rays find"
    stray = f"{percent(one.stray)} against {percent(exact.stray)}"
    return [
        Claim(text, "a challenge left open", percent(one.against_full), one.against_full >= MIN_SHARE),
        Claim(
            f"{one.variant.name}: no more stray far cells than exact rays",
            "-",
            stray,
            one.found > 0 and one.stray <= exact.stray,
        ),
    ]
