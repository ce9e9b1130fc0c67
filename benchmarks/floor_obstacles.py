# SPDX-License-Identifier: Apache-2.0
"""Obstacles and free floor that a 2-D grid of a 3-D map calls free.

    python benchmarks/floor_obstacles.py [--seeds N] [--first N] [--places N] [--kitchen FOLDER]

Each scene is mapped in a world whose z = 0 is where the camera began. A column is an obstacle if a surface of the scene
is 0.1 to 1.8 m above the floor there, at any of 16 places of the column; the true floor is free elsewhere. Columns
unknown to the map in that band are ignored. "Missed" are obstacles of which the map itself has only free cells in the
band: no projection can find what the sensor lost. Free floor was seen as floor and has no obstacle. "before" is the
earlier rule: the band from the world's origin, cleared by free cells at any height. The truth is derived from the
planes of the scene's solids and shares no code with the products; for a recording, from the map's own occupied cells
above a plane fitted to its floor.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

import stereovox as sv
from stereovox.formats.map_server import read_map_server
from stereovox.geometry.se3 import look_at
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.products.projection import project
from stereovox.simulate.d435 import D435, depth_camera
from stereovox.simulate.honest import honest_d435, honest_kinect
from stereovox.simulate.scene import Scene, Solid, box, cylinder
from stereovox.simulate.simulation import Simulation

BAND = (0.1, 1.8)
MARGIN = 0.005
"""Metres by which an obstacle must reach into the band."""
LOWER = (0.1, 1.2)
"""The same for a robot of 1.2 m."""
PLACES = (np.arange(4) + 0.5) / 4
Height = Callable[[NDArray], NDArray]


@dataclass(frozen=True, eq=False)
class World:
    """A scene whose floor is at `floor(x)` metres, and the camera's poses in it."""

    name: str
    scene: Scene
    floor: Height
    poses: list[NDArray]


def flat(x: NDArray) -> NDArray:
    return 0.0 * x


def ramp(share: float) -> Height:
    return lambda x: share * np.clip(x - 2.0, 0, 6.0)


def step(height: float) -> Height:
    return lambda x: np.where(x < 4.0, 0.0, height)


def furnished(name: str, floor: Height, cuts: list[float], seed: int, eye: float, frames: int) -> World:
    """A room of 10 x 6 m whose floor changes along x at `cuts`, with furniture at random, walked through."""
    random = np.random.default_rng(seed)
    solids, ends = [], [0.0, *cuts, 10.0]
    for left, right in pairwise(ends):
        solids.append(_lifted(box("floor", f"floor {left}", (left, 0, -0.3), (right, 6, 0)), floor, left, right))
    tall = float(floor(np.array([0.0, 4.5, 9.9])).max()) + 2.7
    low = float(floor(np.array([0.0, 4.5, 9.9])).min()) - 0.3
    solids += [
        box("walls", "back", (-0.2, -0.2, low), (0, 6.2, tall)),
        box("walls", "front", (10, -0.2, low), (10.2, 6.2, tall)),
        box("walls", "right", (0, -0.2, low), (10, 0, tall)), box("walls", "left", (0, 6, low), (10, 6.2, tall)),
        box("ceiling", "ceiling", (-0.2, -0.2, tall), (10.2, 6.2, tall + 0.2)),
    ]  # fmt: skip
    way = np.array([[1, 1.5], [4.8, 1.2], [9, 1.5], [8.8, 4.6], [5, 4.8], [1.2, 4.5], [1.5, 2.9], [5, 3.0], [8.5, 3.1]])
    taken: list[tuple[float, float, float]] = []
    for number in range(60):
        x, y = random.uniform([0.4, 0.4], [9.6, 5.6])
        along = np.concatenate([np.linspace(a, b, 30) for a, b in pairwise(way)])
        away = np.hypot(*(along - (x, y)).T).min()
        size = random.uniform(0.15, 0.7)
        clear = all(np.hypot(x - a, y - b) > size + c for a, b, c in taken)
        crosses = any(abs(x - cut) < size + 0.05 for cut in cuts)
        if away < size + 0.35 or not clear or crosses or len(taken) > 16:
            continue
        taken.append((x, y, size))
        left = max(end for end in ends if end <= x)
        right = min(end for end in ends if end > x)
        solids += [_lifted(part, floor, left, right) for part in _thing(number, x, y, size, random)]
    share = np.linspace(0, 1, frames)
    lengths = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(way, axis=0).T))])
    place = np.column_stack([np.interp(share * lengths[-1], lengths, way[:, k]) for k in (0, 1)])
    poses = []
    for k, (x, y) in enumerate(place):
        ahead = place[min(k + 1, frames - 1)] - place[max(k - 1, 0)]
        yaw = np.arctan2(ahead[1], ahead[0]) + 0.7 * np.sin(k / 7)
        z = float(floor(np.array(x)) + eye)
        down = 0.35 if eye > 1 else 0.12
        poses.append(look_at((x, y, z), (x + np.cos(yaw), y + np.sin(yaw), z - down)))
    return World(name, Scene(solids), floor, poses)


