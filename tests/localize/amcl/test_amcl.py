# SPDX-License-Identifier: Apache-2.0
import weakref
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from stereovox import load_config
from stereovox.errors import ConfigError, FrameRefused, MapFileError, SourceError
from stereovox.frame import Scan
from stereovox.geometry import se2
from stereovox.localize.amcl.localise import Clock, Localiser, localise
from stereovox.localize.track import beams_of
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.simulate.floors.plan import FloorPlan, block
from stereovox.simulate.floors.view import cast

PLAN = FloorPlan(
    [(0, 0, 4, 3), (4, 1, 9, 2.4), (9, 0, 13, 3), (6, 2.4, 7.2, 5)],
    [block("things", "box", (9.9, 0.4, 10.7, 0.8), (0, 1))],
)
"""Two rooms of the same size at the ends of a corridor, one with a box in it."""
GRID = PLAN.truth(0.05, (1, 1))
ANGLES = np.radians(np.arange(-120, 121, 4.0))
MOUNT = se2.lifted((0.15, 0.0, 0.3))
ODOM = np.array([-4.0, 7.0, 2.0])
SMALL = {"amcl.particles_max": 3000, "amcl.particles_min": 100, "amcl.candidates": 10}

SOME_SCAN = Scan(np.ones(3, np.float32), 0.0, 0.1, 0.02, 5.0, np.eye(4))


def seen(pose, odom, n, rng, **changes):
    x, y, yaw = se2.compose(pose, se2.flattened(MOUNT))
    ranges = cast(PLAN.outline(0.2, 0.4), (x, y), ANGLES + yaw, 5.0)
    ranges = (ranges + rng.normal(0, 0.01, len(ranges))).astype(np.float32)
    ranges[rng.random(len(ranges)) < 0.03] = np.nan
    scan = Scan(ranges, ANGLES[0], ANGLES[1] - ANGLES[0], 0.02, 5.0, se2.lifted(odom) @ MOUNT, MOUNT, stamp_ns=n)
    return replace(scan, **changes)


def drive(stops, rng, step=0.15):
    """True poses along straight ways, and those of an odometer that is off by a few per cent."""
    poses = [np.array([*stops[0], np.arctan2(*np.subtract(stops[1], stops[0])[::-1])])]
    for a, b in pairwise(stops):
        way, yaw = np.hypot(*np.subtract(b, a)), np.arctan2(*np.subtract(b, a)[::-1])
        turn = se2.wrapped(yaw - poses[-1][2])
        start = poses[-1][2]
        poses += [np.array([*a, start + turn * share]) for share in np.linspace(0.2, 1, 5)]
        poses += [np.array([*(np.asarray(a) + s * np.subtract(b, a)), yaw]) for s in np.arange(step, way, step) / way]
    odom = [ODOM]
    for before, after in pairwise(poses):
        noise = 1 + rng.normal(0, [0.03, 0.03, 0.05])
        odom.append(se2.compose(odom[-1], se2.relative(before, after) * [1.02, 1.02, 0.98] * noise))
    return np.array(poses), np.array(odom)


WAY = [(1.0, 2.0), (3.0, 1.7), (8.0, 1.7), (11.5, 1.7), (8.0, 1.7), (6.6, 1.7), (6.6, 4.0), (6.6, 1.7), (2.0, 1.5)]


def scans_of(poses, odom, rng):
    return [seen(pose, at, n, rng) for n, (pose, at) in enumerate(zip(poses, odom, strict=True))]


@pytest.fixture(scope="module")
def driven():
    rng = np.random.default_rng(0)
    poses, odom = drive(WAY, rng)
    return poses, odom, scans_of(poses, odom, rng)


def off(found, poses):
    return np.hypot(*(np.asarray(found) - poses)[:, :2].T)


def by_likelihood(log_likelihoods, trust):
    """The weights that products of likelihoods to the power of `trust` give, one by one in plain numbers."""
    powers = [float(value) * trust for value in log_likelihoods]
    weights = [np.exp(value - max(powers)) for value in powers]
    return [weight / sum(weights) for weight in weights]


