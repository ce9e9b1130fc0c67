# SPDX-License-Identifier: Apache-2.0
"""Obstacles that a 2-D grid of a 3-D map calls free, and how much of the free floor it calls free.

    python benchmarks/floor_obstacles.py [SEEDS] [--kitchen FOLDER]

Each scene is mapped in a world whose z = 0 is where the camera began. A column is an obstacle if a surface of the
scene lies 0.1 to 1.8 m above the floor there, at any of 16 places of the column; the true floor is free elsewhere.
Columns of which the map knows nothing in that band do not count. The truth comes from the planes of the scene's solids
and shares no code with the products; that of a recording from the map's own occupied cells above a plane fitted to its
floor.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np
from numpy.typing import NDArray

import stereovox as sv
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.se3 import look_at
from stereovox.simulate.d435 import D435, depth_camera
from stereovox.simulate.honest import honest_d435, honest_kinect
from stereovox.simulate.scene import Scene, Solid, box, cylinder
from stereovox.simulate.simulation import Simulation

BAND = (0.1, 1.8)
MARGIN = 0.005
"""Metres by which an obstacle must reach into the band."""
PLACES = (np.arange(4) + 0.5) / 4
Height = Callable[[NDArray], NDArray]


@dataclass(frozen=True, eq=False)
class World:
    """A scene whose floor lies at `floor(x)` metres, and the camera's poses in it."""

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
    """Map a world in a frame whose origin is where the camera began; return the map and that origin."""
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
    """Columns of obstacles and of free floor that count, and how many of each the grid calls free."""

    obstacles: int
    called_free: int
    floor: int
    stays_free: int

    def __add__(self, other: Score) -> Score:
        return Score(*(a + b for a, b in zip(vars(self).values(), vars(other).values(), strict=True)))

    def __str__(self) -> str:
        wrong, right = self.called_free / max(self.obstacles, 1), self.stays_free / max(self.floor, 1)
        return (
            f"{self.called_free:6} of {self.obstacles:6} obstacles free ({wrong:6.2%}), "
            f"{self.stays_free:6} of {self.floor:6} of the floor ({right:5.1%})"
        )


@dataclass(frozen=True, eq=False)
class Truth:
    """Middles (N, 2) of the columns in metres of the map, and which count as obstacles, and as free floor."""

    places: NDArray
    obstacles: NDArray
    floor: NDArray


def truth_of(voxel_map: sv.VoxelMap, world: World, origin: NDArray) -> Truth:
    """Return what the columns of a map of a world truly are, as far as the map knows anything of them."""
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
            obstacle[near] |= (bottom < base + BAND[1]) & (top > base + BAND[0] + MARGIN) & (bottom < top)
            inside[near] |= (solid.part == "floor") & (bottom < top)
    middle = (columns + 0.5) * side
    base = world.floor(middle[:, 0] + origin[0]) - origin[2]
    known, seen_floor = np.zeros(len(columns), bool), np.zeros(len(columns), bool)
    for above in np.arange(BAND[0] + side / 2, BAND[1], side):
        known |= voxel_map.state(np.column_stack([middle, base + above])) != sv.State.UNKNOWN
    for above in (-side, 0, side):
        seen_floor |= voxel_map.state(np.column_stack([middle, base + above])) == sv.State.OCCUPIED
    return Truth(middle, obstacle & known & inside, ~obstacle & seen_floor & inside)


def score(grid: OccupancyGrid, truth: Truth) -> Score:
    """Count what a grid calls free."""
    free = _state(grid, truth.places) == sv.State.FREE
    return Score(*(int(np.count_nonzero(which)) for which in
                   (truth.obstacles, truth.obstacles & free, truth.floor, truth.floor & free)))  # fmt: skip


def _through(solid: Solid, x: NDArray, y: NDArray) -> tuple[NDArray, NDArray]:
    """Return where vertical lines enter and leave a convex solid; bottom above top where they miss it."""
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


def worlds(seeds: int) -> Iterator[tuple[World, str, float, int]]:
    """All scenes with camera, cell side and seed."""
    for seed in range(seeds):
        camera, eye = ("simple", "d435", "kinect")[seed % 3], (1.3, 0.45, 0.8)[seed % 3]
        yield furnished("level", flat, [], seed, eye, 120), camera, 0.05, seed
        yield furnished("ramp of 10 degrees", ramp(0.176), [2.0, 8.0], seed, eye, 120), camera, 0.05, seed
        yield furnished("step of 0.08 m", step(0.08), [4.0], seed, eye, 120), camera, 0.05, seed
        yield furnished("step of 0.3 m", step(0.3), [4.0], seed, eye, 120), camera, 0.05, seed
