# SPDX-License-Identifier: Apache-2.0
"""`sim:flight`: kilometres along a hall and back, cheap enough to render a whole flight.

Poses of a simulation that drift like a tracker's. A person walks from waypoint to waypoint with a camera in the hand.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from stereovox.geometry.se3 import Transform, inverse, look_at, rotation_matrix
from stereovox.simulate.d435 import D435, depth_camera
from stereovox.simulate.scene import Scene, Solid, box
from stereovox.simulate.stage import Stage, within
from stereovox.simulate.t265 import OPENGL, STEP_S, Drift, drifted, start_frame

LANE = 2.0
"""Metres between the hall's middle and the path, on the right both ways; also the radius of the turn at the end."""
HALF, HEIGHT = 5.0, 4.6
"""Half width and height of the hall."""
BAY = 8.0
"""Length of one bay: pillars, walls that step in and out, boxes on the floor and a beam."""
BEHIND, BEYOND = 6.0, 12.0
"""Metres of hall behind the start and beyond the turn."""
THICKNESS = 0.2
SEED = 0
"""Seed of the hall's bays."""
IMAGE_WIDTH = 212
"""Pixels across: a frame takes 5 ms."""


def stage(*, length: float = 2000.0, speed: float = 5.0) -> Stage:
    """Return a hall and a flight of `length` metres at `speed` m/s: half of it out, a U-turn, and back.

    Bays are statistically alike, but no two are equal. Images are 212 pixels wide, 30 a second.
    World: z up, x along the hall, origin on the floor in the hall's middle where the flight starts.
    Parts: `floor`, `ceiling`, `walls`, `pillars`, `boxes`, `beams`. Raises SourceError for values out of range.
    """
    within("length", length, 20, 50_000)
    within("speed", speed, 0.1, 50)
    straight = (length - math.pi * LANE) / 2

    def path(share: float) -> Transform:
        return _on_track(share * length, straight)

    def build() -> Scene:
        return Scene(_hall(straight + BEYOND, np.random.default_rng(SEED)))

    device = D435(camera=depth_camera(IMAGE_WIDTH))
    return Stage(build, path, round(length / speed * 30) + 1, device=device)


def _on_track(travelled: float, straight: float) -> Transform:
    """Return T_world_camera after this many metres: out on the right, half a circle to the left, back on the right."""
    if travelled <= straight:
        x, y, yaw = travelled, -LANE, 0.0
    else:
        yaw = min((travelled - straight) / LANE, math.pi)
        x, y = straight + LANE * math.sin(yaw), -LANE * math.cos(yaw)
        x -= max(travelled - straight - math.pi * LANE, 0.0)
    eye = np.array([x, y, 1.6 + 0.3 * math.sin(x / 7)])
    return look_at(eye, eye + np.array([math.cos(yaw), math.sin(yaw), 0]))


def _hall(end: float, random: np.random.Generator) -> list[Solid]:
    bays = math.ceil((BEHIND + end) / BAY)
    solids = [solid for n in range(bays) for solid in _bay(f"bay {n}", BAY * n - BEHIND, random)]
    return [
        *solids,
        box("walls", "start", (-BEHIND - THICKNESS, -HALF, 0), (-BEHIND, HALF, HEIGHT)),
        box("walls", "end", (BAY * bays - BEHIND, -HALF, 0), (BAY * bays - BEHIND + THICKNESS, HALF, HEIGHT)),
    ]


def _bay(name: str, x: float, random: np.random.Generator) -> list[Solid]:
    """Return one bay of the hall, which starts at `x`."""
    t, end = THICKNESS, x + BAY
    beam = x + random.uniform(1, BAY - 1)
    solids = [
        box("floor", f"{name}: floor", (x, -HALF - t, -t), (end, HALF + t, 0)),
        box("ceiling", f"{name}: ceiling", (x, -HALF - t, HEIGHT), (end, HALF + t, HEIGHT + t)),
        box("beams", f"{name}: beam", (beam, -HALF, HEIGHT - 0.4), (beam + 0.3, HALF, HEIGHT)),
    ]
    for side, sign in (("left", 1.0), ("right", -1.0)):
        solids += _side(f"{name}, {side}", x, sign, random)
    return solids


