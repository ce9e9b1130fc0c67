# SPDX-License-Identifier: Apache-2.0
"""The two ray tracers of Chien 2020, 3.4, on the same images: which cells does only one of them update?"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from time import process_time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.config import load_config
from stereovox.depth import prepare
from stereovox.evaluate.truth import Keys, indices, keys, occupied_cells
from stereovox.frame import DepthImage
from stereovox.geometry.se3 import Transform, inverse, transform_points
from stereovox.integrate import make_integrator
from stereovox.maps import VoxelMap, make_map
from stereovox.maps.cells.evidence import Evidence
from stereovox.maps.storage.blocks import SIDE
from stereovox.simulate.simulation import Simulation
from stereovox.view.figures import measured, title
from stereovox_lab.papers.chapter import Chapter, Claim, Sheet, Shown, percent
from stereovox_lab.papers.pictures import figure_of, png

TRACERS = ("ray", "line")
RIM_CELLS = 1.5
"""A cell is at the rim if its centre is at most this many cell widths inside the field of view, or outside it."""
PAPER = (
    "Line drawing tries to make the line as thin as possible with less effort; voxel traversal fills every cell the "
    "ray passes. The missed cells can still be updated by other rays, except close to the edge of the field of view."
)
OURS = "One 8x8 frame in the apartment, layer at the camera's height; the camera is where the cone begins."
HEADS = (
    "downsampling",
    "updated by traversal",
    "by line",
    "by both",
    "only by traversal",
    "only by line",
    "ms, traversal",
    "ms, line",
)
THICK = (
    "Line drawing leaves more cells occupied: rays that only graze a cell do not clear it. With one sensor model for "
    "both its walls are therefore a little thicker than those of voxel traversal."
)


@dataclass
class Comparison:
    """Both tracers at one downsampling. Counts are summed over all frames.

    ray, line, both: cells that a frame updates. only_ray, only_line: by one of them alone; at_rim: those of only_ray
    at the rim of the field of view. occupied_*: cells of the finished maps. updated: of the last frame, keys
    by tracer; its camera position is `eye`.
    """

    downsample: int
    ray: int = 0
    line: int = 0
    both: int = 0
    at_rim: int = 0
    ms: dict[str, list[float]] = field(default_factory=lambda: {name: [] for name in TRACERS})
    occupied_ray: int = 0
    occupied_line: int = 0
    occupied_both: int = 0
    updated: dict[str, Keys] = field(default_factory=dict)
    eye: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))

    @property
    def only_ray(self) -> int:
        """Cells that only voxel traversal updates."""
        return self.ray - self.both

    @property
    def only_line(self) -> int:
        """Cells that only line drawing updates."""
        return self.line - self.both

    def median_ms(self, name: str) -> float:
        """Return the median milliseconds of a tracer, map update included."""
        return float(np.median(self.ms[name]))

    def figures(self) -> dict[str, Any]:
        """Return its numbers, fit for JSON."""
        counts = ("downsample", "ray", "line", "both", "only_ray", "only_line", "at_rim")
        occupied = ("occupied_ray", "occupied_line", "occupied_both")
        times = {f"{name}_ms": self.median_ms(name) for name in TRACERS}
        return {name: getattr(self, name) for name in (*counts, *occupied)} | times


def compare_tracers(
    downsample: int,
    *,
    frames: int = 60,
    location: str = "sim:apartment?axes=optical",
    step: Callable[[], None] = lambda: None,
) -> Comparison:
    """Map the same images with both tracers under the profile `chien2020`, without its window."""
    configs = [
        load_config("chien2020", integrator=name, **{"depth.downsample": downsample, "window.size": None})
        for name in TRACERS
    ]
    tracers = {name: (make_integrator(one), make_map(one)) for name, one in zip(TRACERS, configs, strict=True)}
    simulation, found = Simulation(location, frames=frames), Comparison(downsample)
    for frame in simulation:
        image = prepare(frame, configs[0])
        found.updated = {name: _update(found, name, *tracer, image) for name, tracer in tracers.items()}
        _count(found, image, configs[0].voxel_size)
        step()
    _compare_maps(found, *(voxel_map for _, voxel_map in tracers.values()))
    found.eye = simulation.pose(len(simulation) - 1)[:3, 3]
    return found


def updated_cells(evidence: Evidence) -> NDArray[np.int64]:
    """Return the cells (N, 3) with evidence."""
    block, column = np.nonzero(evidence.values)
    low = np.stack([column >> 6, (column >> 3) & 7, column & 7], axis=1)
    cells = evidence.coords[block].astype(np.int64) * SIDE + low
    whole = np.stack(np.unravel_index(np.arange(SIDE**3), (SIDE,) * 3), axis=1)
    free = (evidence.uniform[:, None, :].astype(np.int64) * SIDE + whole).reshape(-1, 3)
    return np.concatenate([cells, free])


def near_rim(cells: NDArray[np.integer], camera: PinholeCamera, T_world_camera: Transform, size: float) -> NDArray:
    """Return which cells (N, 3) are at the rim of the field of view, outside it, or around the camera."""
    x, y, z = transform_points(inverse(T_world_camera), (cells + 0.5) * size).T
    z = np.maximum(z, 1e-9)
    u, v = camera.fx * x / z + camera.cx + 0.5, camera.fy * y / z + camera.cy + 0.5
    inside = np.minimum(
        np.minimum(u, camera.width - u) * z / camera.fx, np.minimum(v, camera.height - v) * z / camera.fy
    )
    return inside < RIM_CELLS * size


def _update(found: Comparison, name: str, integrator: Any, voxel_map: VoxelMap, image: DepthImage) -> Keys:
    start = process_time()
    evidence = integrator.evidence(image)
    voxel_map.add(evidence)
    found.ms[name].append(1e3 * (process_time() - start))
    return np.sort(keys(updated_cells(evidence)))


def _count(found: Comparison, image: DepthImage, size: float) -> None:
    ray, line = (found.updated[name] for name in TRACERS)
    both = np.intersect1d(ray, line, assume_unique=True)
    found.ray, found.line, found.both = found.ray + len(ray), found.line + len(line), found.both + len(both)
    only = np.setdiff1d(ray, line, assume_unique=True)
    assert isinstance(image.camera, PinholeCamera)  # what the simulation has
    found.at_rim += int(near_rim(indices(only), image.camera, image.T_world_sensor, size).sum())


def _compare_maps(found: Comparison, ray: VoxelMap, line: VoxelMap) -> None:
    cells = [keys(occupied_cells(one)) for one in (ray, line)]
    found.occupied_ray, found.occupied_line = (len(one) for one in cells)
    found.occupied_both = len(np.intersect1d(cells[0], cells[1]))


def tracers_png(found: Comparison, size: float) -> bytes:
    """Return which cells of one frame, in the layer at the camera's height, are updated by both tracers or one."""
    from matplotlib.patches import Patch

    figure = figure_of(5.2)
    axis = figure.add_subplot()
    height = int(np.floor(found.eye[1] / size))
    layers = {name: indices(cells)[indices(cells)[:, 1] == height][:, [0, 2]] for name, cells in found.updated.items()}
    low = np.min([cells.min(0) for cells in layers.values()], axis=0)
    shape = np.max([cells.max(0) for cells in layers.values()], axis=0) - low + 1
    image = np.zeros(shape, int)
    for bit, cells in zip((1, 2), layers.values(), strict=True):
        image[tuple((cells - low).T)] |= bit
    colours = np.array([[255, 255, 255], [209, 96, 61], [35, 97, 140], [216, 221, 229]], np.uint8)
    extent = np.stack([low, low + shape]).T.ravel() * size
    axis.imshow(colours[image.T], origin="lower", extent=tuple(extent), interpolation="nearest")
    names = ("both", "only voxel traversal", "only line drawing")
    patches = [Patch(fc=colours[n] / 255, ec="#888", label=name) for n, name in zip((3, 1, 2), names, strict=True)]
    axis.legend(handles=patches, frameon=False, loc="upper left", bbox_to_anchor=(1, 1))
    title(axis, "Cells that one frame updates, layer at the camera's height, 8x8")
    measured(axis, ("x", "z", "y"))
    return png(figure)


