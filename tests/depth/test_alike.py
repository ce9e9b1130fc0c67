# SPDX-License-Identifier: Apache-2.0
"""Whether ranges of clouds and scans lie on surfaces: a slow twin, sparse and noisy lidars, and noise."""

from dataclasses import replace

import numpy as np
import pytest
from entrance_cases import good
from made_clouds import directions_of, pose, room_cloud, room_points

import stereovox as sv
from stereovox.depth import quality
from stereovox.depth.cloud import checked_cloud
from stereovox.errors import FrameRefused
from stereovox.frame import CheckedCloud

CONFIG = sv.load_config()


def refusal(cloud, **settings):
    try:
        checked_cloud(cloud, sv.load_config(CONFIG, **settings))
    except FrameRefused as refused:
        return refused.reason
    return None


def naive(points, sigma):
    """What `_alike_of` says of few points, from all pairs of them."""
    ranges = np.linalg.norm(points, axis=1)
    directions = points / ranges[:, None]
    asked = range(0, len(points), max(1, len(points) // quality.ASKED))
    total = 0.0
    for i in asked:
        away = np.linalg.norm(directions - directions[i], axis=1)
        away[i] = np.inf
        near = int(np.argmin(away))
        off = abs(np.log(ranges[i] / ranges[near]))
        if off <= away[near] + quality.ALIKE + quality.ALIKE_SIGMA * sigma / ranges[i]:
            total += 1
        else:
            total += 1 - np.mean(np.abs(np.log(ranges / ranges[i])) < off)
    return 2 * total / len(asked) - 1


@pytest.mark.parametrize("seed", range(3))
def test_the_share_is_that_of_all_pairs(seed):
    rng = np.random.default_rng(seed)
    for points in (rng.uniform(-5, 5, (700, 3)), room_points(pose(0.3), directions_of(seed, 700))):
        checked = CheckedCloud(points, None, np.ones(700, bool), sv.Lidar(), np.eye(4))
        assert quality._alike_of(checked, quality.SAMPLE) == pytest.approx(naive(points, 0.02), abs=0.02)


@pytest.mark.parametrize("count", [5, 60, 300, 4000])
@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_rooms_are_surfaces_however_few_points(count, noise):
    rng = np.random.default_rng(count)
    for seed in range(4):
        points = room_points(pose(0.4, 0.2), directions_of(seed, count))
        assert refusal(sv.Cloud(points + rng.normal(0, noise, points.shape), np.eye(4))) is None


@pytest.mark.parametrize("rings", [1, 4, 16])
def test_rings_are_surfaces_and_random_ranges_on_them_are_not(rings):
    rng = np.random.default_rng(rings)
    azimuth, height = np.meshgrid(
        np.linspace(-3.1, 3.1, 900), np.radians(np.linspace(-15, 15, rings) if rings > 1 else [1])
    )
    ways = np.stack([np.cos(height) * np.cos(azimuth), np.cos(height) * np.sin(azimuth), np.sin(height)], -1).reshape(
        -1, 3
    )
    assert refusal(sv.Cloud(room_points(pose(0.4, 0.2), ways), np.eye(4))) is None
    for ranges in (
        rng.uniform(0.6, 20, len(ways)),
        rng.normal(8, 2, len(ways)).clip(0.6),
        rng.uniform(4, 6, len(ways)),
    ):
        assert refusal(sv.Cloud(ways * ranges[:, None], np.eye(4))) == "no_surfaces"


def test_random_points_are_no_surfaces_unless_that_is_allowed():
    rng = np.random.default_rng(1)
    for points in (rng.uniform(-8, 8, (3000, 3)), rng.normal(0, 4, (3000, 3)), rng.uniform(0, 8, (300, 3))):
        assert refusal(sv.Cloud(points, np.eye(4))) == "no_surfaces"
        assert refusal(sv.Cloud(points, np.eye(4)), **{"trust.min_surface_share": 0}) is None


def test_order_and_where_it_was_measured_from_do_not_count():
    cloud = room_cloud(1, 3000)
    shuffled = np.random.default_rng(0).permutation(cloud.points)
    assert refusal(replace(cloud, points=shuffled)) is None
    origins = np.random.default_rng(1).uniform(-0.5, 0.5, cloud.points.shape)
    assert refusal(replace(cloud, points=cloud.points + origins, origins=origins)) is None


@pytest.mark.parametrize(("unit", "reason"), [(1000, "bad_units"), (1, None), (0.001, "bad_units")])
def test_units_of_points_and_of_free_rays(unit, reason):
    cloud = room_cloud(1, 2000)
    points = cloud.points * np.float32(unit)
    assert refusal(replace(cloud, points=points)) == reason
    if unit > 1:
        assert refusal(replace(cloud, clear=points)) == reason
        assert refusal(replace(cloud, points=points), max_range=100.0, voxel_size=0.5) == reason


def test_a_lidar_that_sees_far_is_in_metres():
    far = room_cloud(1, 2000)
    assert refusal(replace(far, points=far.points * np.float32(60))) is None  # half of them beyond 150 m
    survey = replace(far, points=far.points * np.float32(200))
    assert refusal(survey) == "bad_units"
    assert refusal(survey, max_range=500.0, voxel_size=1.0) is None  # from an aircraft


def test_a_sweep_that_stands_still_while_the_robot_moves():
    mapper = sv.GridMapper(voxel_size=0.1)
    scan = good("2-D scan", 0)
    moved = scan.T_world_sensor.copy()
    moved[0, 3] += 0.2
    assert mapper.add(scan).refused is None
    assert mapper.add(replace(scan, stamp_ns=10**8)).refused is None  # it may stand
    assert mapper.add(replace(scan, stamp_ns=2 * 10**8, T_world_sensor=moved)).refused == "frozen_image"
    corridor = np.full(720, np.inf, np.float32)
    corridor[100:140] = (1.5 / np.sin(scan.angles[100:140])).clip(-9, 9).astype(np.float32)
    straight = replace(scan, ranges=np.abs(corridor), stamp_ns=3 * 10**8)
    assert mapper.add(straight).refused is None
    assert (
        mapper.add(replace(straight, stamp_ns=4 * 10**8, T_world_sensor=moved)).refused is None
    )  # no noise: simulated