@pytest.mark.parametrize("model", ["field", "beam"])
@pytest.mark.parametrize("trust", [0.1, 0.03])
def test_weights_are_the_product_of_all_scans_since_particles_were_drawn(driven, model, trust):
    poses, _, scans = driven
    settings = {"model": model, "trust": trust, "resample_interval": 3, "particles_max": 300, "update_min_d": 0}
    settings = {f"amcl.{name}": value for name, value in settings.items()}
    localiser = Localiser(GRID, load_config(**{**SMALL, **settings}), poses[0])
    log_likelihoods = np.zeros(300)
    for number, scan in enumerate(scans[:9:4]):
        localiser.add(scan)
        beams = beams_of(scan).some(localiser.config.max_beams, localiser._sensor.hits_only)
        if number < 2:
            log_likelihoods += localiser._sensor.log_likelihood(localiser._particles, beams)
            assert localiser._weights == pytest.approx(by_likelihood(log_likelihoods, trust), rel=1e-3)
    assert np.ptp(localiser._weights) == 0  # drawn anew
    strangers, weights = localiser._strangers(0.05, beams)
    alone = localiser._sensor.log_likelihood(strangers, beams)
    assert weights == pytest.approx(by_likelihood(alone, trust), rel=1e-3)


@pytest.mark.parametrize("model", ["field", "beam"])
def test_tracking_follows_where_odometry_drifts(driven, model):
    poses, odom, scans = driven
    config = load_config(**SMALL, **{"amcl.model": model})
    track = localise(GRID, scans, config, start=poses[0] + [0.2, -0.1, 0.1], seed=1)
    drifted = se2.compose(poses[0], se2.relative(odom[0], odom))
    assert off(drifted, poses)[-1] > 0.5
    errors = off(track.pose_map_base, poses)[20:]
    assert np.sqrt((errors**2).mean()) < 0.05
    assert np.abs(se2.wrapped(track.pose_map_base - poses)[20:, 2]).max() < np.radians(5)
    assert track.stamps_ns.tolist() == list(range(len(scans)))
    assert np.allclose(se2.compose(track.pose_map_odom, odom)[:, :2], track.pose_map_base[:, :2], atol=1e-9)


def test_the_frames_chain_as_in_ros(driven):
    poses, odom, scans = driven
    localiser = Localiser(GRID, load_config(**SMALL), poses[0], seed=2)
    for scan, at in zip(scans[:40], odom, strict=False):
        estimate = localiser.add(scan)
        assert np.allclose(se2.compose(estimate.pose_map_odom, at), estimate.pose_map_base)
    assert estimate.settled
    std = np.sqrt(np.diag(estimate.covariance))
    assert (std > 0).all()
    assert std[0] < 0.15
    assert std[2] < 0.1
    assert np.allclose(estimate.particles[:, :2].mean(0), estimate.pose_map_base[:2], atol=0.3)


def test_the_map_is_asked_only_after_moving_far_enough():
    config = load_config(**SMALL, **{"amcl.update_min_d": 0.2, "amcl.update_min_a": 0.5})
    rng, pose = np.random.default_rng(0), np.array([1.0, 1.5, 0])
    localiser = Localiser(GRID, config, pose)
    steps = [(0, 0, 0), (0.15, 0, 0), (0.25, 0, 0), (0.25, 0, 0.4), (0.25, 0, 0.6), (0.25, 0, 0.6)]
    estimates = [localiser.add(seen(pose + step, se2.compose(ODOM, step), n, rng)) for n, step in enumerate(steps)]
    assert [estimate.moved for estimate in estimates] == [True, False, True, False, True, False]
    between = se2.relative(estimates[0].pose_map_base, estimates[1].pose_map_base)
    assert np.allclose(between, [0.15, 0, 0])  # the odometry goes on
    assert np.array_equal(estimates[2].particles, estimates[3].particles)
    assert not np.array_equal(estimates[1].particles, estimates[2].particles)


def test_the_robot_is_found_from_anywhere_though_rooms_are_alike(driven):
    poses, _, scans = driven
    found, in_doubt = 0, 0
    for seed in range(5):
        localiser = Localiser(GRID, load_config(**SMALL), seed=seed)
        estimates = [localiser.add(scan) for scan in scans]
        found += off([estimate.pose_map_base for estimate in estimates], poses)[-40:].max() < 0.2
        in_doubt += not estimates[0].settled
        assert 3000 >= len(estimates[0].particles) > len(estimates[-1].particles) >= 100
    assert found >= 4
    assert in_doubt == 5


def test_a_track_from_anywhere_is_right_from_its_first_scan(driven):
    poses, _, scans = driven
    track = localise(GRID, scans, load_config(**SMALL), seed=0)
    live = Localiser(GRID, load_config(**SMALL), seed=0)
    early = [live.add(scan) for scan in scans]
    known = next(i for i, estimate in enumerate(early) if estimate.settled)
    assert known > 3
    assert off(track.pose_map_base, poses).max() < 0.4
    assert np.allclose(track.pose_map_odom[:known], track.pose_map_odom[known])
    assert np.allclose(track.pose_map_base[known:], [estimate.pose_map_base for estimate in early[known:]])


