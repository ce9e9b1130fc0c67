# SPDX-License-Identifier: Apache-2.0
"""The stitched sphere of the simulated drone against the scene itself."""

import numpy as np
import pytest

from stereovox.config import load_config
from stereovox.depth import prepare
from stereovox.depth.sphere import SphereLayout, accumulate, empty, stitch
from stereovox.depth.sphere.vehicle import vehicle_grid
from stereovox.frame import Reason
from stereovox.geometry.se3 import inverse
from stereovox.simulate.scene import Scene, box
from stereovox.simulate.surround import Surround
from stereovox_lab.checks.surround import nearest_surfaces, range_sigma, seen_cells, sphere_score


@pytest.fixture(scope="module")
def drone():
    return Surround("sim:surround?scale=0.5&moments=5")


def sphere_of(drone, moment, config):
    grids = []
    for k, pair in enumerate(drone.pairs):
        image = prepare(drone.exact(4 * moment + k), config)
        grids.append(accumulate(image, pair.T_body_camera, config))
    return stitch(grids), grids


@pytest.mark.parametrize("moment", [1, 3])
def test_stitched_sphere_is_true(drone, moment):
    """With exact depths: 95 % of the seen directions within 3 %; over-estimated by more than 2 sigma at most 0.5 %."""
    config = load_config(max_range=20.0, **{"sphere.step_deg": 2.0, "sphere.statistic": "minimum"})
    grid, grids = sphere_of(drone, moment, config)
    T_world_body = drone.body_pose(4 * moment)
    nearest, farthest = nearest_surfaces(drone.scene, T_world_body, grid.layout)
    seen = seen_cells(drone.scene, drone.pairs, T_world_body, grid.layout)
    sigma = np.zeros(grid.layout.shape)
    for pair, own in zip(drone.pairs, grids, strict=True):
        sigma = np.where(own.range_m == grid.range_m, range_sigma(pair, grid.layout, nearest, 0.25), sigma)
    score = sphere_score(grid, nearest, seen, sigma)
    assert score["directions"] > 9000
    assert score["known"] > 0.95
    assert score["close"] > 0.95
    assert score["close_of_seen"] > 0.95
    assert score["over"] < 0.005
    assert (farthest >= nearest).all()


def test_truth_is_that_of_a_scene_one_can_reckon():
    """A wall 2 m ahead, and a body that stands 1 m up in the world, turned by 90 degrees."""
    scene = Scene([box("wall", "wall", (-50, 2, -50), (50, 2.1, 50))])
    T_world_body = np.eye(4)
    T_world_body[:3, :3], T_world_body[2, 3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]], 1.0
    layout = SphereLayout.of(3)
    nearest, farthest = nearest_surfaces(scene, T_world_body, layout, rays=9)
    ahead = layout.directions()[..., 0]
    wanted = np.where(ahead > 0, 2 / np.maximum(ahead, 1e-9), np.inf)
    close = ahead > 0.2
    assert (nearest[close] <= wanted[close]).all()
    assert (farthest[close] >= wanted[close]).all()
    np.testing.assert_allclose(nearest[close], wanted[close], rtol=0.2)
    straight = ahead > 0.99
    np.testing.assert_allclose(nearest[straight], wanted[straight], rtol=0.01)
    assert np.isinf(nearest[ahead < -0.1]).all()


def test_score_counts_what_it_says():
    layout = SphereLayout.of(30)
    truth, seen = np.full(layout.shape, 2.0), np.ones(layout.shape, bool)
    grid = empty(layout)
    grid.range_m[:], grid.reason[:] = 2.0, Reason.VALID
    grid.range_m[0], grid.range_m[1] = 2.1, 1.8  # of 12 columns: one 5 % too far, one 10 % too near
    grid.reason[2] = Reason.UNKNOWN
    seen[3] = False
    score = sphere_score(grid, truth, seen, np.full(layout.shape, 0.04))
    assert score == {
        "directions": 66, "known": pytest.approx(10 / 11), "close": pytest.approx(8 / 10),
        "close_of_seen": pytest.approx(8 / 11), "over": pytest.approx(1 / 10), "median": pytest.approx(0),
    }  # fmt: skip
    assert sphere_score(grid, truth, seen, np.full(layout.shape, 0.06))["over"] == 0


