# SPDX-License-Identifier: Apache-2.0
"""Lasting faults and changes of the world: which does a mapper accept, and how soon?

A camera, or a lidar, walks once round a random hall (`sim:hall`) and maps it. On its second round either its images are
bad for a number of seconds, or the world has changed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.frame import Cloud, Frame
from stereovox.mapper import Mapper
from stereovox.maps import State, VoxelMap
from stereovox.maps.files.loading import load_map
from stereovox.sensors.noise import SUBPIXEL
from stereovox.simulate.d435 import CAMERA, D435, depth_camera
from stereovox.simulate.scene import Scene, Solid, box, cylinder
from stereovox.simulate.scenes import hall
from stereovox_lab.checks.bad_images import SURE, displaced

HZ, MAP_HZ, LAP_S = 10, 5, 40.0
"""Frames a second, frames a second in the first round, and duration of a round."""
IMAGE_WIDTH = 160
RINGS, TURN = np.radians(np.linspace(-15, 15, 16)), np.radians(np.arange(0, 360, 2.0))
"""Elevations and azimuths of the lidar's beams."""
LIDAR_SIGMA = 0.02
Depth = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Walk:
    """A hall, a path round it, and what a camera (or a lidar, `cloud`) sees. seed: plan of the hall, and noise."""

    seed: int
    cloud: bool = False

    @cached_property
    def stage(self) -> Any:
        """The hall and the path."""
        return hall.stage(plan=self.seed)

    @cached_property
    def device(self) -> D435:
        """The camera."""
        subpixel = SUBPIXEL * IMAGE_WIDTH / CAMERA.width  # as noisy in metres as the real one
        return D435(replace(depth_camera(IMAGE_WIDTH), subpixel=subpixel), subpixel)

    def frames(self, start_s: float, seconds: float, hz: float, world: Callable[[float], Scene]) -> list[Any]:
        """Return frames from `start_s` on, of `world` at each time."""
        times = start_s + np.arange(round(seconds * hz)) / hz
        return [self.frame(float(time), world(float(time))) for time in times]

    def frame(self, time_s: float, scene: Scene) -> Any:
        """Return the frame at one time of the walk."""
        T = self.stage.path(time_s / LAP_S % 1.0)
        number = round(time_s * 1000)
        if self.cloud:
            T = T.copy()
            T[:3, :3] = T[:3, :3] @ np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0.0]])
            points = _beams() * scene.cast(T[:3, 3], _beams() @ T[:3, :3].T)[:, None]
            noise = np.random.default_rng([self.seed, number]).normal(0, LIDAR_SIGMA, (len(points), 1))
            noisy = points * (1 + noise / np.linalg.norm(points, axis=1)[:, None])
            return Cloud(noisy.astype(np.float32), T, number * 10**6)
        x, y = self.device.camera.ray_slopes()
        rays = np.stack(np.broadcast_arrays(x[None, :], y[:, None], np.float32(1)), axis=-1)
        truth = scene.cast(T[:3, 3], rays.reshape(-1, 3) @ T[:3, :3].T.astype(np.float32)).reshape(rays.shape[:2])
        depth, reason = self.device.measure(truth, [self.seed, number])
        metres = np.where(depth > 0, depth * np.float32(0.001), 0).astype(np.float32)
        return Frame(metres, self.device.camera, T, number * 10**6, 1.0, reason)


def _beams() -> NDArray[np.float32]:
    up, round_ = (angle.ravel() for angle in np.meshgrid(RINGS, TURN, indexing="ij"))
    return np.stack([np.cos(up) * np.cos(round_), np.cos(up) * np.sin(round_), np.sin(up)], axis=1).astype(np.float32)


Fault = Callable[[Any, int, "Bad"], Any]


@dataclass(frozen=True, eq=False)
class Bad:
    """Inputs of faults: good frames from the first spoilt one on, frames of another place, random numbers."""

    good: Sequence[Any]
    elsewhere: Sequence[Any]
    random: np.random.Generator


def _depth(change: Callable[[Depth, np.random.Generator], Depth]) -> Fault:
    """Return a fault that changes the depths, or the ranges of a cloud in the order of its beams."""

    def spoil(frame: Any, i: int, bad: Bad) -> Any:
        if isinstance(frame, Frame):
            seen = change(np.asarray(frame.depth, np.float32), bad.random)
            return replace(frame, depth=np.ascontiguousarray(seen, np.float32), reason=None)
        ranges = np.linalg.norm(frame.points, axis=1).reshape(len(RINGS), len(TURN))[::-1].astype(np.float32)
        ranges[~np.isfinite(ranges)] = 0
        seen = change(ranges, bad.random)[::-1].reshape(-1, 1)
        return replace(frame, points=np.where(seen > 0, _beams() * seen, np.nan).astype(np.float32))

    return spoil


