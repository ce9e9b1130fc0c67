# SPDX-License-Identifier: Apache-2.0
"""One flight of a simulated quadrotor by random sticks: camera, growing map, sectors, PX4's collision prevention."""

from __future__ import annotations

from collections import deque
from dataclasses import asdict, dataclass, field
from math import inf
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import SourceError
from stereovox.geometry.se3 import Transform, rotation_matrix
from stereovox.mapper import Mapper
from stereovox.mavlink.sectors import SectorRules, obstacle_sectors
from stereovox.simulate.simulation import Simulation
from stereovox_lab.flights.clearance import Clearance
from stereovox_lab.flights.px4 import CollisionPrevention, Parameters
from stereovox_lab.flights.quadrotor import Airframe, Quadrotor

STEP_S = 0.02
"""Time step of the simulation: the autopilot's controller runs at 50 Hz."""
HEIGHTS = (0.9, 1.6)
"""Range in metres from which each flight's height is drawn."""
START_ROOM = 0.75
"""Metres around the start that are free: a pilot ensures that."""
TURN_S = 8.0
"""Seconds of the turn in place at the start of a flight."""
CEILING = 4.0
"""A start has surfaces above and below it within this many metres."""


@dataclass(frozen=True)
class Setup:
    """Settings of a flight.

    Attributes:
        scene: Simulation, with the camera's noise; `{seed}` in it is replaced by the flight's seed.
        seconds: Length of the flight, after the turn in place.
        prevention: Whether the autopilot prevents collisions; else it obeys the sticks.
        speed: Largest speed commanded by the sticks, m/s.
        voxel_size: Of the map, metres.
        camera_hz: Images a second.
        delay_s: Delay from the image to the map.
        rate_hz: OBSTACLE_DISTANCE messages a second.
        max_age_s: Age in seconds of the last frame in the map above which none is sent.
        pose_sigma: Standard deviations of each pose's independent error: metres, radians.
        rules: Rules of the sectors.
        parameters: Parameters of the autopilot.
        airframe: The quadrotor.
    """

    scene: str = "sim:hall?plan={seed}"
    seconds: float = 40.0
    prevention: bool = True
    speed: float = 1.5
    voxel_size: float = 0.1
    camera_hz: float = 15.0
    delay_s: float = 0.06
    rate_hz: float = 10.0
    max_age_s: float = 0.5
    pose_sigma: tuple[float, float] = (0.0, 0.0)
    rules: SectorRules = field(default_factory=lambda: SectorRules(own_radius=0.75))
    parameters: Parameters = field(default_factory=Parameters)
    airframe: Airframe = field(default_factory=Airframe)


@dataclass(frozen=True)
class Flight:
    """The result of a flight.

    Attributes:
        seed: Seed of start, sticks and noise.
        collided_s: Time in seconds of a propeller's contact; None: no contact.
        seconds: Length of the flight, up to the collision.
        metres: Distance flown.
        asked_m: Distance commanded by the sticks.
        clearance_m: Least distance between its middle and a surface.
        top_speed: m/s.
        refused: Number of refused frames.
        frames: Number of frames in the map.
    """

    seed: int
    collided_s: float | None
    seconds: float
    metres: float
    asked_m: float
    clearance_m: float
    top_speed: float
    refused: int
    frames: int

    def as_dict(self) -> dict[str, Any]:
        """Return all values as plain types for JSON."""
        return asdict(self)


class World:
    """A scene, built once for all its flights."""

    def __init__(self, scene: str):
        self.camera = Simulation(scene)
        self.clearance = Clearance(self.camera.scene)
        corners = self.camera.scene.triangles.reshape(-1, 3)
        self._low, self._high = corners.min(axis=0), corners.max(axis=0)

    def start(self, random: np.random.Generator) -> NDArray[np.float64]:
        """Return a place (3,) with room around it; raises SourceError if a scene has none."""
        for _ in range(10_000):
            place = random.uniform(self._low, self._high)
            place[2] = random.uniform(*HEIGHTS)
            if self.clearance.at(place, START_ROOM) >= START_ROOM and self._inside(place):
                return place
        raise SourceError(f"{self.camera.name} has no place with {START_ROOM} m of room; choose another scene")

    def _inside(self, place: NDArray[np.float64]) -> bool:
        """Return whether there is a floor and a ceiling, seen from the right side, and walls all around."""
        angles = np.radians(np.arange(0, 360, 15))
        around = np.column_stack([np.cos(angles), np.sin(angles), 0 * angles])
        directions = np.vstack([[[0, 0, -1.0], [0, 0, 1.0]], around]).astype(np.float32)
        away, normals, _ = self.camera.scene.hits(place, directions)
        facing = (normals * directions).sum(axis=1) < 0
        return bool(facing.all() and (away[:2] < CEILING).all())