def _side(name: str, x: float, sign: float, random: np.random.Generator) -> list[Solid]:
    """Return wall, pillar and box of one side; `sign` is 1 on the left, -1 on the right."""

    def part(kind: str, start: float, long: float, inner: float, outer: float, top: float) -> Solid:
        y0, y1 = sorted((sign * inner, sign * outer))
        return box(kind, f"{name}: {kind}", (x + start, y0, 0), (x + start + long, y1, top))

    pillar, thing = random.uniform(0.5, 3.0), random.uniform(4.0, BAY - 1.6)
    inner, step = random.uniform(3.3, 4.0), random.uniform(0, 0.6)
    deep, top = random.uniform(0.3, 0.7), random.uniform(0.4, 1.6)
    return [
        part("walls", 0, BAY, HALF - step, HALF + THICKNESS, HEIGHT),
        part("pillars", pillar, 0.35, 3.6, 3.95, HEIGHT),
        part("boxes", thing, random.uniform(0.4, 1.4), inner, inner + deep, top),
    ]


YAW_DEG = 5.0
"""Degrees of heading drift over one metre if positions drift by one metre a metre: a tracker that is off
by 1 % turns by 0.05 degrees (see `Drift`)."""

CameraPath = Callable[[float], Transform]
"""T_world_camera (4, 4), optical axes, at a share of the path, 0 to 1."""


def drifting(path: CameraPath, seconds: float, share: float, random: np.random.Generator) -> CameraPath:
    """Return the path as reported by a tracker that never recognises a place.

    path: the true one, world z up; it takes `seconds`. share: metres of error per metre travelled, in all directions;
    the heading drifts too (`YAW_DEG`), roll and pitch stay right. The first pose is true, and errors belong to
    positions on the path, not to images: they are the same for any number of frames. Raises StereovoxError if the first
    pose has no heading.
    """
    shares = np.linspace(0, 1, max(2, math.ceil(seconds / STEP_S) + 1))
    true = np.array([path(step) for step in shares.tolist()])
    T_start_world = start_frame(true[0])
    drift = Drift(share=share, yaw_deg=YAW_DEG * share, find_again_m=0)
    poses = T_start_world @ true @ OPENGL
    shift, yaw = drifted(drift, shares * seconds, poses, np.zeros(len(shares)), random)
    errors = np.column_stack([shift, yaw])

    def reported(share: float) -> Transform:
        x, y, z, turn = (np.interp(share, shares, column) for column in errors.T)
        T = T_start_world @ path(share)
        T[:3, :3] = rotation_matrix([0, turn, 0]) @ T[:3, :3]
        T[:3, 3] += x, y, z
        return inverse(T_start_world) @ T

    return reported


TURN_DEG = 70.0
"""Degrees a second at which the camera turns."""
EYE, PITCH_DEG = 1.35, -9.0
"""Height above the floor in metres; downward pitch of the camera in degrees while walking."""


def walk(
    waypoints: NDArray[np.float64], speed: float, turn_deg: float = TURN_DEG
) -> tuple[Callable[[float], Transform], float]:
    """Return the path (T_world_camera at a share of it) and its duration in seconds at `speed` m/s.

    waypoints: (N, 3) x and y in metres and yaw in degrees (0: along x, 90: along y; never a jump from 180 to -180).
    Between two of them the camera walks and turns (`turn_deg` a second) at once; the slower of both sets the time,
    and it never leaves the rectangle between them. Floor at z = 0. The first image is exactly level.
    """
    from scipy.interpolate import PchipInterpolator

    times = _times(waypoints, speed, turn_deg)
    way = PchipInterpolator(times, waypoints)  # no overshoot: it would walk into walls

    def path(share: float) -> Transform:
        seconds = share * times[-1]
        x, y, yaw_deg = way(seconds)
        return _held(np.array([x, y, EYE]), np.radians(yaw_deg), seconds)

    return path, float(times[-1])


def _times(waypoints: NDArray[np.float64], speed: float, turn_deg: float) -> NDArray[np.float64]:
    """Return the second (N,) at which each waypoint is reached."""
    steps = np.diff(waypoints, axis=0)
    walking = np.linalg.norm(steps[:, :2], axis=1) / speed
    turning = np.abs(steps[:, 2]) / turn_deg
    return np.append(0.0, np.cumsum(np.maximum(walking, turning)))


def _held(eye: NDArray[np.float64], yaw: float, seconds: float) -> Transform:
    """Return T_world_camera of a hand-held camera: it bobs with the steps, sways and tilts slightly down."""
    beat = 2 * np.pi * seconds
    eye = eye + np.array([0, 0, 0.012 * np.sin(1.8 * beat)])
    pitch = np.radians(PITCH_DEG * (1 - np.exp(-seconds)) + 1.5 * np.sin(0.7 * beat))
    roll = np.radians(1.2 * np.sin(0.9 * beat))
    ahead = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    T = look_at(eye, eye + ahead)
    T[:3, :3] = T[:3, :3] @ rotation_matrix([0, 0, roll])
    return T
