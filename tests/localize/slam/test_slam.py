# SPDX-License-Identifier: Apache-2.0
"""SLAM as a whole: loops closed, wrong ones not believed, one wall where there is one, online and at the end."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_drives import along, box, drive, ring

from stereovox.config import load_config
from stereovox.errors import ConfigError, MissingExtra, StereovoxError
from stereovox.evaluate.trajectory import read_relations, relation_errors
from stereovox.geometry import se2
from stereovox.localize.slam.pipeline import SCANS_PER_KEYFRAME, KeyframeMap, Slam, map_scans
from stereovox.mapper import GridMapper
from stereovox.maps import State
from stereovox.sources.robots.carmen import CarmenLog

DATA = Path(__file__).resolve().parents[4] / "shared/data/carmen"
ROUND = [(1, 1), (13, 1), (13, 9), (1, 9), (1, 1), (13, 1), (13, 4)]


def apart(found, true):
    """Metres between poses, both as seen from their first."""
    left = se2.relative(se2.relative(true[0], true), se2.relative(found[0], found))
    return np.hypot(left[:, 0], left[:, 1])


@pytest.fixture(scope="module")
def loop():
    pytest.importorskip("gtsam")
    poses = along(ROUND)
    scans = drive(ring(), poses, drift=(1.03, 0.01))
    slam, live = Slam(load_config()), []
    for scan in scans:
        live.append(slam.add(scan))
    return poses, scans, np.array(live), slam.finish()


def test_a_loop_with_bad_odometry_is_mapped_to_centimetres(loop):
    poses, scans, live, result = loop
    odometry = np.array([scan.pose_world_base for scan in scans])
    assert apart(odometry, poses).max() > 3.0
    assert apart(live, poses).max() < 0.3
    error = apart(result.track.pose_map_base, poses)
    assert error.max() < 0.06
    assert np.sqrt(np.mean(error**2)) < 0.03


def test_loops_are_found_where_the_robot_came_by_again(loop):
    poses, _, _, result = loop
    assert result.closures >= 3
    at = result.track.stamps_ns.searchsorted([key.scan.stamp_ns for key in result.keyframes])
    for edge in result.edges:
        true = se2.relative(poses[at[edge.first]], poses[at[edge.second]])
        assert np.allclose(edge.motion[:2], true[:2], atol=0.1)
        assert abs(edge.motion[2] - true[2]) < 0.02
        assert result.keyframes[edge.second].travelled - result.keyframes[edge.first].travelled > 12


def test_walls_are_thin_and_where_they_are(loop):
    _poses, _, _, result = loop
    rows, columns = np.nonzero(result.grid.states == State.OCCUPIED)
    points = result.grid.centres(rows, columns)
    walls = ring()
    ends, ways = walls[:, :2], walls[:, 2:] - walls[:, :2]
    share = np.clip(((points[:, None] - ends) * ways).sum(-1) / (ways**2).sum(-1), 0, 1)
    gap = np.linalg.norm(points[:, None] - ends - share[..., None] * ways, axis=-1).min(axis=1)
    assert np.quantile(gap, 0.98) < 0.08
    length = np.linalg.norm(ways, axis=1).sum() / result.grid.resolution
    assert 0.6 * length < len(points) < 1.3 * length  # about one cell thick


def grid_of(scans):
    """The grid that a new mapper makes of keyframes' scans at the poses that they have."""
    odds = {p: (p / (1 - p)) ** SCANS_PER_KEYFRAME for p in (0.7, 0.4)}
    evidence = {"grid.p_occupied": odds[0.7] / (1 + odds[0.7]), "grid.p_free": odds[0.4] / (1 + odds[0.4])}
    slam = load_config().slam
    mapper = GridMapper(voxel_size=slam.voxel_size, max_range=slam.max_range, **evidence)
    for scan in scans:
        far = np.where(np.isposinf(scan.ranges), np.float32(np.nan), scan.ranges)
        assert mapper.add(replace(scan, ranges=far)).refused is None
    return mapper.occupancy()


def at(keyframe, pose):
    return replace(keyframe.scan, T_world_sensor=se2.lifted(pose) @ keyframe.scan.T_base_sensor)


