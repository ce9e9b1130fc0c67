# SPDX-License-Identifier: Apache-2.0
"""Distances of sonars: free inside the cone, something on the arc, and nothing said of what is beyond."""

from dataclasses import replace
from math import inf, nan, pi, radians

import naive_integrators
import numpy as np
import pytest
from made_images import cells_of

import stereovox as sv
from stereovox.depth.cloud import checked_cloud, cloud_of, directions
from stereovox.errors import StereovoxError
from stereovox.geometry.se3 import rotation_matrix
from stereovox.integrate.points import Points
from stereovox.sensors.models import Arc

SMALL = {"voxel_size": 0.1, "max_range": 5.0}
SONAR = sv.RangeSensor(beam=radians(30))
WALL_M = 2.03


def pose(x=0.0, y=0.0, z=0.5, yaw_deg=0.0, pitch_deg=0.0):
    T = np.eye(4)
    T[:3, :3] = rotation_matrix([0, 0, radians(yaw_deg)]) @ rotation_matrix([0, radians(pitch_deg), 0])
    T[:3, 3] = x, y, z
    return T


def echo(T, beam=SONAR):
    """Return the distance of the nearest point of a wall at x = WALL_M in the cone, by the angle between them."""
    off = np.arccos(np.clip(T[0, 0], -1, 1))
    return (WALL_M - T[0, 3]) / np.cos(max(off - beam.beam / 2, 0.0))


def evidence_of(seen, **settings):
    config = sv.load_config(**{**SMALL, **settings})
    return Points(config).evidence(checked_cloud(cloud_of(seen, config), config)), config


def walk(seed, mapper, count=200, **changes):
    """Let a sonar drive past a wall and look about; return what became of it."""
    rng, reports = np.random.default_rng(seed), []
    for k in range(count):
        T = pose(rng.uniform(0, 0.8), 2 * k / count - 1, 0.5, rng.uniform(-25, 25), rng.uniform(-10, 10))
        seen = sv.Range(echo(T) + rng.normal(0, SONAR.sigma), T, 10**8 * k, SONAR, **changes)
        reports.append(mapper.add(seen))
    return reports


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("beam_deg", "distance"), [(30, 1.7), (12, 2.6), (60, 0.9)])
def test_cells_are_those_of_the_slow_twin(seed, beam_deg, distance):
    """Before the arc the model's free value, on it the echo's share, and beyond nothing."""
    rng = np.random.default_rng(seed)
    T = pose(*rng.uniform(-3, 3, 3), rng.uniform(-180, 180), rng.uniform(-80, 80))
    beam = sv.RangeSensor(0.02, beam=radians(beam_deg))
    evidence, config = evidence_of(sv.Range(distance, T, beam=beam))
    ours = cells_of(evidence)
    before, arc, outside = naive_integrators.cone(distance, T, beam.beam, beam.sigma, config)
    assert len(before) > 5
    assert len(arc) > 10
    assert {ours.get(cell) for cell in before} == {round(1000 * np.log(0.345 / 0.655))}
    assert not any(cell in ours for cell in outside)
    (value,) = {ours.get(cell) for cell in arc}
    (share,) = set(arc.values())
    q = share * stays(beam.sigma / 0.1)  # that its noise leaves it in its cell
    p = 0.1 + 0.9 * q
    assert value == pytest.approx(800 * (np.log(p / (1 - p)) - np.log(1 / 9)), rel=0.06)  # the table's rows are 4 cm


def stays(ratio):
    """How often a point anywhere in a cell stays in it under noise, by trying."""
    at = np.random.default_rng(0).uniform(size=200_000)
    moved = at + np.random.default_rng(1).normal(0, ratio, 200_000)
    return np.mean((moved >= 0) & (moved < 1))


@pytest.mark.parametrize("seed", range(3))
def test_rays_of_a_cone_are_followed_as_by_the_slow_reference(seed):
    T = pose(*np.random.default_rng(seed).uniform(-3, 3, 3), 40, 10)
    seen = sv.Range(1.5, T, beam=SONAR)
    evidence, config = evidence_of(seen)
    model = Arc(SONAR.solid_angle)
    cells, log_odds = naive_integrators.cast_points(checked_cloud(cloud_of(seen, config), config), config, model)
    theirs = dict(zip(map(tuple, cells.tolist()), np.rint(1000 * log_odds).astype(int).tolist(), strict=True))
    ours = cells_of(evidence)
    keys = ours.keys() | theirs.keys()
    assert len(keys) > 100
    assert sum(abs(ours.get(k, 0) - theirs.get(k, 0)) > 25 for k in keys) / len(keys) < 0.01


