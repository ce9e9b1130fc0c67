# SPDX-License-Identifier: Apache-2.0
"""Distances of sonars in a grid of the floor: free inside the cone, something on the arc, and nothing said beyond."""

from math import inf, pi, radians

import naive_integrators
import numpy as np
import pytest

import stereovox as sv
from stereovox.depth.cloud import level_range
from stereovox.frame import Scan
from stereovox.geometry import se2
from stereovox.geometry.se3 import rotation_matrix
from stereovox.integrate.beams import cone_evidence
from stereovox.mapper import GridMapper
from stereovox.maps.grid_map import load_grid

SMALL = {"voxel_size": 0.05, "max_range": 4.0}
SONAR = sv.RangeSensor(beam=radians(30))


def pose(x=0.0, y=0.0, yaw_deg=0.0, z=0.3, lean_deg=0.0):
    T = se2.lifted([x, y, radians(yaw_deg)])
    T[:3, :3] = T[:3, :3] @ rotation_matrix([0, radians(lean_deg), 0])
    T[2, 3] = z
    return T


def mapped(readings, **settings):
    mapper = GridMapper(**SMALL, **settings)
    reports = [mapper.add(sv.Range(z, T, 10**8 * k, SONAR)) for k, (z, T) in enumerate(readings)]
    assert not [report.detail for report in reports if report.refused]
    return mapper


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("beam_deg", "distance"), [(30, 1.7), (12, 2.6), (100, 0.9), (200, 0.7)])
def test_cells_are_those_of_the_slow_twin(seed, beam_deg, distance):
    rng = np.random.default_rng(seed)
    config, beam = sv.load_config(**SMALL), sv.RangeSensor(0.02, beam=radians(min(beam_deg, 180)))
    T = pose(*rng.uniform(-3, 3, 2), rng.uniform(-180, 180), lean_deg=rng.uniform(-4, 4))
    origin = (*rng.uniform(-1, 1, 2), rng.uniform(-pi, pi))
    seen = level_range(sv.Range(distance, T, beam=beam), config)
    indices, values = cone_evidence(seen, config, origin).cells()
    ours = dict(zip(map(tuple, indices.tolist()), values.tolist(), strict=True))
    before, arc, outside = naive_integrators.flat_cone(distance, T, beam, origin, config)
    assert len(before) > 10
    assert len(arc) > 2
    assert {ours.get(cell) for cell in before} == {round(1000 * np.log(0.345 / 0.655))}
    assert not any(cell in ours for cell in outside)
    (value,) = {ours.get(cell) for cell in arc}
    assert value == pytest.approx(next(iter(arc.values())), abs=6)  # the noise's share is found there by trying


def test_a_wall_is_found_from_several_places_and_nothing_beyond_it_is_freed():
    rng, wall, readings = np.random.default_rng(3), 2.03, []
    for k in range(300):
        x, yaw = rng.uniform(0, 0.8), radians(rng.uniform(-25, 25))
        z = (wall - x) / np.cos(max(abs(yaw) - SONAR.beam / 2, 0.0)) + rng.normal(0, SONAR.sigma)
        readings.append((z, pose(x, 2 * k / 300 - 1, np.degrees(yaw))))
    grid = mapped(readings).map
    x, y = np.meshgrid(np.arange(-1, 4, 0.05) + 0.025, np.arange(-1.5, 1.5, 0.05) + 0.025)
    states = grid.state(np.column_stack([x.ravel(), y.ravel()]))
    occupied = x.ravel()[states == sv.State.OCCUPIED]
    assert len(occupied) > 20
    assert np.abs(occupied - wall).max() < 0.1 + 2 * SONAR.sigma
    assert not (x.ravel()[states == sv.State.FREE] > wall + 0.05).any()
    assert grid.state([[1.5, 0.02]]) == sv.State.FREE


def test_a_sonar_at_rest_makes_no_wall_of_its_arc_however_often_it_hears_it():
    rng = np.random.default_rng(1)
    grid = mapped([(1.5 + rng.uniform(-0.05, 0.05), pose()) for _ in range(200)]).map
    once = mapped([(1.5, pose())]).map
    assert grid.counts()["occupied"] == 0
    assert grid.log_odds([[1.0, 0.02]]) == once.log_odds([[1.0, 0.02]]) == np.float32(-0.641)


def lidar_scan(stamp_ns, wall=1.0):
    angles = -pi / 2 + np.arange(361) * pi / 360
    ranges = np.where(np.abs(angles) < 1.2, wall / np.cos(angles), 5.0).astype(np.float32)
    ranges += np.random.default_rng(stamp_ns % 97).normal(0, 0.003, 361).astype(np.float32)
    return Scan(ranges, -pi / 2, pi / 360, 0.1, 10.0, pose(z=0.2), stamp_ns=stamp_ns)


def test_a_sonar_does_not_clear_what_a_lidar_is_sure_of_and_no_comparison_ends_for_it():
    """It hears the wall behind a sofa; the lidar's own faults are noticed as before, although it is 10 cm lower."""
    mapper = GridMapper(**SMALL)
    for k in range(20):
        assert not mapper.add(lidar_scan(10**8 * k)).refused
    sofa = [[1.02, 0.02]]
    before = mapper.map.log_odds(sofa)
    for k in range(60):
        T = pose(0.002 * k, 0.01 * (k % 9), yaw_deg=k % 7)
        assert not mapper.add(sv.Range(2.0, T, 2 * 10**9 + 10**8 * k, SONAR)).refused
    assert mapper.map.log_odds(sofa) == before
    assert mapper.add(lidar_scan(9 * 10**9, wall=0.5)).refused == "disagrees_with_map"


@pytest.mark.parametrize("distance", [np.nan, -inf, inf, 0.1, 4.01])
def test_what_is_no_distance_changes_nothing(distance):
    mapper = GridMapper(**SMALL)
    assert mapper.add(sv.Range(distance, pose(), beam=SONAR)).refused == "no_valid_range"
    assert sum(mapper.map.counts().values()) == 0


def test_silence_clears_for_sensors_that_hear_everything_alone():
    hears = sv.RangeSensor(0.05, 0.2, 3.0, radians(20), silence_clears=True)
    mapper = GridMapper(**SMALL)
    for k in range(6):
        assert not mapper.add(sv.Range(inf, pose(0, 0.06 * (k % 2)), 10**8 * k, hears)).refused
    assert (mapper.map.cells()[1] < 0).all()
    states = mapper.map.state([[0.12, 0.02], [2.7, 0.02], [2.92, 0.02]])
    assert states.tolist() == [sv.State.UNKNOWN, sv.State.FREE, sv.State.UNKNOWN]


def test_a_range_beyond_the_maps_own_is_free_up_to_there_and_marks_nothing():
    mapper = GridMapper(**{**SMALL, "max_range": 2.0})
    for k in range(6):
        assert not mapper.add(sv.Range(3.0, pose(0, 0.06 * (k % 2)), 10**8 * k, SONAR)).refused
    assert mapper.map.counts()["free"] > 100
    assert (mapper.map.cells()[1] < 0).all()


def test_a_saved_grid_knows_its_cones(tmp_path):
    mapper = mapped([(1.5, pose())])
    mapper.save(tmp_path / "a.npz")
    assert load_grid(tmp_path / "a.npz").history.cones == {"range": 1}