def chapter(found: Sequence[Comparison], size: float) -> Chapter:
    """Return the chapter; the first comparison is drawn. size: of a cell in metres."""
    rows = [
        (_name(one), *(f"{n:,}" for n in (one.ray, one.line, one.both, one.only_ray, one.only_line)),
         f"{one.median_ms('ray'):.2f}", f"{one.median_ms('line'):.2f}")
        for one in found
    ]  # fmt: skip
    return Chapter(
        "tracers",
        "The two ray tracers",
        "The same images of the apartment by line drawing (Alg 1) and voxel traversal (Alg 2). Counted are the cells "
        "on which a frame says anything, summed over all frames, and the cells that are occupied in the end. The rim "
        "of the view is everything less than 1.5 cells inside it.",
        [claim for one in found for claim in _claims(one)],
        [Shown("Fig 3.10", PAPER, OURS, tracers_png(found[0], size))],
        [Sheet("Cells updated, all frames together; median time of a frame with map update", HEADS, rows)],
        [THICK],
        {"comparisons": [one.figures() for one in found]},
    )


def _claims(one: Comparison) -> list[Claim]:
    name, line_ms, ray_ms = _name(one), one.median_ms("line"), one.median_ms("ray")
    missed, at_rim = percent(one.only_ray / max(one.ray, 1)), percent(one.at_rim / max(one.only_ray, 1))
    differ = 1 - one.occupied_both / max(one.occupied_ray + one.occupied_line - one.occupied_both, 1)
    occupied = f"{one.occupied_line:,} by line, {one.occupied_ray:,} by traversal"
    return [
        Claim(f"{name}: time of line drawing and of traversal", "9.77 against 10.49 ms (10x10)",
              f"{line_ms:.2f} against {ray_ms:.2f} ms", None),
        Claim(f"{name}: line drawing misses cells that traversal updates", "yes, a few",
              f"{missed} of them; of the missed {at_rim} lie at the rim of the view", one.only_ray > one.only_line),
        Claim(f"{name}: occupied cells of the finished maps", "the difference is quite small",
              f"{occupied}; {percent(differ)} of all are in one map only", None),
    ]  # fmt: skip


def _name(one: Comparison) -> str:
    return f"{one.downsample}x{one.downsample}" if one.downsample > 1 else "Full resolution"