def carried_away(seed, **settings):
    """Drive, be carried elsewhere while the odometer stands still, drive on; return the errors after that."""
    rng = np.random.default_rng(seed)
    before, odom_before = drive([(1.0, 2.0), (3.0, 1.7), (8.0, 1.7), (11.5, 1.7)], rng)
    after, odom_after = drive(WAY[5:], rng)
    odom_after = se2.compose(odom_before[-1], se2.relative(odom_after[0], odom_after))
    poses, odom = np.concatenate([before, after]), np.concatenate([odom_before, odom_after])
    scans = scans_of(poses, odom, rng)
    localiser = Localiser(GRID, load_config(**SMALL, **settings), before[0], seed)
    found = [localiser.add(scan).pose_map_base for scan in scans]
    errors = off(found, poses)
    assert errors[len(before) - 1] < 0.2
    assert errors[len(before)] > 1
    return errors[-15:].max()


def test_a_kidnapped_robot_is_found_by_random_particles_only():
    assert sum(carried_away(seed) < 0.2 for seed in range(3)) >= 2
    assert all(carried_away(seed, **{"amcl.alpha_slow": 0, "amcl.alpha_fast": 0}) > 0.5 for seed in range(2))


def test_a_seed_repeats_all_and_another_does_not(driven):
    _, _, scans = driven
    runs = [localise(GRID, scans[:60], load_config(**SMALL), seed=seed).pose_map_base for seed in (3, 3, 4)]
    assert np.array_equal(runs[0], runs[1])
    assert not np.array_equal(runs[0], runs[2])


def test_what_stands_in_the_way_is_left_out_once_the_robot_knows_where_it_is(driven):
    poses, _, scans = driven
    somebody = scans[30].ranges.copy()
    somebody[20:35] = 0.4  # walks in the middle of the room
    beams = beams_of(replace(scans[30], ranges=somebody))
    lost = beams_of(replace(scans[30], ranges=np.full(61, 0.3, np.float32)))
    for skip in (True, False):
        localiser = Localiser(
            GRID, load_config(**SMALL, **{"amcl.beam_skip": skip, "amcl.beam_skip_distance": 0.2}), poses[0]
        )
        assert localiser._fitting(beams) is beams  # not yet settled
        settled = [localiser.add(scan).settled for scan in scans[:31]]
        assert settled[-1]
        used = localiser._fitting(beams)
        assert len(beams.ranges) - len(used.ranges) == (15 if skip else 0)
        assert skip == (0.4 not in used.ranges.astype(np.float32))
        assert localiser._fitting(lost) is lost  # all of them: rather the robot is lost


@pytest.mark.parametrize(
    "changes",
    [
        {"fault": "no_pose"},
        {"ranges": np.full(61, np.nan, np.float32)},
        {"T_world_sensor": np.full((4, 4), np.inf)},
        {"T_world_sensor": np.diag([2.0, 1, 1, 1])},
    ],
)
def test_refused_scans_change_nothing(driven, changes):
    _, _, scans = driven
    with_, without = (Localiser(GRID, load_config(**SMALL), seed=6) for _ in range(2))
    for n, scan in enumerate(scans[:25]):
        if n in (0, 3, 11):
            with pytest.raises(FrameRefused):
                with_.add(replace(scan, **changes))
        a, b = with_.add(scan), without.add(scan)
        assert np.array_equal(a.particles, b.particles)
        assert np.array_equal(a.pose_map_base, b.pose_map_base)
    assert with_.refused.total() == 3
    assert not without.refused


def test_a_track_leaves_refused_scans_out(driven):
    poses, _, scans = driven
    done = []
    mixed = [replace(scans[0], fault="unreadable"), *scans[:10], replace(scans[10], fault="no_pose"), scans[11]]
    track = localise(GRID, mixed, load_config(**SMALL), start=poses[0], progress=done.append)
    assert track.stamps_ns.tolist() == [*range(10), 11]
    assert done == list(range(1, 14))
    assert track.refused == {"unreadable": 1, "no_pose": 1}
    assert "unreadable" in track.first_refusal
    sound = localise(GRID, scans[:5], load_config(**SMALL), start=poses[0])
    assert (sound.refused, sound.first_refusal) == ({}, "")


def stamped(scans, stamps):
    return [replace(scan, stamp_ns=stamp_ns) for scan, stamp_ns in zip(scans, stamps, strict=True)]


@pytest.mark.parametrize("late", [5, 3, -(10**15)])
def test_scans_that_come_too_late_are_refused_and_change_nothing(driven, late):
    poses, _, scans = driven
    one_late = [*scans[:6], replace(scans[3], stamp_ns=late), *scans[6:25]]
    found = localise(GRID, one_late, load_config(**SMALL), poses[0], seed=2)
    expected = localise(GRID, scans[:25], load_config(**SMALL), poses[0], seed=2)
    assert np.array_equal(found.stamps_ns, expected.stamps_ns)
    assert np.array_equal(found.pose_map_base, expected.pose_map_base)
    assert found.refused == {"not_in_order": 1}
    assert "is not later than the scan before" in found.first_refusal


