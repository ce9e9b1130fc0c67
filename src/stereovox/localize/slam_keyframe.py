# SPDX-License-Identifier: Apache-2.0
"""What SLAM's pose graph is made of: scans that it keeps, and what it knows of where two of them stand."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stereovox import planar
from stereovox.frame import Scan
from stereovox.localize.line_map import Cloud

STEP_SIGMA = (0.01, 0.03, 0.003, 0.02)
"""Standard deviation of a matched step between keyframes: metres, per metre, radians, per radian."""


@dataclass(eq=False)
class Keyframe:
    """A scan that the map is made of.

    pose: (3,) pose_map_base as now believed. step: (3,) where it stood as seen from the keyframe before, as matched.
    cloud: its points in the robot's frame. travelled: metres of the robot's way until here.
    """

    pose: planar.Pose
    step: planar.Pose
    cloud: Cloud
    scan: Scan
    travelled: float


@dataclass(frozen=True, eq=False)
class Edge:
    """How two keyframes stand to each other: motion (3,) is pose_first_second.

    information: (3, 3) of x, y, yaw in the second's frame. share: of the points that lay on lines, 1 for a step.
    """

    first: int
    second: int
    motion: planar.Pose
    information: NDArray[np.float64]
    share: float = 1.0


def step_edges(keyframes: list[Keyframe]) -> list[Edge]:
    """Return what matching scan after scan says: one edge between each keyframe and the next."""
    edges = []
    for i, keyframe in enumerate(keyframes[1:]):
        way, turn = float(np.hypot(*keyframe.step[:2])), abs(float(keyframe.step[2]))
        metres = STEP_SIGMA[0] + STEP_SIGMA[1] * way
        radians = STEP_SIGMA[2] + STEP_SIGMA[3] * turn
        edges.append(Edge(i, i + 1, keyframe.step, np.diag([metres**-2, metres**-2, radians**-2])))
    return edges


def in_map(keyframe: Keyframe) -> Scan:
    """Return a keyframe's scan with its pose in the map, whatever its stamp says."""
    T_map_odom = planar.lifted(planar.compose(keyframe.pose, planar.inverse(keyframe.scan.pose_world_base)))
    return replace(keyframe.scan, T_world_sensor=T_map_odom @ keyframe.scan.T_world_sensor)


def in_second_frame(information: NDArray[np.float64], yaw: float) -> NDArray[np.float64]:
    """Return information (3, 3) about x, y, yaw of a frame's place as that about its own x, y, yaw."""
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    return turn.T @ information @ turn


def without_weak(information: NDArray[np.float64], floor: float) -> NDArray[np.float64]:
    """Return information (3, 3) without what it says of the direction in which it says little.

    Along a corridor nothing but noise tells where one is, and its pull is towards "has not moved".
    floor: share of the strongest direction's information below which a direction is dropped.
    """
    values, vectors = np.linalg.eigh(information[:2, :2])
    if values[0] >= floor * values[1]:
        return information
    keep = np.eye(3)
    keep[:2, :2] -= np.outer(vectors[:, 0], vectors[:, 0])
    return keep @ information @ keep
