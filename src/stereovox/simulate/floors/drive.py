# SPDX-License-Identifier: Apache-2.0
"""The drive of a differential-drive robot past a list of stops, and an error model of its odometry.

Sensor model of a Kinect: quantised disparity, noise, shadows next to edges, limits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.frame import Reason
from stereovox.geometry.se2 import Pose, compose, relative, wrapped
from stereovox.simulate.d435 import beside_nearer_surface, classify, hidden_from_right_eye, on_border

STEP_NS = 20_000_000
"""Time between two poses of a drive."""
TURN = 0.8
"""Fastest turn in rad/s."""
STRAIGHT = 0.6
"""A robot whose next stop is at a larger angle (radians) first turns on the spot."""
NEAR = 0.1
"""Metres from a stop at which it counts as reached."""


class Stop(NamedTuple):
    """A place on the path in metres, and the degrees by which the robot turns there on the spot (left is positive)."""

    x: float
    y: float
    spin_deg: float = 0.0


@dataclass(frozen=True)
class Odometry:
    """Errors of a robot's odometry; by default those of an uncalibrated Pioneer.

    distance, turn: relative errors of distances and turns; veer: radians per metre by which it seems to turn left while
    it drives straight (unequal wheels). Standard deviations: distance_noise metres per metre travelled,
    turn_noise radians per radian of turning, veer_noise radians per metre; all grow with the square root.
    """

    distance: float = 0.02
    turn: float = -0.02
    veer: float = 0.004
    distance_noise: float = 0.01
    turn_noise: float = 0.02
    veer_noise: float = 0.01

    def measured(self, poses: Pose, seed: int | list[int], drift: float = 1.0) -> Pose:
        """Return the odometry's poses (N, 3) for true poses (N, 3), in the frame of the first one.

        drift: factor on all errors.
        """
        random = np.random.default_rng(seed)
        step = relative(poses[:-1], poses[1:])
        way, turned = np.hypot(step[:, 0], step[:, 1]), np.abs(step[:, 2])
        noise = random.standard_normal((3, len(step)))
        share = drift * (self.distance * way + self.distance_noise * np.sqrt(way) * noise[0])
        step[:, :2] *= (1 + share / np.maximum(way, 1e-12))[:, None]
        step[:, 2] += drift * (
            self.turn * step[:, 2]
            + self.veer * way
            + self.turn_noise * np.sqrt(turned) * noise[1]
            + self.veer_noise * np.sqrt(way) * noise[2]
        )
        return _chained(step)


def drive(stops: Sequence[Stop], speed: float) -> Pose:
    """Return the poses (N, 3), one per `STEP_NS`, of a robot that drives from the first stop past all others.

    It first faces the second stop. speed: m/s on straight lines.
    """
    dt = STEP_NS / 1e9
    x, y = stops[0][:2]
    yaw = float(np.arctan2(stops[1].y - y, stops[1].x - x))
    poses = [(x, y, yaw)]
    for stop in stops:
        while np.hypot(stop.x - x, stop.y - y) > NEAR:
            aside = float(wrapped(np.arctan2(stop.y - y, stop.x - x) - yaw))
            ahead = speed * dt * max(0.0, 1 - abs(aside) / STRAIGHT)
            turn = float(np.clip(3 * aside, -TURN, TURN)) * dt
            x, y, yaw = x + ahead * np.cos(yaw + turn / 2), y + ahead * np.sin(yaw + turn / 2), yaw + turn
            poses.append((x, y, yaw))
        turns = round(abs(np.radians(stop.spin_deg)) / (TURN * dt))
        for _ in range(turns):
            yaw += np.radians(stop.spin_deg) / turns
            poses.append((x, y, yaw))
    found = np.array(poses)
    found[:, 2] = wrapped(found[:, 2])
    return found


def zigzag(start: tuple[float, float], end: tuple[float, float], aside: float, pitch: float = 1.6) -> list[Stop]:
    """Return stops from one place to another, alternately `aside` metres to the left and the right (IST 2019,
    III-D)."""
    along = np.subtract(end, start)
    length = float(np.hypot(*along))
    count = max(1, round(length / pitch))
    left = np.array([-along[1], along[0]]) / length
    middle = [np.asarray(start) + along * n / count for n in range(count + 1)]
    sides = [0.0, *((-1) ** n * aside for n in range(count - 1)), 0.0]
    return [Stop(*(place + side * left)) for place, side in zip(middle, sides, strict=True)]


def metres(poses: Pose) -> NDArray[np.float64]:
    """Return the distance travelled at each pose, (N,)."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1))])