def _scaled(times: float) -> Fault:
    return _depth(lambda depth, _: depth * np.float32(times))


def _where_seen(change: Callable[[Depth], Depth]) -> Fault:
    return _depth(lambda depth, _: np.where(depth > 0, change(depth), 0))


def _blocks(depth: Depth, random: np.random.Generator) -> Depth:
    """Add eight random blocks at random depths, covering about a third of the view."""
    depth = depth.copy()
    h, w = depth.shape
    for _ in range(8):
        v, u = int(random.integers(0, h - h // 4)), int(random.integers(0, w - w // 5))
        depth[v : v + h // 4, u : u + w // 5] = random.uniform(0.4, 6)
    return depth


def _static_blocks(depth: Depth, _: np.random.Generator) -> Depth:
    return _blocks(depth, np.random.default_rng(5))


def _half_near(depth: Depth, random: np.random.Generator) -> Depth:
    left = np.arange(depth.shape[1]) < depth.shape[1] // 2
    return np.where(left, 0.5 + 0.01 * random.standard_normal(depth.shape), depth).astype(np.float32)


def _noisy(depth: Depth, random: np.random.Generator) -> Depth:
    return (depth * (1 + 0.2 * random.standard_normal(depth.shape))).astype(np.float32)


def _plane(metres: float) -> Fault:
    return _depth(lambda depth, random: (metres + 0.003 * random.standard_normal(depth.shape)).astype(np.float32))


def _longer(frame: Any, i: int, bad: Bad) -> Any:
    if isinstance(frame, Cloud):  # the angles of the beams are wrong
        return replace(frame, points=frame.points * np.array([1, 1, 1.5], np.float32))
    camera = replace(frame.camera, fx=1.3 * frame.camera.fx, fy=1.3 * frame.camera.fy)
    return replace(frame, camera=camera)


def _of_another(pick: Callable[[int, Bad], Any], sigma: float) -> Fault:
    def spoil(frame: Any, i: int, bad: Bad) -> Any:
        other = pick(i, bad)
        if isinstance(frame, Cloud):
            noise = 1 + sigma * bad.random.standard_normal((len(other.points), 1))
            return replace(frame, points=(other.points * noise).astype(np.float32))
        noise = 1 + sigma * bad.random.standard_normal(other.depth.shape)
        return replace(frame, depth=(other.depth * noise).astype(np.float32), reason=other.reason)

    return spoil


def _knocked(frame: Any, i: int, bad: Bad) -> Any:
    return displaced(frame, np.array([0.2, 0, 0]), np.radians([0, 5, 0]))


FAULTS: dict[str, Fault] = {
    **{f"depth x {times:g}": _scaled(times) for times in (0.5, 0.8, 1.2, 2)},
    "upside down": _depth(lambda depth, _: depth[::-1]),
    "mirrored": _depth(lambda depth, _: depth[:, ::-1]),
    "turned by 180 deg": _depth(lambda depth, _: depth[::-1, ::-1]),
    "plane at 0.5 m": _plane(0.5),
    "plane at 1 m": _plane(1.0),
    "moving blocks": _depth(_blocks),
    "static blocks": _depth(_static_blocks),
    "focal length x 1.3": _longer,
    "shifted by a quarter": _depth(lambda depth, _: np.roll(depth, depth.shape[1] // 4, 1)),
    "rolled rows": _depth(lambda depth, _: np.roll(depth, depth.shape[0] // 3, 0)),
    "frozen, with noise": _of_another(lambda i, bad: bad.good[0], 0.002),
    "of another place": _of_another(lambda i, bad: bad.elsewhere[i], 0.0),
    "cut at 2 m": _where_seen(lambda depth: np.minimum(depth, np.float32(2))),
    "steps of 0.5 m": _where_seen(lambda depth: np.maximum(np.rint(2 * depth) / 2, 0.5).astype(np.float32)),
    "noise of 20 %": _depth(_noisy),
    "0.3 m too far": _where_seen(lambda depth: depth + np.float32(0.3)),
    "half at 0.5 m": _depth(_half_near),
    "knocked camera": _knocked,
}
"""Faults of one frame, given its number since the fault began."""


def _changed(kind: str, seed: int) -> Callable[[float], Scene]:
    """Return a function from time in seconds to the changed world of a kind."""
    stage, random = hall.stage(plan=seed), np.random.default_rng([31, seed])
    solids, start = stage.build().solids, LAP_S

    def shifted(solid: Solid) -> Solid:
        angle, far = random.uniform(0, 2 * np.pi), random.uniform(0.6, 1.5)
        return Solid(solid.part, solid.name, solid.triangles + far * np.array([np.cos(angle), np.sin(angle), 0]))

    things = {"boxes", "half walls", "posts"}
    if kind == "furniture moved":
        return _always(Scene([shifted(solid) if solid.part in things else solid for solid in solids]))
    if kind == "nothing":
        return _always(Scene(solids))
    if kind == "furniture gone":
        return _always(Scene([solid for solid in solids if solid.part not in things]))
    if kind == "furniture came":
        return _always(Scene([*solids, *_cabinets(stage, random)]))
    if kind in ("wall removed", "door opened", "door closed"):
        return _always(_with_room(solids, kind))
    at = stage.path((start + 6.0) / LAP_S % 1.0)
    eye, ahead = at[:3, 3], at[:3, 2] / np.linalg.norm(at[:2, 2])
    side = np.array([-ahead[1], ahead[0], 0.0])

    def with_person(time_s: float) -> Scene:
        step = 0.0 if kind == "person standing" else 1.2 * np.sin(1.0 * (time_s - start))
        x, y = (eye + 1.6 * ahead + step * side)[:2]
        return Scene([*solids, cylinder("person", "person", (x, y, 0.0), (x, y, 1.75), 0.45, sections=16)])

    return with_person


def _always(scene: Scene) -> Callable[[float], Scene]:
    return lambda _: scene


def _cabinets(stage: Any, random: np.random.Generator) -> Iterator[Solid]:
    for n, share in enumerate(np.arange(0.1, 1, 0.2)):
        T = stage.path(share)
        x, y = (T[:3, 3] + 1.8 * T[:3, 2])[:2]
        a, b = random.uniform(0.3, 0.7, 2)
        yield box("cabinets", f"cabinet {n}", (x - a, y - b, 0), (x + a, y + b, 1.9), random.uniform(0, 1))


def _with_room(solids: Sequence[Solid], kind: str) -> Scene:
    """Return the hall with its east wall gone, or with a door of 1.4 m in it, and a room behind."""
    wall = next(solid for solid in solids if solid.name == "east wall")
    others = [solid for solid in solids if solid.name != "east wall"]
    (x0, y0, z0), (x1, y1, z1) = wall.bounds
    behind = [
        box("walls", "behind", (x1 + 3, y0, z0), (x1 + 3.2, y1, z1)),
        box("floor", "floor behind", (x1, y0, z0 - 0.2), (x1 + 3.2, y1, z0)),
        box("ceiling", "ceiling behind", (x1, y0, z1), (x1 + 3.2, y1, z1 + 0.2)),
        box("walls", "behind, left", (x1, y1, z0), (x1 + 3.2, y1 + 0.2, z1)),
        box("walls", "behind, right", (x1, y0 - 0.2, z0), (x1 + 3.2, y0, z1)),
    ]
    if kind == "wall removed":
        return Scene([*others, *behind])
    parts = [box("walls", f"wall {n}", (x0, a, z0), (x1, b, z1)) for n, (a, b) in enumerate(((y0, -0.7), (0.7, y1)))]
    leaf = [box("walls", "leaf", (x0, -0.7, z0), (x1, 0.7, z1))] if kind == "door closed" else []
    return Scene([*others, *behind, *parts, *leaf])


CHANGES = (
    "nothing", "furniture moved", "furniture gone", "furniture came", "wall removed", "door opened", "door closed",
    "person standing", "person walking", "other building",
)  # fmt: skip


@dataclass(frozen=True)
class Lasted:
    """The effect of a fault: accepted frames, and wrong cells, after each number of seconds.

    sure: certainly occupied cells before it. accepted, freed, changed: by seconds: accepted frames; certainly occupied
    cells now free, and certainly known cells in another state, beyond the changes by good frames. reasons: of refusals.
    late: good frames refused after it.
    """

    sure: int
    accepted: dict[float, int]
    freed: dict[float, int]
    changed: dict[float, int]
    reasons: dict[str, int]
    late: int


class Trial:
    """One hall, mapped on a first round; faults and changes start from that map. settings: of the mapper."""

    def __init__(self, seed: int, cloud: bool = False, **settings: Any):
        self.walk = Walk(seed, cloud)
        self.settings: dict[str, Any] = {"voxel_size": 0.1, "max_range": 5.0, **settings}
        self._hall = _always(self.walk.stage.build())
        mapper = Mapper(**self.settings)
        refused = [mapper.add(frame).refused for frame in self.walk.frames(0, LAP_S, MAP_HZ, self._hall)]
        self.refused = Counter(why for why in refused if why)
        self._folder = TemporaryDirectory()
        mapper.save(Path(self._folder.name) / "map")
        points = mapper.map.centers(mapper.map.cells()[0])
        sure = np.abs(mapper.map.log_odds(points)) >= SURE
        self.points, self.before = points[sure], mapper.map.state(points[sure])

    def mapper(self, **settings: Any) -> Mapper:
        """Return a mapper that continues the map of the first round."""
        return Mapper(**{**self.settings, **settings}, resume=load_map(Path(self._folder.name) / "map"))

    @cached_property
    def good(self) -> list[Any]:
        """Good frames of the second round: one second, and enough for a fault of 20 s and the time after it."""
        return self.walk.frames(LAP_S, 24, HZ, self._hall)

    @cached_property
    def elsewhere(self) -> list[Any]:
        """Good frames from the other side of the hall."""
        return self.walk.frames(1.5 * LAP_S, 24, HZ, self._hall)

    def fault(self, kind: str, seconds: Sequence[float] = (1, 4, 20)) -> Lasted:
        """Return the effect of a fault that lasts the longest of `seconds`, and of two good seconds after it."""
        first, last = HZ, HZ + round(max(seconds) * HZ)
        bad = Bad(self.good[first:], self.elsewhere, np.random.default_rng([self.walk.seed, 7]))
        mapper, control = self.mapper(), self.mapper()
        accepted, freed, changed, taken, reasons, late = {}, {}, {}, 0, Counter[str](), 0
        begin = self.before
        for i, frame in enumerate(self.good[: last + 2 * HZ]):
            begin = mapper.map.state(self.points) if i == first else begin
            seen = FAULTS[kind](frame, i - first, bad) if first <= i < last else frame
            refused = mapper.add(seen).refused
            control.add(frame)
            if first <= i < last:
                taken += refused is None
                reasons.update([refused] if refused else [])
            late += i >= last and refused is not None
            for duration in seconds:
                if i + 1 == first + round(duration * HZ):
                    accepted[duration] = taken
                    freed[duration], changed[duration] = self._wrong(begin, mapper.map, control.map)
        return Lasted(int((self.before == State.OCCUPIED).sum()), accepted, freed, changed, dict(reasons), late)

    def change(self, kind: str, seconds: float = LAP_S) -> dict[str, Any]:
        """Return the effect of a world that has changed on the second round.

        refused: frames, by reason; longest_s: of refusals without an accepted frame between; taken: of the cells that a
        mapper without the comparison changes between free and occupied, the number changed in this map; wrong: the
        number of these that are free although occupied.
        """
        mapper, control = self.mapper(), self.mapper(**{"trust.max_disagreement": 1})
        refused: list[str | None] = []
        for frame in self._second_round(kind, seconds):
            refused.append(mapper.add(frame).refused)
            control.add(frame)
        ours, theirs = mapper.map.state(self.points), control.map.state(self.points)
        sure = np.isin(self.before, (State.FREE, State.OCCUPIED)) & np.isin(theirs, (State.FREE, State.OCCUPIED))
        other = sure & (theirs != self.before)
        return {
            "frames": len(refused),
            "refused": dict(Counter(why for why in refused if why)),
            "longest_s": _longest(refused) / HZ,
            "cells": int(other.sum()),
            "taken": float((ours[other] == theirs[other]).mean()) if other.any() else 1.0,
            "still free": int((other & (theirs == State.OCCUPIED) & (ours == State.FREE)).sum()),
        }

    def _second_round(self, kind: str, seconds: float) -> list[Any]:
        if kind != "other building":
            return self.walk.frames(LAP_S, seconds, HZ, _changed(kind, self.walk.seed))
        other = Walk(self.walk.seed + 1000, self.walk.cloud)  # its poses continue from the camera's last one
        frames = other.frames(LAP_S, seconds, HZ, _always(other.stage.build()))
        begin = self.walk.frame(LAP_S, self._hall(0)).T_world_sensor @ np.linalg.inv(frames[0].T_world_sensor)
        return [replace(frame, T_world_sensor=begin @ frame.T_world_sensor) for frame in frames]

    def _wrong(self, begin: NDArray[np.uint8], found: VoxelMap, control: VoxelMap) -> tuple[int, int]:
        ours, theirs = found.state(self.points), control.state(self.points)
        freed = (begin == State.OCCUPIED) & (ours == State.FREE) & (theirs != State.FREE)
        return int(freed.sum()), int(((ours != begin) & (ours != theirs)).sum())


def _longest(refused: Sequence[str | None]) -> int:
    longest = now = 0
    for why in refused:
        now = now + 1 if why else 0
        longest = max(longest, now)
    return longest
