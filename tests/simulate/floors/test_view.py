# SPDX-License-Identifier: Apache-2.0
"""Exact depth images of a floor, column by column, against rays cast at the same floor made of triangles."""

from __future__ import annotations

import numpy as np
import pytest

from stereovox.geometry import se2
from stereovox.simulate.floors.drive import kinect_camera
from stereovox.simulate.floors.floor import Floor
from stereovox.simulate.floors.plan import CEILING, FloorPlan, block, post
from stereovox.simulate.floors.view import LevelView


def rays_at_triangles(plan: FloorPlan, camera, pose, height: float) -> np.ndarray:
    x, y = camera.ray_slopes()
    rays = np.stack(np.broadcast_arrays(x[None], y[:, None], np.float32(1)), axis=-1).reshape(-1, 3)
    T = se2.lifted(pose)
    T[:3, :3] = T[:3, :3] @ [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    T[2, 3] = height
    return plan.scene.cast(T[:3, 3], rays @ T[:3, :3].T).reshape(camera.height, camera.width)


def same(one: np.ndarray, other: np.ndarray) -> float:
    """The share of pixels that agree to a thousandth."""
    return float((np.abs(one - other) <= 1e-3 * np.maximum(other, 1)).mean())


@pytest.mark.parametrize("plan", ["corridors", "testbed"])
def test_a_drive_looks_the_same_both_ways(plan):
    floor = Floor(f"sim:floor?plan={plan}&image_width=120")
    for frame in floor.frames[:: len(floor.frames) // 30]:
        pose = se2.flattened(floor.truth.at(frame.stamp_ns))
        slow = rays_at_triangles(floor.plan, floor.camera, pose, 0.28)
        assert same(floor.true_depth(frame.stamp_ns), slow) > 0.998


@pytest.mark.parametrize("height", [0.2, 1.0, 1.7])
def test_things_of_all_heights_are_seen_from_all_heights_and_sides(height):
    plan = FloorPlan(
        [(0.0, 0.0, 6.0, 5.0)],
        [
            block("boxes", "low", (1.0, 1.0, 1.6, 1.4), (0.0, 0.4), 25),
            block("tables", "top", (2.2, 3.0, 3.2, 4.0), (0.7, 0.74)),
            block("lamps", "lamp", (4.0, 1.0, 4.6, 1.8), (1.9, 2.2), 60),
            block("pillars", "pillar", (4.4, 3.4, 4.7, 3.7), (0.0, CEILING), 10),
            post("posts", "post", (3.0, 2.0), 0.2, 1.4),
        ],
    )
    camera, random = kinect_camera(100), np.random.default_rng(5)
    view = LevelView(plan, camera, height)
    for yaw in random.uniform(-np.pi, np.pi, 25):
        pose = (*random.choice([(2.7, 2.6), (0.5, 0.5), (5.4, 4.4), (3.7, 0.6)]), yaw)
        assert same(view.depth(pose), rays_at_triangles(plan, camera, pose, height)) > 0.995