def _chained(steps: Pose) -> Pose:
    """Return the poses (N + 1, 3) after each of the steps (N, 3) from the origin."""
    yaw = np.concatenate([[0.0], np.cumsum(steps[:, 2])])
    moves = compose(np.column_stack([np.zeros((len(steps), 2)), yaw[:-1]]), steps)[:, :2]
    return np.column_stack([np.vstack([np.zeros(2), np.cumsum(moves, axis=0)]), wrapped(yaw)])


HFOV_DEG, VFOV_DEG = 57.0, 43.0
BASELINE = 0.075
"""Metres from the infrared projector to the camera."""
STEP, NOISE = 0.125, 0.0625
"""Pixels of the full image: disparity has discrete steps, after Gaussian noise of this standard deviation."""
WIDTH = 640


def kinect_camera(width: int = WIDTH) -> PinholeCamera:
    """Return the Kinect's depth camera (IST 2019, III-C), or a smaller image of the same field of view.

    It declares its baseline and the noise of its disparity, including quantisation, so that a mapper knows the
    uncertainty of depth.
    """
    height = round(width * 480 / WIDTH)
    subpixel = math.hypot(NOISE, STEP / math.sqrt(12)) * width / WIDTH
    fx = 0.5 * width / math.tan(math.radians(HFOV_DEG) / 2)
    fy = 0.5 * height / math.tan(math.radians(VFOV_DEG) / 2)
    return PinholeCamera(width, height, fx, fy, (width - 1) / 2, (height - 1) / 2, BASELINE, subpixel=subpixel)


@dataclass(frozen=True)
class Kinect:
    """A depth camera that matches its own projected pattern of dots.

    step, noise: disparity has discrete steps of this many pixels (1/8), after Gaussian noise of this standard deviation
        (1/16; Khoshelham and Elberink 2012, 3.3: half a step): at 5 m a step is 7 cm of depth.
    nearest, farthest: depths in metres it delivers (IST 2019, III-C).
    edge_px, edge_loss: as in `D435`.
    """

    camera: PinholeCamera
    step: float = STEP
    noise: float = NOISE
    nearest: float = 0.8
    farthest: float = 6.0
    edge_px: int = 2
    edge_loss: float = 0.25

    def measure(
        self, true_depth_m: NDArray[np.floating], seed: int | list[int]
    ) -> tuple[NDArray[np.uint16], NDArray[np.uint8]]:
        """Return depth in whole millimetres (0 = none) and the `Reason` of every pixel.

        TOO_NEAR and TOO_FAR by the measured depth, UNMATCHED in shadows and next to edges.
        true_depth_m: (height, width) along the optical axis, inf if there is nothing. Same seed, same image.
        """
        random = np.random.default_rng(seed)
        # relative to the full image: a smaller one is a scaled copy, with the same noise
        scale = np.float32(self.camera.fx * BASELINE * WIDTH / self.camera.width)
        disparity = scale / np.asarray(true_depth_m, np.float32)
        noisy = disparity + np.float32(self.noise) * random.standard_normal(disparity.shape, np.float32)
        steps = np.maximum(np.rint(noisy / np.float32(self.step)), np.float32(0.5))
        depth = scale / (steps * np.float32(self.step))
        own = disparity * np.float32(self.camera.width / WIDTH)
        lost = _in_shadow(own) | beside_nearer_surface(own, self.edge_px)
        lost |= on_border(own) & (random.random(disparity.shape, np.float32) < self.edge_loss)
        reason = classify(depth, self.nearest, self.farthest)
        reason[lost & (reason != Reason.TOO_NEAR)] = Reason.UNMATCHED
        return np.where(reason == Reason.VALID, np.rint(depth * 1000), 0).astype(np.uint16), reason


def _in_shadow(disparity: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return the pixels that the projector does not light; its beam is wider than the image."""
    return hidden_from_right_eye(disparity) & (np.arange(disparity.shape[1]) >= disparity)