def _thing(number: int, x: float, y: float, size: float, random: np.random.Generator) -> list[Solid]:
    """A table, a low box, a cupboard, a stool, a hanging lamp, or a post."""
    kind, half = random.integers(6), 0.7 * size
    low, high = (x - half, y - half), (x + half, y + half)
    if kind == 0:
        top = random.uniform(0.4, 1.1)
        legs = [(a, b) for a in (low[0], high[0] - 0.05) for b in (low[1], high[1] - 0.05)]
        return [
            box("table", f"top {number}", (*low, top - 0.04), (*high, top)),
            *(box("table", f"leg {number} {a} {b}", (a, b, 0), (a + 0.05, b + 0.05, top - 0.04)) for a, b in legs),
        ]
    if kind == 1:
        return [box("box", f"box {number}", (*low, 0), (*high, random.uniform(0.15, 0.5)))]
    if kind == 2:
        return [box("cupboard", f"cupboard {number}", (*low, 0), (*high, random.uniform(0.8, 2.2)))]
    if kind == 3:
        seat = random.uniform(0.4, 0.5)
        return [box("stool", f"seat {number}", (x - 0.2, y - 0.2, seat - 0.05), (x + 0.2, y + 0.2, seat)),
                box("stool", f"foot {number}", (x - 0.03, y - 0.03, 0), (x + 0.03, y + 0.03, seat))]  # fmt: skip
    if kind == 4:
        bottom = random.uniform(1.2, 1.6)
        return [cylinder("lamp", f"lamp {number}", (x, y, bottom), (x, y, bottom + 0.25), 0.4),
                cylinder("lamp", f"cable {number}", (x, y, bottom + 0.25), (x, y, 2.6), 0.02)]  # fmt: skip
    return [cylinder("post", f"post {number}", (x, y, 0), (x, y, random.uniform(1.0, 2.4)), 0.06)]


def _lifted(solid: Solid, floor: Height, left: float, right: float) -> Solid:
    """Lift a solid onto the floor between two cuts, where it is a plane: a ramp shears it."""
    inner = np.array([left + 1e-6, right - 1e-6])
    at = floor(inner)
    slope = (at[1] - at[0]) / (inner[1] - inner[0])
    corners = solid.triangles.copy()
    corners[..., 2] += at[0] + slope * (corners[..., 0] - left)
    return Solid(solid.part, solid.name, corners)


def built_in(name: str, frames: int) -> World:
    """One of the package's simulated places; their floors are level."""
    simulation = Simulation(f"sim:{name}", frames=frames)
    stage = simulation.stage
    level = {"room": -0.0123}.get(name.partition("?")[0])
    level = min(s.bounds[1, 2] for s in stage.scene.solids if "floor" in s.name) if level is None else level
    return World(name, stage.scene, lambda x: 0.0 * x + level, [stage.path(k / (frames - 1)) for k in range(frames)])


def mapped(world: World, camera: str, voxel_size: float, seed: int) -> tuple[sv.VoxelMap, NDArray]:
    """Map a world in a frame with its origin at the camera's start; return the map and that origin."""
    device = _devices()[camera]
    origin = world.poses[0][:3, 3].copy()
    lens = device.camera
    x, y = lens.ray_slopes()
    rays = np.stack(np.broadcast_arrays(x[None, :], y[:, None], np.float32(1)), axis=-1).reshape(-1, 3)
    mapper = sv.Mapper(voxel_size=voxel_size, **{"trust.ordered": False})
    for number, T in enumerate(world.poses):
        true = world.scene.cast(T[:3, 3], rays @ T[:3, :3].T.astype(np.float32)).reshape(lens.height, lens.width)
        depth, reason = device.measure(true, [seed, number], T)
        T = T.copy()
        T[:3, 3] -= origin
        mapper.add(sv.Frame(depth, lens, T, number * 50_000_000, 0.001, reason, farthest=device.farthest))
    return mapper.map, origin


def _devices() -> dict[str, D435]:
    simple = D435(depth_camera(160))
    return {"simple": simple, "d435": honest_d435(simple), "kinect": honest_kinect(160)}


@dataclass(frozen=True)
class Score:
    """Counted columns of obstacles and of free floor, and how many of each the grid calls free."""

    obstacles: int
    called_free: int
    missed: int
    floor: int
    stays_free: int

    def __add__(self, other: Score) -> Score:
        return Score(*(a + b for a, b in zip(vars(self).values(), vars(other).values(), strict=True)))

    def __str__(self) -> str:
        wrong, right = self.called_free / max(self.obstacles, 1), self.stays_free / max(self.floor, 1)
        return (
            f"{self.called_free:6} of {self.obstacles:6} obstacles free ({wrong:6.2%}; {self.missed} missed), "
            f"{self.stays_free:6} of {self.floor:6} of the floor ({right:5.1%})"
        )


