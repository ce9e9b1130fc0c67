# SPDX-License-Identifier: Apache-2.0
"""The odometry motion model: how a robot with two driven wheels may really have moved (table 5.6)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereovox import planar
from stereovox.config_robot import AmclConfig

LEAST_WAY = 0.01
"""Metres below which the direction of a way says nothing: the robot turned on the spot."""


def turn_go_turn(pose_odom_before: planar.Pose, pose_odom_after: planar.Pose) -> NDArray[np.float64]:
    """Return the (3,) first turn, way and second turn (radians, metres) that lead from one (3,) pose to the other."""
    step = planar.relative(pose_odom_before, pose_odom_after)
    way = float(np.hypot(step[0], step[1]))
    first = float(np.arctan2(step[1], step[0])) if way >= LEAST_WAY else 0.0
    return np.array([first, way, float(planar.wrapped(step[2] - first))])


def deviations(motion: NDArray[np.float64], config: AmclConfig) -> NDArray[np.float64]:
    """Return the (3,) standard deviations of first turn, way and second turn (table 5.6, with variances).

    Who drives backwards does not turn by 180 degrees twice: a turn counts by its distance from 0 or 180 degrees.
    """
    first, way, second = motion
    turn1, turn2 = (min(abs(turn), np.pi - abs(turn)) for turn in (first, second))
    return np.sqrt(
        [
            config.alpha1 * turn1**2 + config.alpha2 * way**2,
            config.alpha3 * way**2 + config.alpha4 * (turn1**2 + turn2**2),
            config.alpha1 * turn2**2 + config.alpha2 * way**2,
        ]
    )


def moved(
    particles: planar.Pose, motion: NDArray[np.float64], config: AmclConfig, rng: np.random.Generator
) -> planar.Pose:
    """Return (N, 3) particles after a (3,) motion of `turn_go_turn`, each with noise of its own."""
    noise = rng.standard_normal((3, len(particles))) * deviations(motion, config)[:, None]
    first, way, second = motion[:, None] - noise
    heading = particles[:, 2] + first
    x, y = particles[:, 0] + way * np.cos(heading), particles[:, 1] + way * np.sin(heading)
    return np.column_stack([x, y, planar.wrapped(heading + second)])