def test_the_map_is_that_of_a_new_run_with_the_keyframes_where_they_are_now(loop):
    """Cell for cell: nothing is left of where they were before loops were closed."""
    _, scans, live, result = loop
    new = grid_of([at(keyframe, keyframe.pose) for keyframe in result.keyframes])
    assert np.allclose(new.origin, result.grid.origin, rtol=0, atol=1e-9)
    assert np.array_equal(new.cells, result.grid.cells)
    first_seen = live[np.searchsorted([s.stamp_ns for s in scans], [k.scan.stamp_ns for k in result.keyframes])]
    assert apart(np.array([key.pose for key in result.keyframes]), first_seen).max() > result.grid.resolution
    old = grid_of([at(*pair) for pair in zip(result.keyframes, first_seen, strict=True)])
    assert old.cells.shape != new.cells.shape or (old.cells != new.cells).sum() > 100


def test_the_track_turns_odometry_into_the_map(loop):
    _, scans, _, result = loop
    track = result.track
    assert np.array_equal(track.stamps_ns, [scan.stamp_ns for scan in scans])
    corrected = np.array([track.corrected(scan).pose_world_base for scan in scans])
    assert np.allclose(corrected[:, :2], track.pose_map_base[:, :2], atol=1e-6)


def test_the_same_scans_give_the_same_map():
    scans = drive(ring(), along(ROUND[:3], step=0.2), drift=(1.03, 0.01))
    first, second = (map_scans(scans, load_config()) for _ in range(2))
    assert np.array_equal(first.track.pose_map_base, second.track.pose_map_base)
    assert np.array_equal(first.grid.cells, second.grid.cells)


def test_a_bare_corridor_closes_no_loop():
    """Nothing tells where along it the robot is: every place looks like every other."""
    walls = np.array([[-100, -1, 100, -1], [-100, 1, 100, 1]], float)
    poses = along([(0, 0), (12, 0), (0, 0), (8, 0)], step=0.15)
    scans = drive(walls, poses, drift=(1.01, 0.0), limit=5.6)
    result = map_scans(scans, load_config())
    odometry = np.array([scan.pose_world_base for scan in scans])
    assert result.closures == 0
    assert apart(result.track.pose_map_base, poses).max() < apart(odometry, poses).max() + 0.1


def test_niches_all_alike_are_not_taken_for_each_other():
    """Closures one niche off look good: believed are none, or right ones."""
    niches = [box(1.5 * i, 1.0, 1.5 * i + 0.3, 1.3) for i in range(-20, 30)]
    walls = np.vstack([np.array([[-100, -1, 100, -1], [-100, 1.3, 100, 1.3]], float), *niches])
    poses = along([(0, 0), (14, 0), (0, 0)], step=0.15)
    scans = drive(walls, poses, drift=(1.02, 0.002), limit=5.6)
    result = map_scans(scans, load_config())
    assert apart(result.track.pose_map_base, poses).max() < 0.6


def test_mounts_and_far_origins_do_not_matter():
    poses = along(ROUND[:2], step=0.2)
    scans = drive(ring(), poses, drift=(1.03, 0.01))
    T_base_sensor, there = se2.lifted([0.3, 0.1, 0.4]), se2.lifted([5e4, -2e4, 1.0])
    moved = [
        replace(scan, T_world_sensor=there @ scan.T_world_sensor, T_base_sensor=T_base_sensor) for scan in scans
    ]  # the scanner stands where it stood, the robot elsewhere
    plain, other = map_scans(scans, load_config()), map_scans(moved, load_config())
    sensor = se2.compose(other.track.pose_map_base, [0.3, 0.1, 0.4])
    assert np.allclose(apart(sensor, plain.track.pose_map_base), 0, atol=0.02)


def test_what_cannot_be_used_is_counted_and_changes_nothing():
    scans = drive(ring(), along(ROUND[:2], step=0.2))
    bad = [
        replace(scans[5], fault="unreadable", fault_detail="scan 5: cut off"),
        replace(scans[5], T_world_sensor=np.full((4, 4), np.nan)),
        scans[2],
    ]
    clean, dirty = Slam(load_config()), Slam(load_config())
    for i, scan in enumerate(scans):
        pose = clean.add(scan)
        assert np.array_equal(pose, dirty.add(scan))
        if i == 5:
            assert all(np.array_equal(pose, dirty.add(one)) for one in bad)
    assert dirty.finish().refused == {"unreadable": 1, "pose_not_finite": 1, "not_in_order": 1}