def test_one_stamp_from_the_future_ends_nothing(driven):
    poses, _, scans = driven
    stamps = np.arange(40)
    stamps[20] = 10**18
    found = localise(GRID, stamped(scans[:40], stamps.tolist()), load_config(**SMALL), poses[0])
    kept = [*range(20), *range(24, 40)]
    assert found.stamps_ns.tolist() == kept
    assert found.refused == {"not_in_order": 4}
    assert off(found.pose_map_base, poses[kept])[-3:].max() < 0.2


@pytest.mark.parametrize("before", [1, 7])
def test_where_the_clock_is_set_back_the_majority_is_believed(before):
    clock = Clock()
    for stamp_ns in range(100, 100 + before):
        assert clock.accept(replace(SOME_SCAN, stamp_ns=stamp_ns)) == 0
    patience = max(before, 3)
    for stamp_ns in range(patience):
        with pytest.raises(FrameRefused):
            clock.accept(replace(SOME_SCAN, stamp_ns=stamp_ns))
    wrong = [clock.accept(replace(SOME_SCAN, stamp_ns=patience + stamp_ns)) for stamp_ns in (0, 1, 50)]
    assert wrong == [before, 0, 0]


def test_late_scans_are_only_believed_where_they_rise_in_a_row():
    clock = Clock()
    clock.accept(replace(SOME_SCAN, stamp_ns=1000))
    stuck = [7] * 20
    overtaken = [stamp_ns for n in range(1002, 1030, 2) for stamp_ns in (n, n - 1)]  # two by two in the wrong order
    last_ns = 1000
    for stamp_ns in stuck + overtaken:
        if stamp_ns > last_ns:
            last_ns = stamp_ns
            assert clock.accept(replace(SOME_SCAN, stamp_ns=stamp_ns)) == 0
            continue
        with pytest.raises(FrameRefused) as caught:
            clock.accept(replace(SOME_SCAN, stamp_ns=stamp_ns))
        assert caught.value.reason == "not_in_order"


def test_a_refused_scan_does_not_set_the_clock(driven):
    poses, _, scans = driven
    dark = replace(scans[1], ranges=np.full(61, np.nan, np.float32), stamp_ns=10**18)
    found = localise(
        GRID, [scans[0], dark, replace(dark, fault="no_pose"), *scans[1:5]], load_config(**SMALL), poses[0]
    )
    assert found.stamps_ns.tolist() == list(range(5))


def test_the_way_does_not_keep_the_particles(driven, monkeypatch):
    poses, _, scans = driven
    clouds = []

    def watched(self, scan):
        estimate = add(self, scan)
        clouds.append(weakref.ref(estimate.particles))
        return estimate

    add = Localiser.add
    monkeypatch.setattr(Localiser, "add", watched)
    alive = []
    localise(GRID, scans[:30], load_config(**SMALL), poses[0], progress=lambda _: alive.append(clouds_alive(clouds)))
    assert len({id(cloud) for cloud in clouds}) > 10
    assert max(alive) <= 3


def clouds_alive(clouds):
    return len({id(cloud()) for cloud in clouds if cloud() is not None})


def test_without_a_good_scan_there_is_no_track(driven):
    _, _, scans = driven
    for none in ([], [replace(scans[0], fault="no_pose", fault_detail="scan 0: no pose in the bag")]):
        with pytest.raises(SourceError) as caught:
            localise(GRID, none, load_config(**SMALL))
        assert "\n" not in str(caught.value)
    assert "no pose in the bag" in str(caught.value)


@pytest.mark.parametrize("value", [0, 100, -1])
def test_maps_that_tell_nothing_are_errors(value):
    with pytest.raises(MapFileError, match=r"no (free|occupied) cell"):
        Localiser(OccupancyGrid(np.full((5, 5), value, np.int8), 0.1), load_config())


@pytest.mark.parametrize("start", [(1, 2), (1, 2, np.nan), "here", [[1, 2, 3]], (1, 2, None)])
def test_starts_that_are_no_poses_are_errors(start):
    with pytest.raises(ConfigError, match="start"):
        Localiser(GRID, load_config(), start)


def test_settings_that_contradict_each_other_are_errors():
    for bad in ({"particles_min": 600, "particles_max": 500}, {"alpha_slow": 0.5}, {"start_std": [-1, 0, 0]}):
        with pytest.raises(ConfigError, match="amcl"):
            load_config(**{f"amcl.{name}": value for name, value in bad.items()})
