# SPDX-License-Identifier: Apache-2.0
"""A flight with late images and poses and its own clock: are the autopilot's messages true when sent?

Pillars and walls are vertical, so that the exact distance in each direction is always known. Nothing waits: the clock
is simulated, and images are small.
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import count
from math import tau
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter1d

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.errors import FrameRefused
from stereovox.frame import Frame
from stereovox.geometry.se3 import Transform
from stereovox.mapper import Mapper
from stereovox.mavlink.link import dialect
from stereovox.mavlink.sectors import INCREMENT_DEG, UNKNOWN, SectorRules
from stereovox.mavlink.sending import ObstacleSender
from stereovox.sources.poses.live_poses import LivePoses

CAMERA = PinholeCamera.from_field_of_view(48, 36, 90.0)
HEIGHT_M, CEILING_M = 1.2, 2.4
IMAGE_S, POSE_S, MESSAGE_S, WAIT_S = 1 / 10, 1 / 20, 1 / 8, 0.3
"""Seconds between images, poses and messages; and how long an image waits for its pose."""
LONGEST_S, SHORT_S = 5.0, 0.6
"""Longest delay, and the longest for every second flight: near the limit only some messages are sent."""
OFF_M, MOTION_S = 0.3, 0.1
"""Tolerance of a distance: this, plus the body's own motion in this time."""
BLUR_DEG = 5.0
"""How far a sector may reach beyond its edges, besides its overlap and the body's turning: a cell's width."""
KINDS = ("none", "constant", "growing", "jumping", "start")
"""Kinds of delays: none; constant; growing from none; a jump and back; late from the start, then in time."""


@dataclass(frozen=True)
class Delay:
    """A delay of `kind` that reaches `seconds`, and changes within `from_s` to `to_s` of the flight."""

    kind: str = "none"
    seconds: float = 0.0
    from_s: float = 0.0
    to_s: float = 0.0

    def at(self, time_s: float) -> float:
        """Return the delay in seconds of an event at a time."""
        within = self.from_s <= time_s < self.to_s
        if self.kind == "growing":
            return self.seconds * min(max(time_s - self.from_s, 0) / (self.to_s - self.from_s), 1)
        late = {"none": False, "constant": True, "jumping": within, "start": time_s < self.from_s}[self.kind]
        return self.seconds if late else 0.0


@dataclass(frozen=True)
class LateSetup:
    """Settings of a flight.

    Attributes:
        seconds: Its length.
        images: Delay of each camera's images: one looks ahead, a second one back.
        poses: Delay of the poses of the body; None: poses arrive only with the images.
        clock: `host`: stamps are by a known clock; `device`: by an unknown one.
        arrival: Ages count from arrival and obstacles are around the image's pose, as before stamps counted.
    """

    seconds: float = 5.0
    images: tuple[Delay, ...] = (Delay(),)
    poses: Delay | None = Delay()
    clock: str = "host"
    arrival: bool = False


@dataclass
class LateFlight:
    """The result of a flight: messages, their distances other than UNKNOWN, and those that are too far off.

    Attributes:
        worst_m: Largest error of a distance, beyond the body's motion in MOTION_S.
        why: Number of times nothing was sent, by reason.
    """

    messages: int = 0
    distances: int = 0
    too_far: int = 0
    too_near: int = 0
    bad_messages: int = 0
    worst_m: float = 0.0
    images: int = 0
    why: Counter[str] = field(default_factory=Counter)


def setup_of(seed: int) -> LateSetup:
    """Return the setup of a seed: kinds, delays and clocks at random."""
    draw = np.random.default_rng([seed, 7])

    def delay(kinds: tuple[str, ...]) -> Delay:
        begin, longest_s = float(draw.uniform(0.7, 2.5)), LONGEST_S if draw.random() < 0.5 else SHORT_S
        return Delay(str(draw.choice(kinds)), float(draw.uniform(0, longest_s)), begin, begin + draw.uniform(0.5, 2.5))

    images = tuple(delay(KINDS) for _ in range(draw.integers(1, 3)))
    posed = draw.random() < 0.8
    poses = delay(KINDS if draw.random() < 0.5 else ("none",)) if posed else None
    clock = "host" if draw.random() < 0.6 else "device"
    if clock == "device":  # a constant delay of an unknown clock is undetectable: something must once arrive in time
        poses = poses and (Delay() if poses.kind in ("constant", "start") else poses)
        if poses is None:
            images = tuple(Delay() if one.kind in ("constant", "start") else one for one in images)
    return LateSetup(images=images, poses=poses, clock=clock)


