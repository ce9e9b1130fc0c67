# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from stereovox.config.robot import AmclConfig
from stereovox.frame import Scan
from stereovox.geometry import se2
from stereovox.localize.amcl import _amcl
from stereovox.localize.amcl.particles import BeamModel, FieldModel, beam_likelihood, distance_field
from stereovox.localize.track import beams_of
from stereovox.maps.occupancy import OccupancyGrid

CONFIG = AmclConfig(z_hit=0.6, z_short=0.2, z_max=0.05, z_rand=0.15, sigma_hit=0.15, lambda_short=0.4)
ORIGIN = (-1.0, 0.5, 0.3)
MOUNT = se2.lifted((0.2, -0.1, 0.5))


def some_map(seed=0, share=0.03):
    rng = np.random.default_rng(seed)
    cells = np.where(rng.random((40, 50)) < share, 100, 0).astype(np.int8)
    return OccupancyGrid(cells, 0.1, ORIGIN)


def some_poses(count, rng):
    local = np.column_stack([rng.uniform(0.2, 4.8, count), rng.uniform(0.2, 3.8, count), rng.uniform(-3, 3, count)])
    return se2.compose(ORIGIN, local)


def some_scan(rng, count=9):
    ranges = rng.uniform(0.1, 3, count).astype(np.float32)
    ranges[:3] = np.inf, np.nan, -np.inf
    return Scan(ranges, -1.0, 0.25, 0.02, 3.0, np.eye(4), MOUNT)


def slow_cast(grid, start, angle, longest):
    """The way to the middle of the ray's piece in the first occupied cell, by small steps; and that piece's length."""
    ways = np.arange(0, longest, 2e-4)
    points = np.asarray(start) + ways[:, None] * [np.cos(angle), np.sin(angle)]
    rows, columns = grid.indices(points).T
    inside = (rows >= 0) & (columns >= 0) & (rows < grid.cells.shape[0]) & (columns < grid.cells.shape[1])
    inside = np.logical_and.accumulate(inside)
    hit = np.zeros(len(ways), bool)
    hit[inside] = grid.cells[rows[inside], columns[inside]] > 70
    if not hit.any():
        return longest, 1.0
    first = int(hit.argmax())
    same = hit & (rows == rows[first]) & (columns == columns[first])
    return (ways[first] + ways[same].max()) / 2, ways[same].max() - ways[first]


@pytest.mark.parametrize("share", [0.003, 0.03, 0.2])
def test_rays_end_where_small_steps_end(share):
    grid, rng = some_map(1, share), np.random.default_rng(2)
    clear = distance_field(grid, 10.0).distance_m / np.float32(0.1)
    poses = some_poses(60, rng)
    local = se2.relative(ORIGIN, poses)
    directions = np.column_stack([np.cos(local[:, 2]), np.sin(local[:, 2])]).astype(np.float32)
    found = np.empty(60, np.float32)
    _amcl.cast(clear, (local[:, :2] / 0.1).astype(np.float32), directions, np.float32(25), found)
    compared = 0
    for pose, way in zip(poses, found * 0.1, strict=True):
        expected, piece = slow_cast(grid, pose[:2], pose[2], 2.5)
        if piece > 2e-3:  # else the ray only brushes a corner, and either answer is right
            assert way == pytest.approx(expected, abs=2e-3)
            compared += 1
    assert compared > 50


@pytest.mark.parametrize("angle", [0, np.pi / 2, np.pi, -np.pi / 2])
def test_rays_along_the_axes(angle):
    cells = np.zeros((11, 11), np.int8)
    cells[[5, 10, 5, 0], [10, 5, 0, 5]] = 100
    clear = distance_field(OccupancyGrid(cells, 1.0), 99.0).distance_m
    found = np.empty(1, np.float32)
    direction = np.array([[np.cos(angle), np.sin(angle)]], np.float32)
    _amcl.cast(clear, np.full((1, 2), 5.5, np.float32), direction, np.float32(50), found)
    assert found[0] == pytest.approx(5.0, abs=0.01)
    _amcl.cast(clear, np.full((1, 2), 3.5, np.float32), direction, np.float32(50), found)
    assert found[0] == 50  # out of the map


def test_the_field_model_is_table_6_3():
    grid, rng = some_map(), np.random.default_rng(3)
    scan = some_scan(rng)
    poses = np.concatenate([some_poses(30, rng), [[40.0, -40, 1]]])
    model = FieldModel(grid, AmclConfig(**{**CONFIG.model_dump(), "field_distance": 0.6}))
    found = model.log_likelihood(poses, beams_of(scan).some(60, model.hits_only))
    rows, columns = np.nonzero(grid.cells > 70)
    for pose, value in zip(poses, found, strict=True):
        q = 1.0
        for angle, z in zip(scan.angles, scan.ranges, strict=True):
            if not np.isfinite(z):
                continue
            sensor = se2.compose(pose, (0.2, -0.1, 0.5))
            end = sensor[:2] + z * np.array([np.cos(sensor[2] + angle), np.sin(sensor[2] + angle)])
            row, column = grid.indices([end])[0]
            inside = 0 <= row < 40 and 0 <= column < 50
            distance = min(0.6, 0.1 * np.hypot(rows - row, columns - column).min()) if inside else 0.6
            normal = math.exp(-(distance**2) / (2 * 0.15**2)) / math.sqrt(2 * math.pi * 0.15**2)
            q *= 0.6 * normal + 0.15 / 3.0
        assert value == pytest.approx(math.log(q), abs=1e-3)