@dataclass(frozen=True, eq=False)
class Truth:
    """Middles (N, 2) of columns in metres of the map; which are obstacles, free floor, and lost by the map."""

    places: NDArray
    obstacles: NDArray
    floor: NDArray
    lost: NDArray


def truth_of(voxel_map: sv.VoxelMap, world: World, origin: NDArray, band: tuple[float, float] = BAND) -> Truth:
    """Return the truth of a map's columns in a world, as far as they are known to the map."""
    side = voxel_map.voxel_size
    low, high = (np.rint(end / side).astype(int) for end in voxel_map.bounds())
    columns = np.stack(np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]), indexing="ij"), -1)
    columns = columns.reshape(-1, 2)
    obstacle, inside = np.zeros(len(columns), bool), np.zeros(len(columns), bool)
    for solid in world.scene.solids:
        ends = (solid.bounds[:, :2] - origin[:2]) / side
        near = np.flatnonzero(((columns + 1 > ends[0]) & (columns < ends[1])).all(axis=1))
        for place in product(PLACES, PLACES):
            x, y = ((columns[near] + place) * side + origin[:2]).T
            base, (bottom, top) = world.floor(x), _through(solid, x, y)
            obstacle[near] |= (bottom < base + band[1]) & (top > base + band[0] + MARGIN) & (bottom < top)
            inside[near] |= (solid.part == "floor") & (bottom < top)
    middle = (columns + 0.5) * side
    base = world.floor(middle[:, 0] + origin[0]) - origin[2]
    known, seen_floor, lost = np.zeros(len(columns), bool), np.zeros(len(columns), bool), np.ones(len(columns), bool)
    for above in np.arange(band[0] + side / 2, band[1], side):
        state = voxel_map.state(np.column_stack([middle, base + above]))
        known |= state != sv.State.UNKNOWN
        lost &= state == sv.State.FREE
    for above in (-side, 0, side):
        seen_floor |= voxel_map.state(np.column_stack([middle, base + above])) == sv.State.OCCUPIED
    return Truth(middle, obstacle & known & inside, ~obstacle & seen_floor & inside, lost)


def score(grid: OccupancyGrid, truth: Truth) -> Score:
    """Count the columns that a grid calls free."""
    free = _state(grid, truth.places) == sv.State.FREE
    wrong = truth.obstacles & free
    return Score(*(int(np.count_nonzero(which)) for which in
                   (truth.obstacles, wrong, wrong & truth.lost, truth.floor, truth.floor & free)))  # fmt: skip


def _through(solid: Solid, x: NDArray, y: NDArray) -> tuple[NDArray, NDArray]:
    """Return the heights at which vertical lines enter and leave a convex solid; bottom above top if they miss it."""
    bottom, top = np.full(len(x), -np.inf), np.full(len(x), np.inf)
    for a, b, c, d in solid.planes:
        rest = d - a * x - b * y
        if abs(c) < 1e-9:
            top = np.where(rest < 0, -np.inf, top)
        elif c > 0:
            top = np.minimum(top, rest / c)
        else:
            bottom = np.maximum(bottom, rest / c)
    return bottom, top


def _state(grid: OccupancyGrid, places: NDArray) -> NDArray:
    rows, columns = np.floor((places - grid.origin[:2]) / grid.resolution).astype(int)[:, ::-1].T
    inside = (rows >= 0) & (columns >= 0) & (rows < grid.cells.shape[0]) & (columns < grid.cells.shape[1])
    states = np.zeros(len(places), np.uint8)
    states[inside] = grid.states[rows[inside], columns[inside]]
    return states


def before(voxel_map: sv.VoxelMap) -> OccupancyGrid:
    """Return the grid by the earlier rule."""
    cells, _ = voxel_map.cells()
    state = voxel_map.state(voxel_map.centers(cells))
    low = cells[:, :2].min(axis=0)
    shape = tuple((cells[:, :2].max(axis=0) + 1 - low)[::-1])
    grid, place = np.full(shape, -1, np.int8), tuple((cells[:, :2] - low)[:, ::-1].T)
    height = (cells[:, 2] + 0.5) * voxel_map.voxel_size
    within = (height > BAND[0]) & (height <= BAND[1])
    steps = ((state == sv.State.FREE, 0), (within & (state == sv.State.TENTATIVE), 50), (within & (state == 3), 100))
    for which, percent in steps:
        grid[tuple(at[which] for at in place)] = percent
    x, y = (low * voxel_map.voxel_size).tolist()
    return OccupancyGrid(grid, voxel_map.voxel_size, (x, y, 0.0))