def test_an_odometry_that_jumps_starts_anew():
    scans = drive(ring(), along(ROUND[:2], step=0.2))
    jump = se2.lifted([500, 0, 0])
    far = [replace(scan, T_world_sensor=jump @ scan.T_world_sensor) for scan in scans[30:]]
    result = map_scans([*scans[:30], *far[:20]], load_config())
    assert result.track.pose_map_base[-1, 0] > 400


def test_a_map_of_half_the_earth_is_refused():
    scans = drive(ring(), along(ROUND[:2], step=0.2))
    jump = se2.lifted([3e5, 0, 0])
    far = [replace(scan, T_world_sensor=jump @ scan.T_world_sensor) for scan in scans[10:20]]
    with pytest.raises(StereovoxError, match="does its odometry jump"):
        map_scans([*scans[:10], *far], load_config())


def test_blind_scans_follow_the_odometry():
    scans = drive(ring(), along(ROUND[:2], step=0.2), drift=(1.03, 0.0))
    blind = [replace(scan, ranges=np.full_like(scan.ranges, np.inf)) for scan in scans[20:24]]
    slam = Slam(load_config())
    for scan in scans[:20]:
        slam.add(scan)
    before = slam.pose
    for scan in blind:
        slam.add(scan)
    step = se2.relative(scans[19].pose_world_base, scans[23].pose_world_base)
    assert np.allclose(se2.relative(before, slam.pose), step, atol=1e-9)


def test_nothing_to_map_is_one_line():
    with pytest.raises(StereovoxError, match="not one of the scans could be used"):
        map_scans([], load_config())


def test_settings_that_need_too_much_memory_are_refused():
    with pytest.raises(ConfigError, match="2000 cells"):
        load_config(**{"slam.max_range": 500.0})


def test_without_gtsam_the_way_is_still_followed(monkeypatch):
    monkeypatch.setitem(sys.modules, "gtsam", None)
    poses = along(ROUND[:3], step=0.2)
    result = map_scans(drive(ring(), poses, drift=(1.03, 0.01)), load_config())
    assert result.closures == 0
    assert apart(result.track.pose_map_base, poses).max() < 0.3
    with pytest.raises(MissingExtra, match="slam"):
        map_scans(drive(ring(), along(ROUND), drift=(1.03, 0.01), beams=91), load_config())


def test_aces_slice():
    log, relations = DATA / "aces.clf.bz2", DATA / "aces.relations"
    if not log.exists():
        pytest.skip("no ../shared/data/carmen")
    result = map_scans(CarmenLog(str(log)).scans[:1500], load_config())
    errors = relation_errors(read_relations(relations), result.track.stamps_ns, result.track.pose_map_base)
    assert len(errors.metres) > 200
    assert errors.metres.mean() < 0.045


def test_a_robot_that_stands_still_has_a_map_too(loop):
    _, scans, _, _ = loop
    still = [replace(scans[0], stamp_ns=scan.stamp_ns) for scan in scans[:20]]
    states = map_scans(still, load_config()).grid.states
    assert (states == State.FREE).sum() > 100
    assert (states == State.OCCUPIED).sum() > 20


def test_the_map_on_the_way_is_that_of_all_keyframes_whether_they_moved_or_not(loop):
    _, _, _, result = loop
    keyframes, config = result.keyframes[:60], load_config()
    growing = KeyframeMap(config)
    growing.grid(keyframes[:30])
    grown, whole = growing.grid(keyframes), KeyframeMap(config).grid(keyframes)
    np.testing.assert_array_equal(grown.cells, whole.cells)
    moved = [replace(one, pose=se2.compose([0.4, 0.0, 0.1], one.pose)) for one in keyframes]
    bent, anew = growing.grid(moved), KeyframeMap(config).grid(moved)
    np.testing.assert_array_equal(bent.cells, anew.cells)
    assert bent.cells.shape != grown.cells.shape or (bent.cells != grown.cells).any()
