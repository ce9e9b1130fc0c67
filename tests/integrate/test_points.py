# SPDX-License-Identifier: Apache-2.0
"""Rays of single points: against the slow reference, in any order, with any threads, from a sensor that moves."""

from dataclasses import replace

import naive_integrators
import numpy as np
import pytest
from made_images import cells_of

from stereovox.cameras.lidar import Lidar
from stereovox.config import load_config
from stereovox.errors import FrameRefused
from stereovox.frame import CheckedCloud
from stereovox.geometry.se3 import rotation_matrix
from stereovox.integrate import Integration
from stereovox.integrate.points import Points
from stereovox.sensors import SENSORS, make_sensor


def made_cloud(seed, count=300, reach=4.0, moving=False, lidar=None):
    """Return a cloud in all directions, some rays along the axes, some beyond any range, some without a surface."""
    random = np.random.default_rng(seed)
    directions = random.normal(size=(count, 3))
    directions[:6] = [*np.eye(3), *-np.eye(3)]
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    origins = np.linspace([-0.3, 0.1, 0], [0.4, -0.1, 0.05], count) if moving else None
    ends = directions * random.uniform(0.3, reach, count)[:, None] + (0 if origins is None else origins)
    T = np.eye(4)
    T[:3, :3] = rotation_matrix(random.normal(size=3))
    T[:3, 3] = random.uniform(-30, 30, 3)
    return CheckedCloud(ends, origins, random.random(count) < 0.9, lidar or Lidar(0.03), T)


def reference_of(cloud, config):
    cells, log_odds = naive_integrators.cast_points(cloud, config, make_sensor(config.sensor))
    return dict(zip(map(tuple, cells.tolist()), np.rint(1000 * log_odds).astype(int).tolist(), strict=True))


def share_that_differs(ours, theirs, tolerance):
    keys = ours.keys() | theirs.keys()
    return sum(abs(ours.get(k, 0) - theirs.get(k, 0)) > tolerance for k in keys) / len(keys)


@pytest.mark.parametrize("model", SENSORS)
@pytest.mark.parametrize("voxel_size", [0.4, 0.1])
@pytest.mark.parametrize("moving", [False, True])
def test_points_equal_their_reference(model, voxel_size, moving):
    config = load_config(voxel_size=voxel_size, max_range=3.0, **{"sensor.model": model})
    for seed in range(3):
        cloud = made_cloud(seed, moving=moving)
        if moving:  # rays begin at rounded places; these are
            T, grain = cloud.T_world_sensor, voxel_size / 16
            T[:3, :3], T[:3, 3] = np.eye(3), np.rint(T[:3, 3] / grain) * grain
            cloud = replace(cloud, origins=np.rint(cloud.origins / grain) * grain)
        ours, theirs = cells_of(Points(config).evidence(cloud)), reference_of(cloud, config)
        assert len(theirs) > 500
        # float32 against float64: a few rays graze cells, or end on a table column's edge
        assert share_that_differs(ours, theirs, tolerance=25) < 0.003
        assert share_that_differs(ours, theirs, tolerance=2) < 0.03


def test_cells_may_be_boxes():
    config = load_config(steps=(0.2, 0.2, 0.1), max_range=3.0)
    cloud = made_cloud(4)
    assert share_that_differs(cells_of(Points(config).evidence(cloud)), reference_of(cloud, config), 25) < 0.003


def test_far_cells_have_wide_keys():
    config = load_config(voxel_size=0.05, max_range=80.0)
    cloud = made_cloud(5, count=40, reach=75.0)
    ours, theirs = cells_of(Points(config).evidence(cloud)), reference_of(cloud, config)
    assert max(abs(np.array(list(ours)) - np.floor(cloud.T_world_sensor[:3, 3] / 0.05)).ravel()) > 600
    assert share_that_differs(ours, theirs, tolerance=25) < 0.01


def test_neither_the_order_of_points_nor_threads_matter():
    cloud, order = made_cloud(6, moving=True), np.random.default_rng(0).permutation(300)
    shuffled = replace(cloud, ends=cloud.ends[order], origins=cloud.origins[order], hits=cloud.hits[order])
    expected = cells_of(Points(load_config(threads=1)).evidence(cloud))
    assert expected
    for threads in (1, 3):
        points = Points(load_config(threads=threads))
        for one in (shuffled, cloud, shuffled):  # its memory is used again
            assert cells_of(points.evidence(one)) == expected


def test_a_hit_outweighs_whatever_passes():
    ends = np.array([[2.0, 0.0, 0.0], *([4.0, 0.0, 0.01 * k] for k in range(1, 6))])
    cloud = CheckedCloud(ends, None, np.ones(6, bool), Lidar(0.02), np.eye(4))
    T = np.eye(4)
    T[:3, 3] = 0.05
    found = cells_of(Points(load_config(voxel_size=0.1)).evidence(replace(cloud, T_world_sensor=T)))
    assert found[20, 0, 0] > 0
    assert found[10, 0, 0] < 0
    assert found[30, 0, 0] < 0


def test_rays_without_a_surface_are_free_to_their_end_and_no_further():
    T = np.eye(4)
    T[:3, 3] = 0.05
    cloud = CheckedCloud(np.array([[2.0, 0.0, 0.0]]), None, np.zeros(1, bool), Lidar(0.02), T)
    config = load_config(voxel_size=0.1, max_range=3.0)
    found = cells_of(Points(config).evidence(cloud))
    middles = {k: 0.1 * k if k else 0.025 for k in range(20)} | {20: 1.975}  # metres from the sensor, on the ray
    assert set(found) == {(k, 0, 0) for k, middle in middles.items() if middle > config.blind + 1e-6}
    assert max(found.values()) < 0


def test_a_point_beyond_the_maximum_range_frees_what_its_noise_allows():
    T = np.eye(4)
    T[:3, 3] = 0.05
    cloud = CheckedCloud(np.array([[3.1, 0.0, 0.0]]), None, np.ones(1, bool), Lidar(0.2), T)
    found = cells_of(Points(load_config(voxel_size=0.1, max_range=3.0)).evidence(cloud))
    assert max(found.values()) < 0
    assert max(x for x, _, _ in found) == 23  # 3.1 - 4 * 0.2, from 0.05


def test_more_cells_than_can_be_counted_are_refused(monkeypatch):
    monkeypatch.setattr("stereovox.integrate.points.MAX_BLOCKS", 8192)
    with pytest.raises(FrameRefused, match="lower max_range"):
        Points(load_config(voxel_size=0.01, max_range=4.0)).evidence(made_cloud(7, count=2000))


def test_graphics_cards_take_no_clouds(monkeypatch):
    integration = Integration(load_config())
    monkeypatch.setattr(integration, "_config", load_config(device="cuda"))
    with pytest.raises(FrameRefused, match="processor only"):
        integration.evidence(made_cloud(8))