def kitchen(folder: str) -> None:
    """Judge grids of a levelled, and of a tracked, recording by its own occupied columns above a plane."""
    for name, settings in {"levelled": {"level": True}, "tracked": {"poses": "track"}}.items():
        with TemporaryDirectory() as place:
            found = sv.map_recording(folder, Path(place) / "map.svox", **settings).map
            for heights in (BAND, LOWER):
                truth = truth_of_plane(found, heights)
                print(f"{Path(folder).name}, {name}, {heights[0]:g} to {heights[1]:g} m", flush=True)
                print(
                    f"  before: {score(before(found), truth)}\n  now:    {score(project(found, heights), truth)}",
                    flush=True,
                )


def live(folder: str) -> None:
    """Judge the grids that live runs write, with the recording's poses and tracked, as `kitchen` does."""
    for poses, heights in product(("given", "track"), (BAND, LOWER)):
        with TemporaryDirectory() as place:
            grid = Path(place) / "floor.yaml"
            found = sv.map_live(folder, Path(place) / "map.svox", poses=poses, grid=grid, heights=heights).map
            truth = truth_of_plane(found, heights)
            print(f"{Path(folder).name}, live, {poses}, {heights[0]:g} to {heights[1]:g} m, {found.frames} images")
            print(f"  written: {score(read_map_server(grid), truth)}", flush=True)


def truth_of_plane(voxel_map: sv.VoxelMap, heights: tuple[float, float]) -> Truth:
    """Return the columns with occupied cells between two heights above the plane of most of the lowest ones."""
    occupied, random, side = voxel_map.occupied(), np.random.default_rng(0), voxel_map.voxel_size
    low = occupied[occupied[:, 2] < np.percentile(occupied[:, 2], 20)]
    best: tuple[int, NDArray] = (0, low[:0])
    for _ in range(3000):
        a, b, c = low[random.integers(len(low), size=3)]
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal)
        if length > 1e-6 and abs(normal[2]) > 0.97 * length:
            inliers = low[np.abs((low - a) @ (normal / length)) < 0.03]
            best = max(best, (len(inliers), inliers), key=lambda pair: pair[0])
    centre = best[1].mean(axis=0)
    normal = np.linalg.svd(best[1] - centre)[2][2]
    height = (occupied - centre) @ (normal * np.sign(normal[2]))
    columns = np.floor(occupied[:, :2] / side).astype(int)
    every, of_cell = np.unique(columns, axis=0, return_inverse=True)
    obstacle, floor = np.zeros(len(every), bool), np.zeros(len(every), bool)
    np.logical_or.at(obstacle, of_cell.ravel(), (height > heights[0]) & (height < heights[1]))
    np.logical_or.at(floor, of_cell.ravel(), np.abs(height) < 0.06)
    return Truth((every + 0.5) * side, obstacle, floor & ~obstacle, np.zeros(len(every), bool))


def worlds(seeds: Sequence[int], places: int) -> Iterator[tuple[World, str, float, int]]:
    """All scenes with camera, cell side and seed."""
    for seed in seeds:
        camera, eye = ("simple", "d435", "kinect")[seed % 3], (1.3, 0.45, 0.8)[seed // 3 % 3]
        for name, floor, cuts in (
            ("level", flat, []), ("ramp of 10 degrees", ramp(0.176), [2.0, 8.0]),
            ("step of 0.08 m", step(0.08), [4.0]), ("step of 0.3 m", step(0.3), [4.0]),
        ):  # fmt: skip
            yield furnished(name, floor, cuts, seed, eye, 120), camera, 0.05, seed
    for name in ("room?image_width=160", "apartment", "hall?plan=3", "hall?plan=5")[:places]:
        yield built_in(name, 160), "simple", 0.05, 0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--places", type=int, default=4)
    parser.add_argument("--kitchen")
    options = parser.parse_args()
    totals = {name: Score(0, 0, 0, 0, 0) for name in ("before", "now", "now, 0.1 to 1.2 m")}
    for world, camera, side, seed in worlds(range(options.first, options.first + options.seeds), options.places):
        voxel_map, origin = mapped(world, camera, side, seed)
        truth, lower = (truth_of(voxel_map, world, origin, band) for band in (BAND, LOWER))
        cases = ((before(voxel_map), truth), (project(voxel_map), truth), (project(voxel_map, LOWER), lower))
        print(f"{world.name}, {camera}, seed {seed}")
        for name, case in zip(totals, cases, strict=True):
            found = score(*case)
            totals[name] += found
            print(f"  {name:18} {found}", flush=True)
    for name, total in totals.items():
        print(f"all, {name:18} {total}")
    if options.kitchen:
        kitchen(options.kitchen)
        live(options.kitchen)


if __name__ == "__main__":
    main()