@pytest.mark.parametrize("seed", [11, 12, 13])
def test_a_wall_is_found_within_what_the_cone_leaves_open_and_nothing_beyond_it_is_freed(seed):
    mapper = sv.Mapper(**SMALL)
    assert not any(report.refused for report in walk(seed, mapper, 300))
    occupied = mapper.map.occupied()
    assert len(occupied) > 15
    assert np.abs(occupied[:, 0] - WALL_M).max() < 0.1 + 2 * SONAR.sigma
    beyond = np.meshgrid([2.05, 2.15, 2.55, 3.05], np.arange(-1.95, 2, 0.1), np.arange(-0.95, 2, 0.1))
    assert not (mapper.map.state(np.column_stack([axis.ravel() for axis in beyond])) == sv.State.FREE).any()
    assert mapper.map.state([[1.5, 0.05, 0.55]]) == sv.State.FREE


def test_the_shares_of_an_arc_sum_to_one_echo_and_are_weak_where_it_is_wide():
    near, far = np.array([1.0]), np.array([3.0])
    for width in (radians(10), radians(30)):
        model = Arc(2 * pi * (1 - np.cos(width / 2)), trust=1.0)
        for z in (near, far):
            p = model.hit(z, np.array([1e-6]), 0.1)
            odds = p / (1 - p) / 9  # a cell's own: from a prior of 0.1
            q = (odds / (1 + odds) - 0.1) / 0.9
            cells = model.solid_angle * z**2 / 0.01
            assert q * cells == pytest.approx(0.9, rel=1e-4)
    wide, narrow = Arc(1.0), Arc(0.1)
    assert 0.5 < wide.hit(far, near, 0.1) < wide.hit(near, near, 0.1) < narrow.hit(near, near, 0.1)


def test_directions_fill_the_cone_evenly():
    rays = directions(radians(40), 3000)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1, atol=1e-12)
    off = np.arccos(rays[:, 0])
    assert off.max() == pytest.approx(radians(20), rel=0.01)
    for within in (radians(5), radians(10), radians(15)):
        assert (off < within).mean() == pytest.approx((1 - np.cos(within)) / (1 - np.cos(radians(20))), rel=0.03)
    np.testing.assert_allclose(rays.mean(axis=0)[1:], 0, atol=2e-3)


@pytest.mark.parametrize("distance", [nan, -inf, inf, 0.1, 4.01, -1.0])
def test_what_is_no_distance_changes_nothing(distance):
    mapper = sv.Mapper(**SMALL)
    report = mapper.add(sv.Range(distance, pose(), beam=SONAR))
    assert report.refused == "no_valid_range"
    assert sum(mapper.map.counts().values()) == 0


def test_silence_clears_only_for_sensors_that_hear_everything():
    hears = sv.RangeSensor(0.05, 0.2, 3.0, radians(20), silence_clears=True)
    mapper = sv.Mapper(**SMALL)
    for k in range(5):
        assert not mapper.add(sv.Range(inf, pose(0.05, 0.05, 0.55), 10**8 * k, hears)).refused
    counts = mapper.map.counts()
    assert counts["free"] > 100
    assert not counts["occupied"] + counts["tentative"]
    states = mapper.map.state([[2.75, 0.05, 0.55], [2.95, 0.05, 0.55]])
    assert states.tolist() == [sv.State.FREE, sv.State.UNKNOWN]


def test_nothing_is_cleared_nearer_than_it_measures():
    mapper, beam = sv.Mapper(**SMALL), sv.RangeSensor(range_min=0.8, beam=radians(20))
    assert not mapper.add(sv.Range(2.0, pose(0.05, 0.05, 0.55), beam=beam)).refused
    states = mapper.map.state([[x, 0.05, 0.55] for x in (0.55, 0.75, 0.95, 1.25)])
    assert states.tolist() == 2 * [sv.State.UNKNOWN] + 2 * [sv.State.FREE]