class Place:
    """A hall with pillars, and the path of a body through it."""

    def __init__(self, seed: int):
        draw = np.random.default_rng([seed, 8])
        self.half = draw.uniform((4.0, 3.5), (5.5, 5.0))
        self._swing = draw.uniform((0.8, 0.6), (1.8, 1.5))
        self._turns, self._phase = draw.uniform(0.12, 0.22, 2), draw.uniform(0, tau, 2)
        rate = float(draw.choice([-1, 1]) * draw.uniform(0.5, 1.2))
        self._yaw = float(draw.uniform(-np.pi, np.pi)), rate, *draw.uniform((0, 0.1), (0.5, 0.3)).tolist()
        self.boxes = self._pillars(draw)

    def _pillars(self, draw: np.random.Generator) -> NDArray[np.float64]:
        """Return low and high corners (M, 2, 2) of pillars away from the body's path."""
        found: list[NDArray[np.float64]] = []
        while len(found) < 4:
            size, middle = draw.uniform(0.2, 1.0, 2), draw.uniform(-self.half, self.half)
            if (np.abs(middle) - size / 2 > self._swing + 0.8).any():
                found.append(np.stack([middle - size / 2, middle + size / 2]))
        return np.array(found)

    def state(self, time_s: float) -> tuple[NDArray[np.float64], float, float, float]:
        """Return place (2,), yaw, speed and rate of yaw."""
        angle = tau * self._turns * time_s + self._phase
        speed = float(np.linalg.norm(self._swing * tau * self._turns * np.cos(angle)))
        yaw, rate, swing, turns = self._yaw
        wave = tau * turns * time_s
        return (
            self._swing * np.sin(angle), yaw + rate * time_s + swing * np.sin(wave), speed,
            rate + swing * tau * turns * np.cos(wave),
        )  # fmt: skip

    def pose(self, time_s: float) -> Transform:
        """Return T_world_body (4, 4), body in optical axes."""
        (x, y), yaw, _, _ = self.state(time_s)
        c, s = np.cos(yaw), np.sin(yaw)
        return np.array([[s, 0, c, x], [-c, 0, s, y], [0, -1, 0, HEIGHT_M], [0, 0, 0, 1.0]])

    def hits(self, place: NDArray[np.float64], directions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the distances (N,) from a place (2,) along horizontal directions (N, 2), in their lengths."""
        x, y = (1 / np.where(np.abs(axis) < 1e-12, 1e-12, axis) for axis in directions.T)
        found = np.minimum(np.abs(x) * self.half[0] - place[0] * x, np.abs(y) * self.half[1] - place[1] * y)
        for low, high in self.boxes - place:
            near = np.maximum(np.minimum(low[0] * x, high[0] * x), np.minimum(low[1] * y, high[1] * y))
            far = np.minimum(np.maximum(low[0] * x, high[0] * x), np.maximum(low[1] * y, high[1] * y))
            np.minimum(found, near, out=found, where=(near <= far) & (near > 0))
        return found

    def depth(self, T_world_camera: Transform, noise: np.random.Generator) -> NDArray[np.float32]:
        """Return an image (36, 48) float32 in metres, as noisy as a stereo camera's."""
        v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
        x, y = (u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy
        rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3) @ T_world_camera[:3, :3].T
        with np.errstate(divide="ignore"):
            level = np.where(rays[:, 2] > 0, CEILING_M - HEIGHT_M, -HEIGHT_M) / rays[:, 2]
        z = np.minimum(self.hits(T_world_camera[:2, 3], rays[:, :2]), level)
        return (z + noise.normal(0, 0.002, z.shape) * z**2).reshape(v.shape).astype(np.float32)


class LateLoop:
    """A flight, event by event."""

    def __init__(self, seed: int, setup: LateSetup | None = None):
        self.setup, self.place = setup or setup_of(seed), Place(seed)
        self.flight = LateFlight()
        draw = np.random.default_rng([seed, 9])
        self._noise, self._begin_ns = draw, 10**15
        self._offset_ns = 0 if self.setup.clock == "host" else int(draw.integers(-(10**14), -(10**13)))
        self._now_s, self._order = 0.0, count()
        self._events: list[tuple[float, int, Callable[..., None], tuple[Any, ...]]] = []
        clock = {"host": self._now_ns, "device": None}[self.setup.clock]
        by = "replay" if self.setup.arrival else clock
        self.mapper = Mapper("default", voxel_size=0.1, max_range=5.0, clock=self._now_ns, stamp_clock=by)
        link: Any = SimpleNamespace(url="simulated", messages=dialect(), now_ns=self._now_ns, send=self._heard)
        back = np.diag([-1.0, 1, -1, 1])
        self._mounts = {"front": np.eye(4), "back": back}
        rules = SectorRules(max_distance=3.0, half_height=0.15, own_radius=0.75, unknown="unmeasured")
        self.sender = ObstacleSender(
            self.mapper, link, rate_hz=None, rules=rules, mounts=self._mounts, tell=lambda line: None
        )
        self._poses = LivePoses()
        self._max_m, self._half_deg = rules.max_distance, INCREMENT_DEG / 2 + rules.overlap_deg

    def run(self) -> LateFlight:
        """Fly, and return the result."""
        setup = self.setup
        for k, delay in enumerate(setup.images):
            self._plan(delay, IMAGE_S, self._image, list(self._mounts)[k])
        if setup.poses is not None:
            self._plan(setup.poses, POSE_S, self._pose)
        for k in range(int(setup.seconds / MESSAGE_S)):
            self._at(k * MESSAGE_S + 0.013, self._message)
        while self._events and self._events[0][0] <= setup.seconds:
            self._now_s, _, act, given = heapq.heappop(self._events)
            act(*given)
        return self.flight

    def _plan(self, delay: Delay, step_s: float, act: Callable[..., None], *given: Any) -> None:
        """Schedule the arrival of events every `step_s`, each after the earlier ones."""
        last = 0.0
        for k in range(int(self.setup.seconds / step_s)):
            last = max(last + 1e-6, k * step_s + delay.at(k * step_s) + 0.005)
            self._at(last, act, k * step_s, *given)

    def _at(self, when_s: float, act: Callable[..., None], *given: Any) -> None:
        heapq.heappush(self._events, (when_s, next(self._order), act, given))

    def _now_ns(self) -> int:
        return self._begin_ns + round(1e9 * self._now_s)

    def _stamp_ns(self, event_s: float) -> int:
        return self._begin_ns + round(1e9 * event_s) + self._offset_ns

    def _pose(self, event_s: float) -> None:
        T = self.place.pose(event_s)
        self._poses.add(self._stamp_ns(event_s), T)
        if not self.setup.arrival:
            self.sender.pose(self._stamp_ns(event_s), T)

    def _image(self, event_s: float, name: str, since_s: float | None = None) -> None:
        """Map an image once the pose of its time has arrived, as live runs do."""
        stamp_ns, T_true = self._stamp_ns(event_s), self.place.pose(event_s)
        since_s = self._now_s if since_s is None else since_s
        T_world_body = T_true
        if self.setup.poses is not None:
            if not self._poses.is_final(stamp_ns) and self._now_s - since_s < WAIT_S:
                self._at(self._now_s + 0.01, self._image, event_s, name, since_s)
                return
            try:
                T_world_body = self._poses.at(stamp_ns)
            except FrameRefused:
                return
        depth = self.place.depth(T_true @ self._mounts[name], self._noise)
        frame = Frame(depth, CAMERA, T_world_body @ self._mounts[name], stamp_ns, sensor=name)
        self.flight.images += 1
        self.sender.after(frame, self.mapper.add(frame))

    def _message(self) -> None:
        why = self.sender.send()
        if why:
            self.flight.why["pose" if "pose" in why else "frame" if "frame" in why else why] += 1

    def _heard(self, message: Any) -> bool:
        """Compare a message with the truth at the time when it is sent."""
        flight, sent = self.flight, np.array(message.distances)
        here, yaw, speed, rate = self.place.state(self._now_s)
        known = sent != UNKNOWN
        blur = BLUR_DEG + np.degrees(abs(rate)) * MOTION_S
        claimed = np.minimum(sent / 100, self._max_m)
        far = claimed - self._nearest(here, yaw, INCREMENT_DEG / 2) - speed * MOTION_S
        near = self._nearest(here, yaw, self._half_deg + blur) - claimed - speed * MOTION_S
        far, near = far[known], near[known]
        flight.messages += 1
        flight.distances += int(known.sum())
        flight.too_far += int((far > OFF_M).sum())
        flight.too_near += int((near > OFF_M).sum())
        off = float(max(far.max(initial=0), near.max(initial=0)))
        flight.bad_messages += off > OFF_M
        flight.worst_m = max(flight.worst_m, off)
        return True

    def _nearest(self, here: NDArray[np.float64], yaw: float, half_deg: float) -> NDArray[np.float64]:
        """Return the true nearest distance (72,) within `half_deg` degrees of each sector's middle."""
        step = 0.5
        angles = yaw - np.radians(np.arange(0, 360, step))
        away = np.minimum(self.place.hits(here, np.column_stack([np.cos(angles), np.sin(angles)])), self._max_m)
        around = minimum_filter1d(away, 2 * round(half_deg / step) + 1, mode="wrap")
        return around[:: round(INCREMENT_DEG / step)]


def fly_late(seed: int, setup: LateSetup | None = None) -> LateFlight:
    """Fly once.

    Args:
        seed: Seed of the hall, the path, noise, and of delays and clocks unless `setup` gives them.
        setup: Delays and clocks.

    Returns:
        The result.
    """
    return LateLoop(seed, setup).run()