@pytest.mark.parametrize("k", range(4))
def test_sigma_is_that_of_thrown_dice(drone, k):
    """Move the disparity of every direction's point by noise, and look how far its range moves."""
    pair, noise = drone.pairs[k], 0.05
    layout = SphereLayout.of(10)
    sigma = range_sigma(pair, layout, np.full(layout.shape, 1.5), noise)
    points = (layout.directions() * 1.5).reshape(-1, 3)
    x, y, z = (points @ inverse(pair.T_body_camera)[:3, :3].T + inverse(pair.T_body_camera)[:3, 3]).T
    random, camera = np.random.default_rng(0), pair.camera
    away = np.hypot(y, z) if pair.name in ("left", "right") else z
    with np.errstate(all="ignore"):
        if pair.name in ("left", "right"):
            angle = np.arctan(x / away)
            disparity = (angle - np.arctan((x - 0.15) / away)) / camera.step_u
            thrown = disparity + noise * random.standard_normal((2000, 1))
            depth = 0.15 / (np.tan(angle) - np.tan(angle - thrown * camera.step_u))
        else:
            thrown = camera.fx * 0.15 / away + noise * random.standard_normal((2000, 1))
            depth = camera.fx * 0.15 / thrown
        ranges = depth * np.sqrt(x * x + y * y + z * z) / away
    good = (sigma.ravel() < 0.3) & (away > 0.3)
    assert good.sum() > 100
    np.testing.assert_allclose(ranges.std(axis=0)[good] / sigma.ravel()[good], 1, atol=0.08)


def test_look_round_puts_all_pairs_together(drone):
    """Through images, matching and all: the nearest thing in each main direction is about right."""
    config = load_config(max_range=10.0, **{"sphere.step_deg": 5.0, "stereo.disparities": 96})
    grid, now_ns, refused = vehicle_grid((drone.frame(i) for i in range(4, 8)), config)
    assert now_ns == 100_000_000
    assert not refused
    nearest, farthest = nearest_surfaces(drone.scene, drone.body_pose(4), grid.layout)
    surface = grid.reason == Reason.VALID
    assert surface.mean() > 0.5
    error = grid.range_m[surface] / nearest[surface] - 1
    assert np.median(np.abs(error)) < 0.1
    np.testing.assert_array_equal(grid.stamp_ns[grid.known], 100_000_000)
    assert (farthest >= nearest).all()


def test_look_round_carries_older_frames_along():
    """The left pair looked 0.3 s earlier, 20 cm from here: its walls stand where they are, and are older."""
    drone = Surround("sim:surround?scale=0.5")
    config = load_config(max_range=10.0, **{"sphere.step_deg": 5.0, "stereo.disparities": 96})
    frames = [drone.frame(41), drone.frame(52)]  # left at moment 10, front at moment 13
    travelled = np.linalg.norm(drone.body_pose(52)[:3, 3] - drone.body_pose(41)[:3, 3])
    assert travelled > 0.2
    grid, now_ns, _ = vehicle_grid(frames, config)
    assert now_ns == 1_300_000_000
    assert set(np.unique(grid.stamp_ns[grid.known])) == {1_000_000_000, now_ns}
    old = (grid.stamp_ns == 1_000_000_000) & (grid.reason == Reason.VALID)
    assert old.sum() > 100
    error = {}
    for name, i in (("here", 52), ("there", 41)):
        nearest, farthest = nearest_surfaces(drone.scene, drone.body_pose(i), grid.layout)
        error[name] = np.median(np.abs(grid.range_m[old] / ((nearest + farthest) / 2)[old] - 1))
    assert error["here"] < 0.1
    assert error["here"] < 0.6 * error["there"]
