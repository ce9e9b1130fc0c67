# SPDX-License-Identifier: Apache-2.0
"""Localisation scan by scan: the robot's pose in the node, and when it is not published."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import wire
from made_chain import floor, reference
from made_drives import along, drive, ring

from stereovox.config import load_config
from stereovox.errors import FrameRefused, StereovoxError
from stereovox.geometry import se2
from stereovox.localize.amcl.localise import localise
from stereovox.ros.poses.localization import (
    LocalizedPoses,
    Localizer,
    LocalizingScanInput,
    MapLocalization,
    SlamLocalization,
)

START = np.zeros(3)


@pytest.fixture(scope="module")
def config():
    return load_config("ist2019")


def localizer(config, start=START):
    poses, told = LocalizedPoses("", "", 0.1, "odom"), []
    return Localizer(MapLocalization(reference(), config, start), poses, told.append), told


def add_odometry(poses, stamps, child="base_link"):
    for stamp_ns in stamps:
        T = floor().odometry.at(stamp_ns)
        poses.on_tf(wire.packed(wire.messages().transforms(stamp_ns, [("odom", child, T)])), fixed=False)


def test_frames_are_corrected_as_the_track_of_the_recording_is(config):
    scans = list(floor().scans)
    one, told = localizer(config)
    add_odometry(one.poses, floor().odometry.stamps_ns.tolist())
    for scan in scans:
        one.locate(scan)
    track = localise(reference(), scans, config, START)
    assert (one.used, len(told), not one.refused) == (len(scans), len(scans), True)
    first_ns = next(found.stamp_ns for found in told if found.settled)
    for stamp_ns in range(first_ns, scans[-1].stamp_ns, 370_000_000):
        expected = se2.lifted(track.correction(stamp_ns)) @ floor().odometry.at(stamp_ns)
        np.testing.assert_allclose(one.poses.pose("base_link", stamp_ns).T_world_sensor, expected, atol=1e-6)
    assert one.poses.is_final("base_link", scans[-2].stamp_ns)
    assert not one.poses.is_final("base_link", scans[-1].stamp_ns + 1)  # the next scan may change it


def test_until_it_is_known_where_the_robot_is_frames_are_refused(config):
    one, _ = localizer(config, start=None)
    add_odometry(one.poses, floor().odometry.stamps_ns.tolist())
    with pytest.raises(FrameRefused, match="no scan has been localised") as refused:
        one.poses.pose("base_link", floor().scans[0].stamp_ns)
    assert refused.value.reason == "not_localised"
    found = one.locate(floor().scans[0])  # anywhere in the map
    assert not found.settled
    assert one.counts()["localisation"].startswith("lost: the robot may be in several places")
    with pytest.raises(FrameRefused, match="initialpose"):
        one.poses.pose("base_link", floor().scans[0].stamp_ns)
    assert not one.poses.is_final("base_link", floor().scans[0].stamp_ns)


def test_no_pose_is_made_between_a_place_that_was_given_up_and_the_next(config):
    one, _ = localizer(config)
    stamps = floor().odometry.stamps_ns.tolist()
    add_odometry(one.poses, stamps)
    begin, middle, end = stamps[5], stamps[5] + 100_000_000, stamps[5] + 200_000_000
    one.poses.correct(begin, np.eye(4))
    assert one.poses.pose("base_link", begin)
    one.forget()  # as /initialpose does
    moved = np.eye(4)
    moved[0, 3] = 0.5
    one.poses.correct(end, moved)
    with pytest.raises(FrameRefused, match="begins after"):
        one.poses.pose("base_link", begin)
    with pytest.raises(FrameRefused):
        one.poses.pose("base_link", middle - 1)
    expected = moved @ floor().odometry.at(end)
    np.testing.assert_allclose(one.poses.pose("base_link", end).T_world_sensor, expected, atol=1e-6)
    one.poses.correct(end + 100_000_000, moved)
    assert one.poses.pose("base_link", end + 50_000_000)  # known at both ends: between them, too


def test_a_place_that_is_told_counts_from_the_next_scan_on(config):
    one, _ = localizer(config, start=None)
    add_odometry(one.poses, floor().odometry.stamps_ns.tolist())
    one.locate(floor().scans[0])
    one.localization.place(START, [0.1, 0.1, 0.05])
    found = one.locate(floor().scans[1])
    assert found.settled
    assert np.hypot(*found.pose_map_base[:2]) < 0.2
    assert one.counts()["localisation"] == "localised"
    with pytest.raises(StereovoxError, match="outside of the map"):
        one.localization.place(np.array([500.0, 0.0, 0.0]))


def test_what_others_publish_is_not_used_and_own_transforms_are_known_again():
    poses = LocalizedPoses("map", "", 0.1, "odom")
    poses.published(7)
    own, foreign = (wire.packed(wire.messages().transforms(ns, [("map", "odom", np.eye(4))])) for ns in (7, 8))
    poses.on_tf(own, fixed=False)
    assert not poses.rival
    poses.on_tf(foreign, fixed=False)
    assert poses.rival
    assert not poses.tf.connected("map", "odom")


def test_a_bad_scan_is_refused_and_changes_nothing(config):
    one, told = localizer(config)
    scan = floor().scans[0]
    with pytest.raises(FrameRefused):
        one.locate(replace(scan, ranges=scan.ranges * np.nan))
    with pytest.raises(FrameRefused, match="why"):
        one.locate(replace(scan, fault="unreadable", fault_detail="why"))
    assert (one.used, told) == (0, [])
    assert dict(one.refused) == {"no_valid_range": 1, "unreadable": 1}
    assert one.poses.lost


def test_a_bag_that_begins_again_is_localised_from_its_start(config):
    said = []
    one, _ = localizer(config)
    one._log = said.append
    scans = floor().scans
    for i in (0, 40, 79, 0, 1):
        found = one.locate(scans[i])
    assert "went back" in said[0]
    assert found.stamp_ns == scans[1].stamp_ns
    assert np.hypot(*found.pose_map_base[:2]) < 1.0


def test_scans_enter_the_map_only_where_that_is_wanted(config):
    one, _ = localizer(config)
    add_odometry(one.poses, floor().odometry.stamps_ns.tolist(), child="laser")
    scan = floor().scans[3]
    data = wire.packed(wire.messages().scan(scan, "laser"))
    assert LocalizingScanInput("/scan", one, mapped=False).frame(data, one.poses.odometry) is None
    one, told = localizer(config)
    add_odometry(one.poses, floor().odometry.stamps_ns.tolist(), child="laser")
    frame = LocalizingScanInput("/scan", one, mapped=True).frame(data, one.poses.odometry)
    if told[0].settled:
        expected = se2.lifted(told[0].pose_map_odom) @ floor().odometry.at(scan.stamp_ns)
        np.testing.assert_allclose(frame.T_world_sensor, expected, atol=1e-6)
    else:
        assert frame.fault == "not_localised"


def test_slam_says_where_the_robot_is_and_refuses_what_it_cannot_use(config):
    pytest.importorskip("gtsam", reason="gtsam is not installed: pip install 'stereovox[slam]'")
    slam = SlamLocalization(config)
    assert slam.grid() is None
    assert slam.finish() is None
    found = [slam.add(scan) for scan in floor().scans[:30]]
    assert found[0].moved
    assert all(one.settled and one.covariance is None for one in found)
    with pytest.raises(FrameRefused) as refused:
        slam.add(floor().scans[2])
    assert refused.value.reason == "not_in_order"
    before = slam.grid()
    np.testing.assert_array_equal(slam.finish().grid.cells, before.cells)  # no loop yet


def test_a_loop_that_moves_the_way_is_counted(config):
    pytest.importorskip("gtsam", reason="gtsam is not installed: pip install 'stereovox[slam]'")
    slam = SlamLocalization(load_config())
    scans = drive(ring(), along([(1, 1), (13, 1), (13, 9), (1, 9), (1, 1), (13, 1), (13, 4)]), drift=(1.03, 0.01))
    bent = []
    for scan in scans:
        slam.add(scan)
        bent.append(slam.bent)
    assert bent[len(bent) // 2] == 0  # not yet round
    assert bent[-1] > 0
