# SPDX-License-Identifier: Apache-2.0
"""Stamps that lie, and what comes before the first keyframe."""

from dataclasses import replace

import numpy as np
import pytest
from made_drives import along, drive, ring

from stereovox.config import load_config
from stereovox.geometry import se2
from stereovox.localize.slam.pipeline import MIN_LATE_SCANS, Slam, map_scans

SCANS = drive(ring(), along([(1, 1), (6, 1)]), drift=(1.03, 0.01))
FUTURE = 10**18


def stamped(scan, stamp_ns):
    return replace(scan, stamp_ns=stamp_ns)


@pytest.mark.parametrize("at", [0, 1, 20])
@pytest.mark.parametrize("count", [1, 5])
def test_stamps_in_the_future_do_not_end_it(at, count):
    scans = [stamped(scan, FUTURE + i) if at <= i < at + count else scan for i, scan in enumerate(SCANS)]
    late = max(count, MIN_LATE_SCANS)
    result = map_scans(scans, load_config())
    assert result.refused == {"not_in_order": count + late}
    kept = [*SCANS[:at], *SCANS[at + count + late :]]
    assert result.track.stamps_ns.tolist() == [scan.stamp_ns for scan in kept]
    right = map_scans([*SCANS[: at + count], *SCANS[at + count + late :]], load_config())
    poses = np.delete(right.track.pose_map_base, range(at, at + count), axis=0)
    assert np.array_equal(result.track.pose_map_base, poses)
    assert np.array_equal(result.grid.cells, right.grid.cells)  # the map holds them where they were seen


def test_late_scans_are_refused_while_those_before_are_more():
    replay = [*SCANS[:30], *SCANS[15:30], *SCANS[30:]]
    result = map_scans(replay, load_config())
    assert result.refused == {"not_in_order": 15}
    assert result.track.stamps_ns.tolist() == [scan.stamp_ns for scan in SCANS]


def test_a_late_scan_told_many_times_does_not_count_as_many():
    slam = Slam(load_config())
    for scan in SCANS[:10]:
        slam.add(scan)
        for _ in range(6):
            slam.add(SCANS[0])
    result = slam.finish()
    assert result.refused == {"not_in_order": 60}
    assert result.track.stamps_ns.tolist() == [scan.stamp_ns for scan in SCANS[:10]]


def test_late_scans_between_right_ones_do_not_add_up():
    slam = Slam(load_config())
    for scan in SCANS[:20]:
        slam.add(scan)
        slam.add(stamped(scan, scan.stamp_ns - 1))
    result = slam.finish()
    assert result.refused == {"not_in_order": 20}
    assert result.track.stamps_ns.tolist() == [scan.stamp_ns for scan in SCANS[:20]]


def test_scans_before_the_first_keyframe_are_on_the_track():
    blind = [replace(scan, ranges=np.full_like(scan.ranges, np.inf)) for scan in SCANS[:8]]
    slam = Slam(load_config())
    for scan in [*blind, *SCANS[8:]]:
        slam.add(scan)
    slam.keyframes[0].pose = se2.compose([3.0, 2.0, 1.0], slam.keyframes[0].pose)  # as if a loop had moved it
    result = slam.finish()
    assert result.refused == {}
    assert result.track.stamps_ns.tolist() == [scan.stamp_ns for scan in SCANS]
    odometry = np.array([scan.pose_world_base for scan in SCANS[:9]])
    assert np.allclose(result.track.pose_map_base[:9], se2.compose([3.0, 2.0, 1.0], odometry), atol=1e-9)
