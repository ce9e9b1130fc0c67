# SPDX-License-Identifier: Apache-2.0
"""Relative poses of keyframes for the pose graph: steps, and the last refinement."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stereovox.config.robot import SlamConfig
from stereovox.frame import Scan
from stereovox.geometry import se2
from stereovox.geometry.pose_graph import Edge
from stereovox.localize.slam.line_map import Cloud, LineMap, joined

STEP_SIGMA = (0.01, 0.03, 0.003, 0.02)
"""Standard deviation of a matched step between keyframes: metres, per metre, radians, per radian."""
SLACK_TURN = 0.3
"""Radians per metre of slack."""
PATCH = 4
"""Keyframes of a patch before and after its middle: few enough to be rigid."""
STRIDE = 3
"""Keyframes from one patch's middle to the next."""
WEAK = 0.1
"""Share of information below which a direction is unconstrained, as along a corridor."""
MAX_NEIGHBOURS = 120
"""Most keyframes registered to a patch: a robot may pass the same place all day."""
MIN_SHARE = 0.4
"""Share of a keyframe's points that must lie on a patch's lines."""


@dataclass(eq=False)
class Keyframe:
    """A scan that the map is built from.

    pose: (3,) current pose_map_base. step: (3,) pose relative to the previous keyframe, as matched. cloud: its points
    in the robot's frame. travelled: metres of the robot's path so far. slack: metres by which `step` may be off beyond
    the usual. lost: whether that is because odometry alone led here, as scans saw nothing, or nothing known; else
    matching and odometry contradicted each other.
    """

    pose: se2.Pose
    step: se2.Pose
    cloud: Cloud
    scan: Scan
    travelled: float
    slack: float = 0.0
    lost: bool = False


def step_edges(keyframes: list[Keyframe]) -> list[Edge]:
    """Return the edges from scan-to-scan matching: one between each keyframe and the next."""
    edges = []
    for i, keyframe in enumerate(keyframes[1:]):
        way, turn = float(np.hypot(*keyframe.step[:2])), abs(float(keyframe.step[2]))
        metres = STEP_SIGMA[0] + STEP_SIGMA[1] * way + keyframe.slack
        radians = STEP_SIGMA[2] + STEP_SIGMA[3] * turn + SLACK_TURN * keyframe.slack
        edges.append(Edge(i, i + 1, keyframe.step, np.diag([metres**-2, metres**-2, radians**-2])))
    return edges


def in_map(keyframe: Keyframe) -> Scan:
    """Return a keyframe's scan with its pose in the map, regardless of its stamp."""
    T_map_odom = se2.lifted(se2.compose(keyframe.pose, se2.inverse(keyframe.scan.pose_world_base)))
    return replace(keyframe.scan, T_world_sensor=T_map_odom @ keyframe.scan.T_world_sensor)


def in_second_frame(information: NDArray[np.float64], yaw: float) -> NDArray[np.float64]:
    """Return information (3, 3) about a frame's x, y, yaw, expressed along that frame's own axes."""
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    return turn.T @ information @ turn


def without_weak(information: NDArray[np.float64], floor: float) -> NDArray[np.float64]:
    """Return information (3, 3) without its weak direction.

    Along a corridor only noise constrains the position, and it pulls towards "has not moved".
    floor: share of the strongest direction's information below which a direction is dropped.
    """
    values, vectors = np.linalg.eigh(information[:2, :2])
    if values[0] >= floor * values[1]:
        return information
    keep = np.eye(3)
    keep[:2, :2] -= np.outer(vectors[:, 0], vectors[:, 0])
    return keep @ information @ keep


def patch_edges(keyframes: list[Keyframe], config: SlamConfig) -> Iterator[Edge]:
    """Yield edges from each keyframe to each patch of other keyframes nearby.

    A patch is a short run of keyframes, taken as rigid; edges go from its middle to the keyframe. Registration starts
    from the current poses, so these must be right to a decimetre or two.
    """
    places = np.array([keyframe.pose for keyframe in keyframes])
    patch = LineMap(config.voxel_size)
    for middle in range(0, len(keyframes), STRIDE):
        first, last = max(middle - PATCH, 0), min(middle + PATCH + 1, len(keyframes))
        others = _neighbours(places, middle, first, last, config)
        if not len(others):
            continue
        pose = places[middle]
        patch.build(joined([k.cloud.moved(se2.relative(pose, k.pose)) for k in keyframes[first:last]]))
        guesses = se2.relative(pose, places[others])
        for other, guess in zip(others.tolist(), guesses, strict=True):
            edge = _edge(patch, keyframes, (middle, other), guess, config)
            if edge is not None:
                yield edge


def _neighbours(places: se2.Pose, middle: int, first: int, last: int, config: SlamConfig) -> NDArray[np.int64]:
    far = np.hypot(*(places[:, :2] - places[middle, :2]).T)
    near = np.nonzero(far < config.refine_distance)[0]
    near = near[(near < first) | (near >= last)]
    return near[:: len(near) // MAX_NEIGHBOURS + 1]


def _edge(
    patch: LineMap, keyframes: list[Keyframe], pair: tuple[int, int], guess: se2.Pose, config: SlamConfig
) -> Edge | None:
    cloud = keyframes[pair[1]].cloud
    match = patch.refine(cloud, guess, 2 * config.sigma, iterations=6)
    match = patch.refine(cloud, match.pose, config.sigma, iterations=8)
    moved = match.pose - guess
    if match.share < MIN_SHARE or moved[0] ** 2 + moved[1] ** 2 > 0.1 or abs(moved[2]) > 0.1:
        return None
    information = without_weak(in_second_frame(match.information, float(match.pose[2])), WEAK)
    return Edge(*pair, match.pose, information)