class Sticks:
    """A pilot's stick inputs: a new command every second or two, mostly ahead, sometimes in any direction."""

    def __init__(self, random: np.random.Generator, speed: float):
        self._random, self._speed, self._until = random, speed, 0.0
        self.forward = self.left = self.yaw_rate = 0.0

    def at(self, seconds: float, yaw: float) -> tuple[NDArray[np.float64], float]:
        """Return the commanded velocity (2,) in the world, and yaw rate."""
        if seconds < TURN_S:
            return np.zeros(2), 2 * np.pi / TURN_S
        if seconds >= self._until:
            self._until = seconds + self._random.uniform(0.8, 3.0)
            anywhere = self._random.random() < 0.3
            angle = self._random.uniform(-np.pi, np.pi) if anywhere else self._random.normal(0, 0.3)
            speed = self._speed * self._random.uniform(0.3, 1.0)
            self.forward, self.left = speed * np.cos(angle), speed * np.sin(angle)
            self.yaw_rate = self._random.choice([0.0, self._random.normal(0, 0.8)])
        ahead, left = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
        return self.forward * ahead + self.left * left, float(self.yaw_rate)


def fly(seed: int, setup: Setup | None = None, world: World | None = None) -> Flight:
    """Fly once.

    Args:
        seed: Seed of start, sticks and noise; the same with and without prevention.
        setup: Settings; by default `Setup()`.
        world: The scene, if already built.

    Returns:
        The result.
    """
    setup = setup or Setup()
    world = world or World(setup.scene.format(seed=seed))
    return _Loop(seed, setup, world).run()


class _Loop:
    """The parts of a flight and the times at which they act."""

    def __init__(self, seed: int, setup: Setup, world: World):
        self._seed, self._setup, self._world = seed, setup, world
        draw = np.random.default_rng([seed, 1])
        place = world.start(draw)
        self._quad = Quadrotor(place, draw.uniform(-np.pi, np.pi), setup.airframe)
        self._height, self._sticks = float(place[2]), Sticks(np.random.default_rng([seed, 2]), setup.speed)
        self._errors = np.random.default_rng([seed, 3])
        self._mapper = Mapper("default", voxel_size=setup.voxel_size)
        self._autopilot = CollisionPrevention(setup.parameters)
        self._under_way: deque[tuple[float, int, Transform]] = deque()
        self._pose: Transform | None = None
        self._accepted = -inf
        self._frames = self._refused = 0
        self._metres = self._asked = self._top = 0.0
        self._least = inf

    def run(self) -> Flight:
        """Fly until the end or a collision."""
        setup, now, image, message = self._setup, 0.0, 0.0, 0.0
        steps, collided = round((TURN_S + setup.seconds) / STEP_S), None
        for step in range(steps):
            now = step * STEP_S
            if setup.prevention and now >= image:
                self._under_way.append((now, len(self._under_way), self._quad.T_world_body))
                image += 1 / setup.camera_hz
            self._map(now)
            if now >= message:
                self._tell(now)
                message += 1 / setup.rate_hz
            collided = self._move(now)
            if collided is not None:
                break
        flown = max(now + STEP_S - TURN_S, 0.0)
        return Flight(
            self._seed, collided, flown, self._metres, self._asked, self._least, self._top, self._refused, self._frames
        )

    def _map(self, now: float) -> None:
        """Add images to the map whose delay has passed."""
        while self._under_way and now >= self._under_way[0][0] + self._setup.delay_s:
            taken, _, T = self._under_way.popleft()
            number = self._frames + self._refused
            frame = self._world.camera.frame_from(
                T, self._seed * 1_000_000 + number, round(1e9 * taken), self._reported(T)
            )
            if self._mapper.add(frame).refused is None:
                self._frames, self._pose, self._accepted = self._frames + 1, frame.T_world_sensor, now
            else:
                self._refused += 1

    def _reported(self, T: Transform) -> Transform:
        metres, radians = self._setup.pose_sigma
        wrong = T.copy()
        wrong[:3, :3] = T[:3, :3] @ rotation_matrix(self._errors.normal(0, radians, 3))
        wrong[:3, 3] += self._errors.normal(0, metres, 3)
        return wrong

    def _tell(self, now: float) -> None:
        """Send sectors as `ObstacleSender` does: for the pose of the last frame, and none once that is too old."""
        if self._pose is not None and now - self._accepted <= self._setup.max_age_s:
            rules = self._setup.rules
            cm = obstacle_sectors(self._mapper.map, self._pose, rules).centimetres(rules)
            self._autopilot.receive(cm, rules.max_cm, now)

    def _move(self, now: float) -> float | None:
        """Fly one step; return the time of a contact, if any."""
        quad = self._quad
        wanted, yaw_rate = self._sticks.at(now, quad.yaw)
        allowed = (
            self._autopilot.limited(wanted, quad.velocity[:2], quad.yaw, now) if self._setup.prevention else wanted
        )
        before = quad.position.copy()
        quad.step(allowed, self._height, yaw_rate, STEP_S)
        self._metres += float(np.linalg.norm(quad.position - before))
        self._asked += float(np.linalg.norm(wanted)) * STEP_S
        self._top = max(self._top, float(np.linalg.norm(quad.velocity)))
        room = self._world.clearance.at(quad.position, 2.0)
        self._least = min(self._least, room)
        return now if room < quad.frame.radius else None
