# SPDX-License-Identifier: Apache-2.0
"""An IMU on the way of a simulated camera, as good or as wrong as one likes."""

from __future__ import annotations

import numpy as np
from made_tracks import STEP_NS, Track, track, tracker
from naive_imu import felt_along

from stereovox.geometry.se3 import look_at
from stereovox.simulate.scene import Scene, box
from stereovox.sources.imu import ImuReadings
from stereovox.track.tracker import Tracker

BIAS = np.array([0.012, -0.02, 0.015])
"""In rad/s: that of a cheap gyroscope, one degree a second."""
SIDEWAYS = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
"""R_camera_imu of an IMU with x forward and z up."""


def imu_along(
    frames, *, bias=BIAS, noise=0.003, clock_s=0.0, mount=SIDEWAYS, told=None, hz=200.0, before_s=0.0, seed=0
):
    """Return the readings of an IMU on the camera of frames with true poses.

    bias: (3,) in the camera's axes. clock_s: by how much its clock is ahead. mount: R_camera_imu; told: the one that
    the readings say it has.
    """
    rng = np.random.default_rng(seed)
    stamps, rate, force = felt_along([f.stamp_ns for f in frames], [f.T_world_sensor for f in frames], hz, before_s)
    rate = (rate + bias + noise * rng.normal(size=rate.shape)) @ mount
    force = (force + 0.05 * rng.normal(size=force.shape)) @ mount
    T = np.eye(4)
    T[:3, :3] = mount if told is None else told
    return ImuReadings(stamps + round(clock_s * 1e9), rate, force, T, "imu")


def tracker_with(frames, imu, start=None) -> Tracker:
    """Return a tracker like `tracker`, with an IMU."""
    made = tracker(frames[0].T_world_sensor if start is None else start)
    return Tracker(made.config, start=frames[0].T_world_sensor if start is None else start, imu=imu)


def both(frames, imu) -> tuple[Track, Track, Tracker]:
    """Return what is found without and with an IMU, and the tracker that had it."""
    by = tracker_with(frames, imu)
    return track(frames), track(frames, by), by


def cluttered(seed: int) -> Scene:
    """Return a room of 6 x 6 m, whose walls have boxes all round."""
    rng = np.random.default_rng(seed)
    sides = [((3, -3), (3.2, 3)), ((-3.2, -3), (-3, 3)), ((-3, 3), (3, 3.2)), ((-3, -3.2), (3, -3))]
    solids = [box("floor", "floor", (-3, -3, -0.2), (3, 3, 0))]
    solids += [box("wall", f"wall {k}", (*low, 0), (*high, 2.6)) for k, (low, high) in enumerate(sides)]
    for k in range(40):
        angle, far, z = rng.uniform(0, 2 * np.pi), rng.uniform(1.6, 2.9), rng.uniform(0, 1.8)
        (x, y), (w, d), h = (
            far * np.array([np.cos(angle), np.sin(angle)]),
            rng.uniform(0.1, 0.35, 2),
            rng.uniform(0.2, 0.9),
        )
        solids.append(box("box", f"box {k}", (x - w, y - d, z), (x + w, y + d, z + h)))
    return Scene(solids)


def looking_round(
    steps: int, rate_deg: float, begin_s: float = 0.99, total_deg: float = 150.0, step_s: float = STEP_NS / 1e9
):
    """Return poses of a camera that looks to and fro for `begin_s`, then turns at once at so many degrees a second."""
    poses = []
    for k in range(steps):
        t = k * step_s
        yaw = 0.25 * np.sin(3 * np.pi * min(t, begin_s))
        yaw += np.radians(min(max(t - begin_s, 0.0) * rate_deg, total_deg))
        eye = np.array([0.01 * k, 0.005 * k, 1.2])
        poses.append(look_at(eye, eye + np.array([np.cos(yaw), np.sin(yaw), -0.1])))
    return poses