def wall_of_a_camera(mapper):
    """Map a small plate a metre ahead, as a camera sees it."""
    camera = sv.PinholeCamera(64, 48, 60.0, 60.0, 31.5, 23.5, 0.1)
    T = np.eye(4)
    T[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    T[:3, 3] = 0.05, 0.05, 0.55
    for k in range(20):
        noise = np.random.default_rng(k).normal(0, 0.002, (48, 64))
        mapper.add(sv.Frame((1.0 + noise).astype(np.float32), camera, T, 10**8 * k, sensor="camera"))


def test_a_sonar_does_not_clear_what_a_camera_is_sure_of():
    """It hears nothing of a sofa, and the wall behind it."""
    mapper = sv.Mapper(**SMALL)
    wall_of_a_camera(mapper)
    plate = [[1.05, 0.05, 0.55]]
    assert mapper.map.state(plate) == sv.State.OCCUPIED
    before = mapper.map.log_odds(plate)
    for k in range(60):
        assert not mapper.add(sv.Range(2.0, pose(0.05, 0.05, 0.55), 3 * 10**9 + 10**8 * k, SONAR)).refused
    assert mapper.map.log_odds(plate) == before


@pytest.mark.parametrize("noise", [0.0, 0.03])
def test_a_sonar_at_rest_makes_no_wall_of_its_arc_however_often_it_hears_it(noise):
    """Its echoes are one look: the map is that of the first one, but that noise takes back free cells near the arc."""
    rng = np.random.default_rng(4)
    mapper, once = sv.Mapper(**SMALL), sv.Mapper(**SMALL)
    once.add(sv.Range(1.5, pose(0.0, 0.05, 0.55), 0, SONAR))
    for k in range(300):
        distance = 1.5 + (np.clip(rng.normal(0, noise), -0.06, 0.06) if k else 0.0)
        jitter = rng.uniform(-0.01, 0.01, 2) if k and noise else (0.0, 0.0)
        at_rest = pose(jitter[0], 0.05 + jitter[1], 0.55, rng.uniform(-1, 1) if k and noise else 0.0)
        assert mapper.add(sv.Range(distance, at_rest, 10**8 * k, SONAR)).refused is None
    assert mapper.map.counts()["occupied"] == 0
    (blocks, ours), (same, theirs) = mapper.map.storage.blocks(), once.map.storage.blocks()
    np.testing.assert_array_equal(blocks, same)
    more = ours != theirs
    assert more.any() == (noise > 0)
    assert (ours[more] > theirs[more]).all()
    assert (theirs[more] <= mapper.map.storage.rules.thresholds.free_most).all()
    assert (mapper.map.frames, mapper.health().state) == (300, "current")
    arc = [[1.45, 0.05, 0.55], [1.45, 0.15, 0.65]]
    assert (once.map.state(arc) == sv.State.TENTATIVE).all()
    free, prior = once.map.log_odds([[1.0, 0.05, 0.55]]), once.map.config.map.prior
    assert (once.map.log_odds(arc) > np.log(prior / (1 - prior))).all()
    assert free < np.log(prior / (1 - prior))
    assert (mapper.map.state([[x, 0.05, 0.55] for x in (1.75, 2.0, 3.0)]) == sv.State.UNKNOWN).all()


def test_what_comes_before_a_sonar_at_rest_is_soon_no_free_space_and_what_goes_is_free_again():
    mapper = sv.Mapper(**SMALL)

    def hear(distance, count):
        for _ in range(count):
            assert not mapper.add(sv.Range(distance, pose(0.0, 0.05, 0.55), 10**8 * mapper.map.frames, SONAR)).refused
        return mapper.map.state([[1.45, 0.05, 0.55]])[0]

    assert hear(3.0, 20) == sv.State.FREE
    assert hear(1.5, 10) == sv.State.TENTATIVE
    assert hear(1.5, 300) == sv.State.TENTATIVE
    assert hear(3.0, 2) == sv.State.FREE
    assert mapper.map.counts()["occupied"] == 0


def test_equal_distances_from_elsewhere_are_no_frozen_sensor():
    mapper = sv.Mapper(**SMALL)
    reports = [mapper.add(sv.Range(1.5, pose(0, 0.05 * k), 10**8 * k, SONAR)) for k in range(10)]
    assert [report.refused for report in reports] == 10 * [None]


def test_corrected_poses_make_the_map_of_a_new_run(tmp_path):
    """Also after the map was saved: the sensor's cone is kept with its rays."""
    mapper = sv.Mapper(**SMALL, **{"map.keep_frames": True})
    walk(5, mapper, 60)
    mapper.save(tmp_path / "a.svox")
    again = sv.Mapper(resume=sv.load_map(tmp_path / "a.svox"), **SMALL, **{"map.keep_frames": True})
    poses = {frame.stamp_ns: frame.T_world_sensor @ pose(0, 0.02 * n, 0) for n, frame in enumerate(kept(again))}
    again.correct(poses)
    fresh = sv.Mapper(**SMALL, **{"trust.frozen": False})
    for frame in kept(mapper):
        seen = frame.frame()
        assert isinstance(seen.lidar, sv.RangeSensor)
        assert not fresh.add(replace(seen, T_world_sensor=poses[frame.stamp_ns])).refused
    for ours, theirs in zip(again.map.storage.blocks(), fresh.map.storage.blocks(), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def kept(mapper):
    return mapper.map.storage.kept.frames


@pytest.mark.parametrize(
    "given", [{"beam": 0.0}, {"beam": 4.0}, {"range_max": inf}, {"sigma": 0.0}, {"range_min": 5.0}]
)
def test_sensors_that_cannot_be_are_refused(given):
    with pytest.raises(StereovoxError):
        sv.RangeSensor(**given)