def test_the_beam_model_is_table_6_1_by_slow_rays():
    grid, rng = some_map(), np.random.default_rng(4)
    scan, poses = some_scan(rng), some_poses(12, rng)
    found = BeamModel(grid, CONFIG).log_likelihood(poses, beams_of(scan))
    for pose, value in zip(poses, found, strict=True):
        total, sensor = 0.0, se2.compose(pose, (0.2, -0.1, 0.5))
        for angle, z in zip(scan.angles, scan.ranges, strict=True):
            if np.isfinite(z) or z == np.inf:
                expected, _ = slow_cast(grid, sensor[:2], sensor[2] + angle, 3.0)
                total += math.log(beam_likelihood(min(z, 3.0), z == np.inf, expected, 3.0, CONFIG))
        assert value == pytest.approx(total, abs=0.15)


@pytest.mark.parametrize("expected", [0.1, 0.7, 2.0, 2.9, 3.0])
def test_the_beam_model_is_a_distribution(expected):
    z = (np.arange(300_000) + 0.5) * 1e-5
    config = AmclConfig(**{**CONFIG.model_dump(), "z_hit": 0.95, "z_short": 0.1})  # of sum 1.25: not as printed
    density = beam_likelihood(z, False, expected, 3.0, config)
    whole = density.sum() * 1e-5 + float(beam_likelihood(3.0, True, expected, 3.0, config))
    assert whole == pytest.approx(1, abs=1e-4)


def test_each_part_of_the_beam_model_is_that_of_the_book():
    def at(z, **shares):
        none = {"z_hit": 1e-12, "z_short": 0, "z_max": 0, "z_rand": 1e-12}
        config = AmclConfig(**{**none, "sigma_hit": 0.15, "lambda_short": 0.4, **shares})
        return float(beam_likelihood(z, z >= 3, 2.0, 3.0, config))

    below = 0.5 * (1 + math.erf(2.0 / 0.15 / math.sqrt(2)))
    assert at(1.9, z_hit=1) == pytest.approx(
        math.exp(-(0.1**2) / (2 * 0.15**2)) / math.sqrt(2 * math.pi * 0.15**2) / below
    )
    assert at(1.5, z_short=1) == pytest.approx(0.4 * math.exp(-0.4 * 1.5) / (1 - math.exp(-0.4 * 2.0)))
    assert at(2.1, z_short=1) < 1e-9
    assert at(3.0, z_max=0.7, z_rand=0.3) == pytest.approx(0.7, abs=1e-6)
    assert at(1.0, z_rand=1) == pytest.approx(1 / 3)


def test_the_beam_model_takes_the_shares_in_proportion():
    z, at_max = np.append(np.linspace(0.1, 2.9, 15), 3.0), np.arange(16) == 15
    half = {name: getattr(CONFIG, name) / 2 for name in ("z_hit", "z_short", "z_max", "z_rand")}
    halved = AmclConfig(**{**CONFIG.model_dump(), **half})
    whole, half_as_much = (beam_likelihood(z, at_max, 2.0, 3.0, config) for config in (CONFIG, halved))
    assert np.allclose(whole, half_as_much, rtol=1e-12, atol=0)


def test_the_field_model_knows_two_shares_only():
    others = AmclConfig(**{**CONFIG.model_dump(), "z_short": 0.9, "z_max": 0.9})
    beams, poses = beams_of(some_scan(np.random.default_rng(5))), some_poses(9, np.random.default_rng(6))
    found = [FieldModel(some_map(), config).log_likelihood(poses, beams) for config in (CONFIG, others)]
    assert np.array_equal(*found)


@pytest.mark.parametrize("model", [FieldModel, BeamModel])
def test_beams_agree_with_the_particles_that_they_fit(model):
    cells = np.zeros((50, 50), np.int8)
    cells[:, 40] = 100
    sensor = model(OccupancyGrid(cells, 0.1), AmclConfig(beam_skip_distance=0.25))
    scan = Scan(np.array([2.05, 1.0, np.inf], np.float32), 0.0, 1e-9, 0.02, 3.0, np.eye(4))
    particles = np.array([[2.0, 2, 0], [2.2, 2.5, 0], [1.8, 2, 0], [1.7, 2, 0], [2.3, 2, 0]])
    fits = sensor.agreeing(particles, beams_of(scan).some(9, sensor.hits_only))
    assert fits.tolist() == ([0.6, 0.0] if sensor.hits_only else [0.6, 0.0, 1.0])
    one = sensor.agreeing(particles[2:4], beams_of(scan))[0]
    assert one == 0.5  # column 38 does and 37 does not
